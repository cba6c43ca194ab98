// A tile's points in the object frame: the pose (probnerf.types.Pose) and the window (probnerf.rendering.foam.window).
#pragma once

#include "field.h"

namespace FARSIDE_NAMESPACE {

struct PoseMatrix {
  float c, s, inverse, x, y, z;
  explicit PoseMatrix(const float* pose)
      : c(cosf(pose[0])), s(sinf(pose[0])), inverse(expf(-pose[3])), x(pose[1]), y(pose[2]), z(BASE_Z + pose[4]) {}

  // A point, or a vector of points, in the view frame.
  template <class T>
  void to_object(T px, T py, T pz, T* q) const {
    px -= x, py -= y, pz -= z;
    q[0] = inverse * (c * px + s * py);
    q[1] = inverse * (c * py - s * px);
    q[2] = inverse * pz + BASE_Z;
  }
};

struct Window {
  Vec value, slope;  // slope: derivative with respect to ...
  Int axis;          // ... this coordinate
};

inline Window window(Vec x, Vec y, Vec z) {
  const float margin = 0.1f;
  Int wider = absolute(y) > absolute(x);
  Vec q = select(wider, y, x);
  Int higher = absolute(z) > absolute(q);
  q = select(higher, z, q);
  Int axis = (higher & 2) | (~higher & wider & 1);
  Vec beyond = absolute(q) - 1.0f, below = 5.0f * (BASE_Z - 0.02f - z);
  Int outside = beyond > below;
  Vec u = 1.0f - select(outside, beyond, below) / margin;
  Vec slope = select(outside, select(q > 0.0f, splat(-1.0f), splat(1.0f)), splat(5.0f));
  slope = value(bits(6.0f * u * (1.0f - u) * slope / margin) & (u > 0.0f) & (u < 1.0f));
  u = minimum(maximum(u, Vec{}), splat(1.0f));
  return {u * u * (3.0f - 2.0f * u), slope, (outside & axis) | (~outside & 2)};
}

// 0, or NaN if a weight or the pose is not finite. Without this, a ReLU would hide it.
inline float nothing(const Sizes& s, const Layers& w, const float* pose) {
  float sum = 0.0f;
  for_each_part(s, w, [&](const float* part, int rows, int columns, int stride, bool transposed) {
    for (int i = 0; i < (transposed ? columns : rows) * stride; ++i) sum += part[i] * 0.0f;
  });
  for (int i = 0; i < 6; ++i) sum += pose[i] * 0.0f;
  return sum;
}

}  // namespace FARSIDE_NAMESPACE
