// The pixel likelihood of a tile's rays, and its gradient with respect to density, colour, scale and range offset: the
// arithmetic of probnerf.likelihood.pixel_terms.pixel_terms. Weights and probabilities are used directly instead of
// their logarithms. Nothing underflows, because every sum has a constant term (range outliers, mask errors).
#pragma once

#include <math.h>

#include "field.h"

namespace FARSIDE_NAMESPACE {

// One informative ray, in tile order.
struct Pixel {
  int first, count;  // range of its crossings in the view
  bool object, coloured;
  float rgb[3], uniform, limit, weight;
};

// The view's crossings, ray by ray. Each array is [points].
struct Crossings {
  float *at[3];      // in the view frame
  float *t;
  float *measured;   // range minus the middle of the gap before the face
  float *inverse_deviation, *peak, *floor;  // density of a range given this face: peak exp(-r^2/2) + floor
};

// Values at every crossing of the view for one particle. Each array is [points].
struct Composite {
  float *tau, *weight, *left;  // compositing weight; transmittance after the face
  float *density, *slope;      // density of the range, and its derivative by the offset
  Composite(int points, Arena& a) {
    for (float** p : {&tau, &weight, &left, &density, &slope}) *p = a.take(points);
  }
};

// Values of every pixel for one particle.
struct PixelSums {
  float hit, opacity, left, likelihood;
};

struct PixelGradient {
  double value = 0.0;
  float log_scale = 0.0f, offset = 0.0f;
};

// Crossings with a smaller compositing weight are skipped. (For a free ray: optical depth times its gradient.)
// With sharp walls, one crossing in ten is left. At 1e-8 the sum of the skipped ones changed the gradient by 5e-4 of
// its size. At 1e-11 the change is not visible, and the cost is the same.
constexpr float NEGLIGIBLE = 1e-11f;

// Computes all values that need no colour from a tile's densities, which start at its first pixel's first crossing.
inline void composite(const PixelModel& m, const Crossings& view, const Pixel* pixels, int count, float per_density,
                      float offset, const Tile& t, Composite& c, PixelSums* sums) {
  int first = pixels[0].first;
  for (int p = 0; p < t.padded; p += LANES) {
    Vec tau = load(t.sigma + p) * per_density;
    Exp e = exp_both(-tau);
    store(c.tau + first + p, tau), store(c.left + first + p, e.value), store(c.weight + first + p, -e.minus_one);
    Vec inverse = load(view.inverse_deviation + first + p);
    Vec r = (load(view.measured + first + p) - offset) * inverse;
    Vec surface = load(view.peak + first + p) * exp(-0.5f * r * r);
    store(c.density + first + p, surface + load(view.floor + first + p));
    store(c.slope + first + p, surface * r * inverse);
  }
  for (int j = 0; j < count; ++j) {
    const Pixel& ray = pixels[j];
    int begin = ray.first, end = begin + ray.count;
    if (!ray.object) {
      float total = 0.0f;
      for (int p = begin; p < end; ++p)
        if (view.t[p] <= ray.limit) total += c.tau[p];
      float clear = (1.0f - 2.0f * m.mask_error) * expf(-total);
      float likelihood = m.mask_error + clear;
      for (int p = begin; p < end; ++p) c.weight[p] = view.t[p] <= ray.limit ? c.tau[p] * clear / likelihood : 0.0f;
      sums[j] = {0.0f, 0.0f, clear, likelihood};
      continue;
    }
    float left = 1.0f, hit = 0.0f, opacity = 0.0f;
    for (int p = begin; p < end; ++p) {
      float w = left * c.weight[p];
      left *= c.left[p];
      c.weight[p] = w, c.left[p] = left;
      hit += w * c.density[p];
      opacity += w;
    }
    sums[j] = {hit, opacity, left, (1.0f - m.mask_error) * hit + m.mask_error * left * ray.uniform};
  }
}

// A pixel's term, and its gradient with respect to the density and colour of its kept crossings. In `t` these are
// `begin` to `end`. `source` gives their indices in the view.
inline void pixel_term(const PixelModel& m, const Pixel& ray, const PixelSums& of, const Composite& c, const int* source,
                       int begin, int end, Tile& t, PixelGradient& g) {
  g.value += ray.weight * logf(of.likelihood);
  if (!ray.object) {
    for (int p = begin; p < end; ++p) {
      t.g_sigma[p] = -ray.weight * of.left / of.likelihood;
      g.log_scale += t.g_sigma[p] * c.tau[source[p]];
    }
    return;
  }
  float g_hit = ray.weight * (1.0f - m.mask_error) / of.likelihood, share = 1.0f / (of.opacity + 1e-3f), mean[3], g_mean[3] = {};
  for (int i = 0; ray.coloured && i < 3; ++i) {
    float sum = 0.0f;
    for (int p = begin; p < end; ++p) sum += c.weight[source[p]] * t.colour[i][p];
    mean[i] = (sum + 0.5e-3f) * share;
    float z = (ray.rgb[i] - mean[i]) / m.colour_sigma;
    g.value += ray.weight * (-0.5f * z * z - logf(m.colour_sigma) - 0.918938533f);
    g_mean[i] = ray.weight * z / m.colour_sigma * share;
  }
  float behind = ray.weight * m.mask_error * ray.uniform / of.likelihood * of.left;  // sum of g_w w behind, and the miss
  for (int p = end - 1; p >= begin; --p) {
    float w = c.weight[source[p]], g_w = g_hit * c.density[source[p]];
    for (int i = 0; ray.coloured && i < 3; ++i) {
      g_w += g_mean[i] * (t.colour[i][p] - mean[i]);
      t.g_colour[i][p] = g_mean[i] * w;
    }
    g.offset += g_hit * w * c.slope[source[p]];
    t.g_sigma[p] = g_w * c.left[source[p]] - behind;
    g.log_scale += t.g_sigma[p] * c.tau[source[p]];
    behind += g_w * w;
  }
}

}  // namespace FARSIDE_NAMESPACE
