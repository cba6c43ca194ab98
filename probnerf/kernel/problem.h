// Inputs and outputs of one call. Plain C, the same for every instruction set.
#pragma once

#include <stdint.h>

constexpr int MOST_OCTAVES = 20;  // above this, single precision has no digits left

struct FieldSizes {  // probnerf.fields.mlp.MLPField
  int width, octaves, direction_octaves, radial, fitted;
  float density_scale;
};

struct PixelModel {  // probnerf.likelihood.settings.Likelihood
  float mask_error, outlier, outlier_span, wall_sigma, colour_sigma, per_density;  // per_density: 1 / G
};

struct View {  // constants of an observation
  int rays, crossings, colour_count;
  const float *origin, *direction, *t;                       // [rays][3], [rays][3], [rays][crossings]
  const float *rgb, *range, *range_sigma, *limit, *weight;   // [rays][3], [rays], ...; weight of a ray's log-likelihood
  const int32_t *status, *rgb_valid, *range_valid;           // [rays]
};

struct Particle {
  const float *weights, *pose;        // [size], [6]: yaw, x, y, log-scale, z, range offset
  float *value, *g_weights, *g_pose;  // [1], [size], [6]; if g_pose is null, only the value is computed
  int part, parts;                    // this part takes every `parts`-th tile of the view, from tile `part`
};

struct Points {  // points in the view frame
  int64_t count;
  const float* at;  // [count][3]
};

struct Shape {
  const float *weights, *pose;  // [size], [6] as above
  float* density;               // [count] density of the points, times the window
};
