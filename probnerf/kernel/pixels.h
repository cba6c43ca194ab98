// What the pixels of a tile's rays say, and its gradient by density, colour, scale and range offset: the arithmetic of
// probnerf.model.pixel_terms, with weights and probabilities as they are where that has logarithms. Nothing underflows:
// every sum holds a constant share (the outliers of a range, the errors of a mask).
#pragma once

#include <math.h>

#include "field.h"

namespace FARSIDE_NAMESPACE {

// One ray that says something, in the order of its tile.
struct Pixel {
  int first, count;  // its crossings among the view's
  bool object, coloured;
  float rgb[3], uniform, limit;
};

// The view's crossings, all rays' one after another, each array [points].
struct Crossings {
  float *at[3];      // in the view's frame
  float *t;
  float *measured;   // range less the middle of the gap before the face
  float *inverse_deviation, *peak, *floor;  // density of a range given this face: peak exp(-r^2/2) + floor
};

struct PixelScratch {
  float *tau, *alpha, *left, *density, *slope;  // [tile]; left: exp(-tau); density of the range, its slope by the offset
  explicit PixelScratch(const Sizes& s, Arena& a) {
    for (float** p : {&tau, &alpha, &left, &density, &slope}) *p = a.take(s.tile);
  }
};

struct PixelGradient {
  double value = 0.0;
  float log_scale = 0.0f, offset = 0.0f;
};

inline void pixel_terms(const Sizes& s, const PixelModel& m, const Crossings& view, const Pixel* pixels, int count,
                        float scale, float offset, Tile& t, PixelScratch& k, PixelGradient& g) {
  if (count == 0) return;
  int n = t.padded, base = pixels[0].first;
  float per_density = m.per_density * scale;
  for (int p = 0; p < n; p += LANES) {
    Vec tau = load(t.sigma + p) * per_density;
    Exp e = exp_both(-tau);
    store(k.tau + p, tau), store(k.left + p, e.value), store(k.alpha + p, -e.minus_one);
    Vec inverse = load(view.inverse_deviation + base + p);
    Vec r = (load(view.measured + base + p) - offset) * inverse;
    Vec surface = load(view.peak + base + p) * exp(-0.5f * r * r);
    store(k.density + p, surface + load(view.floor + base + p));
    store(k.slope + p, surface * r * inverse);
    store(t.g_sigma + p, Vec{});
    for (int i = 0; i < 3; ++i) store(t.g_colour[i] + p, Vec{});
  }
  float* g_tau = t.g_sigma;
  for (int j = 0; j < count; ++j) {
    const Pixel& ray = pixels[j];
    int begin = ray.first - base, end = begin + ray.count;
    if (!ray.object) {
      float total = 0.0f;
      for (int p = begin; p < end; ++p)
        if (view.t[base + p] <= ray.limit) total += k.tau[p];
      float clear = (1.0f - 2.0f * m.mask_error) * expf(-total);
      float likelihood = m.mask_error + clear;
      g.value += logf(likelihood);
      for (int p = begin; p < end; ++p)
        if (view.t[base + p] <= ray.limit) g_tau[p] = -clear / likelihood;
      continue;
    }
    float left = 1.0f, hit = 0.0f, opacity = 0.0f, sums[3] = {0.0f, 0.0f, 0.0f};
    for (int p = begin; p < end; ++p) {
      float w = left * k.alpha[p];
      left *= k.left[p];
      k.alpha[p] = w, k.left[p] = left;  // from here on: the compositing weight, the transmittance after the face
      hit += w * k.density[p];
      opacity += w;
      if (ray.coloured)
        for (int i = 0; i < 3; ++i) sums[i] += w * t.colour[i][p];
    }
    float likelihood = (1.0f - m.mask_error) * hit + m.mask_error * left * ray.uniform;
    g.value += logf(likelihood);
    float g_hit = (1.0f - m.mask_error) / likelihood, share = 1.0f / (opacity + 1e-3f), mean[3], g_mean[3] = {};
    for (int i = 0; ray.coloured && i < 3; ++i) {
      mean[i] = (sums[i] + 0.5e-3f) * share;
      float z = (ray.rgb[i] - mean[i]) / m.colour_sigma;
      g.value += -0.5f * z * z - logf(m.colour_sigma) - 0.918938533f;
      g_mean[i] = z / m.colour_sigma * share;
    }
    float behind = m.mask_error * ray.uniform / likelihood * left;  // sum of g_w w behind, and the miss
    for (int p = end - 1; p >= begin; --p) {
      float w = k.alpha[p], g_w = g_hit * k.density[p];
      if (ray.coloured)
        for (int i = 0; i < 3; ++i) {
          g_w += g_mean[i] * (t.colour[i][p] - mean[i]);
          t.g_colour[i][p] = g_mean[i] * w;
        }
      g.offset += g_hit * w * k.slope[p];
      g_tau[p] = g_w * k.left[p] - behind;
      behind += g_w * w;
    }
  }
  for (int p = 0; p < n; p += LANES) {
    Vec gt = load(g_tau + p);
    g.log_scale += sum(gt * load(k.tau + p));
    store(t.g_sigma + p, gt * per_density);
  }
}

}  // namespace FARSIDE_NAMESPACE
