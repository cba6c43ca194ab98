// What one call is given and gives back; plain C, the same for every instruction set.
#pragma once

#include <stdint.h>

struct FieldSizes {  // probnerf.field.MLPField
  int width, octaves, direction_octaves, radial, fitted;
  float density_scale;
};

struct PixelModel {  // probnerf.model.Likelihood
  float mask_error, outlier, outlier_span, wall_sigma, colour_sigma, per_density;  // per_density: 1 / G
};

struct View {  // constants of an observation
  int rays, crossings, colour_count;
  const float *origin, *direction, *t;                       // [rays][3], [rays][3], [rays][crossings]
  const float *rgb, *range, *range_sigma, *limit;            // [rays][3], [rays], ...
  const int32_t *status, *rgb_valid, *range_valid;           // [rays]
};

struct Particle {
  const float *weights, *pose;        // [size], [6]: yaw, x, y, log-scale, z, range offset
  float *value, *g_weights, *g_pose;  // [1], [size], [6]
};
