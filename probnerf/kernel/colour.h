// The colour network on a tile. Its inputs are the point's encoding, the ray's direction and the logarithm of density.
#pragma once

#include "field.h"

namespace FARSIDE_NAMESPACE {

// A ray direction's contribution to the first layer. It is the same for all points of the ray.
struct Direction {
  float *d, *gd;                   // [3] in the object frame
  float *encoding, *before, *sum;  // [encoded_direction], [H], [H]: gradient summed over the ray's points
  static Direction take(const Sizes& s, Arena& a) {
    return {a.take(3), a.take(3), a.take(s.encoded_direction), a.take(s.H), a.take(s.H)};
  }
};

inline void direction_forward(const Sizes& s, const Layers& w, Direction& r) {
  for (int i = 0; i < 3; ++i) {
    r.encoding[i] = r.d[i];
    for (int j = 0; j < s.direction_octaves; ++j) {
      Vec sine, cosine;
      sincospi(splat(r.d[i] * float(1 << j)), sine, cosine);
      r.encoding[(1 + 2 * j) * 3 + i] = sine[0];
      r.encoding[(2 + 2 * j) * 3 + i] = cosine[0];
    }
  }
  memcpy(r.before, w.b3, sizeof(float) * s.H);
  multiply(1, s.H, s.encoded_direction, r.encoding, 0, 1, w.k3d, s.H, r.before, s.H);
  memset(r.sum, 0, sizeof(float) * s.H);
}

inline void direction_backward(const Sizes& s, const Layers& w, Direction& r, Layers& g) {
  multiply(s.encoded_direction, s.H, 1, r.encoding, 1, 0, r.sum, 0, g.k3d, s.H);
  add_rows(g.b3, r.sum, 1, s.H);
  for (int i = 0; i < 3; ++i) {
    r.gd[i] = dot(w.k3d + i * s.H, r.sum, s.H);
    for (int j = 0; j < s.direction_octaves; ++j) {
      int sine = (1 + 2 * j) * 3 + i, cosine = sine + 3;
      float part = dot(w.k3d + sine * s.H, r.sum, s.H) * r.encoding[cosine] -
                   dot(w.k3d + cosine * s.H, r.sum, s.H) * r.encoding[sine];
      r.gd[i] += float(1 << j) * 3.14159265f * part;
    }
  }
}

inline void colour_forward(const Sizes& s, const Layers& w, const Direction* rays, Tile& t) {
  int n = t.padded;
  for (int p = 0; p < n; p += LANES) store(t.log_sigma + p, log1p(load(t.sigma + p)));
  for (int p = 0; p < n; ++p) memcpy(t.c0 + p * s.H, rays[t.ray[p]].before, sizeof(float) * s.H);
  multiply(n, s.H, s.encoded, t.encoding, 1, s.tile, w.k3, s.H, t.c0, s.H);
  multiply(n, s.H, 1, t.log_sigma, 1, 0, w.k3s, s.H, t.c0, s.H);
  relu(t.c0, n * s.H);
  fill_rows(t.c1, n, s.H, w.b4);
  multiply(n, s.H, s.width, t.c0, s.H, 1, w.k4, s.H, t.c1, s.H);
  relu(t.c1, n * s.H);
  for (int i = 0; i < 3; ++i) {
    dot_rows(t.c1, n, s.H, w.k5 + i * s.H, t.colour[i]);
    for (int p = 0; p < n; p += LANES) store(t.colour[i] + p, 1.0f / (1.0f + exp(-load(t.colour[i] + p) - w.b5[i])));
  }
}

// Backward pass from t.g_colour. It adds to the weights' gradient, t.g_encoding, t.gx, t.g_sigma and the ray sums.
inline void colour_backward(const Sizes& s, const Layers& w, const Transposed& wt, Direction* rays, Tile& t, Layers& g) {
  int n = t.padded;
  float* go[3] = {t.g_colour[0], t.g_colour[1], t.g_colour[2]};
  for (int i = 0; i < 3; ++i)
    for (int p = 0; p < n; p += LANES) {
      Vec c = load(t.colour[i] + p);
      store(go[i] + p, load(go[i] + p) * c * (1.0f - c));
    }
  for (int v = 0; v < s.H; v += LANES) {
    Vec k[3], gk[3];
    for (int i = 0; i < 3; ++i) k[i] = load(w.k5 + i * s.H + v), gk[i] = load(g.k5 + i * s.H + v);
    for (int p = 0; p < n; ++p) {
      Vec h = load(t.c1 + p * s.H + v);
      Vec back = go[0][p] * k[0] + go[1][p] * k[1] + go[2][p] * k[2];
      store(t.g1 + p * s.H + v, value(bits(back) & (h > 0.0f)));
      for (int i = 0; i < 3; ++i) gk[i] += go[i][p] * h;
    }
    for (int i = 0; i < 3; ++i) store(g.k5 + i * s.H + v, gk[i]);
  }
  for (int i = 0; i < 3; ++i) g.b5[i] += total(go[i], n);
  multiply(s.width, s.H, n, t.c0, 1, s.H, t.g1, s.H, g.k4, s.H);
  add_rows(g.b4, t.g1, n, s.H);
  memset(t.g0, 0, sizeof(float) * n * s.H);
  multiply(n, s.H, s.width, t.g1, s.H, 1, wt.k4, s.H, t.g0, s.H);
  only_where_positive(t.g0, t.c0, n * s.H);
  multiply(s.encoded, s.H, n, t.encoding, s.tile, 1, t.g0, s.H, g.k3, s.H);
  multiply(1, s.H, n, t.log_sigma, 0, 1, t.g0, s.H, g.k3s, s.H);
  for (int p = 0; p < t.count; ++p) add_rows(rays[t.ray[p]].sum, t.g0 + p * s.H, 1, s.H);
  multiply(n, s.E, s.width, t.g0, s.H, 1, wt.k3, s.E, t.g_encoding, s.E);
  dot_rows(t.g0, n, s.H, w.k3s, t.log_sigma);  // overwritten by its gradient
  for (int p = 0; p < n; p += LANES)
    store(t.g_sigma + p, load(t.g_sigma + p) + load(t.log_sigma + p) / (1.0f + load(t.sigma + p)));
}

}  // namespace FARSIDE_NAMESPACE
