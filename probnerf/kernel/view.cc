// log p(observation | weights, pose) and its gradient for each particle. One pass over tiles of whole rays does forward
// and backward together, so no array of size points x width is stored. Compiled once per instruction set.
#include "colour.h"
#include "pixels.h"
#include "place.h"

namespace FARSIDE_NAMESPACE {

constexpr float FAR = 1e3f;  // probnerf.rendering.foam.FAR
constexpr int OBJECT = 1;

struct TileRange {
  int first_pixel, pixels, points;
};

// The view, prepared for tiles. If the arena only counts, only the sizes are valid.
struct Prepared {
  Pixel* pixels;
  float* directions;  // [pixels][3]
  TileRange* tiles;
  Crossings crossings;
  int tile_count = 0, points = 0;

  static int crossed(const View& v, int ray) {
    int n = 0;
    while (n < v.crossings && v.t[ray * v.crossings + n] < FAR) ++n;
    return n;
  }

  Prepared(const View& v, const PixelModel& m, const Sizes& s, Arena& a) {
    for (int i = 0; i < v.rays; ++i) points += crossed(v, i);
    pixels = (Pixel*)a.take((v.rays + 1) * (int64_t)sizeof(Pixel) / 4 + 1);
    directions = a.take(3 * (v.rays + 1));
    tiles = (TileRange*)a.take((v.rays + 1) * (int64_t)sizeof(TileRange) / 4 + 1);
    Crossings& c = crossings;
    for (float** p : {&c.at[0], &c.at[1], &c.at[2], &c.t, &c.measured, &c.inverse_deviation, &c.peak, &c.floor})
      *p = a.take(points + s.tile);
    if (!a.next) return;
    for (float* p : {c.at[0], c.at[1], c.at[2], c.t, c.measured, c.inverse_deviation, c.peak, c.floor})
      memset(p, 0, sizeof(float) * (points + s.tile));
    int pixel = 0, point = 0;
    for (bool coloured : {true, false}) {
      TileRange* tile = nullptr;
      for (int i = 0; i < v.rays; ++i) {
        bool object = i < v.colour_count && v.status[i] == OBJECT;
        if ((!object && !(v.limit[i] > 0.0f)) || coloured != (object && v.rgb_valid[i])) continue;
        int n = crossed(v, i);
        if (!tile || tile->points + n > s.tile) {
          tile = tiles + tile_count++;
          *tile = {pixel, 0, 0};
        }
        bool ranged = object && v.range_valid[i];
        pixels[pixel] = {point, n, object, coloured, {}, ranged ? 1.0f / m.outlier_span : 1.0f, v.limit[i], v.weight[i]};
        for (int j = 0; j < 3; ++j) pixels[pixel].rgb[j] = v.rgb[3 * i + j], directions[3 * pixel + j] = v.direction[3 * i + j];
        const float* t = v.t + i * v.crossings;
        for (int k = 0; k < n; ++k, ++point) {
          for (int j = 0; j < 3; ++j) c.at[j][point] = v.origin[3 * i + j] + t[k] * v.direction[3 * i + j];
          c.t[point] = t[k];
          c.floor[point] = ranged ? m.outlier / m.outlier_span : 1.0f;
          if (!ranged) continue;
          // the surface lies in the gap before the face (probnerf.rendering.foam.gap_before)
          float gap = k ? t[k] - t[k - 1] : (n > 1 ? t[1] - t[0] : 0.0f);
          float variance = v.range_sigma[i] * v.range_sigma[i] + m.wall_sigma * m.wall_sigma + gap * gap / 12.0f;
          c.measured[point] = v.range[i] - (t[k] - 0.5f * gap);
          c.inverse_deviation[point] = 1.0f / sqrtf(variance);
          c.peak[point] = (1.0f - m.outlier) * c.inverse_deviation[point] * 0.398942280f;
        }
        tile->pixels += 1, tile->points += n;
        ++pixel;
      }
    }
  }
};

// The kept crossings of consecutive pixels, from one tile or several.
struct Few {
  Tile tile;
  int* source;            // [tile] index of each crossing in the view
  int* ends;              // [rays] end of each pixel's crossings
  Direction* directions;  // [rays] of each coloured pixel
  int first_pixel = 0, pixels = 0;
  Few(const Sizes& s, int most_pixels, Arena& a) : tile(s, a), source((int*)a.take(s.tile)), ends((int*)a.take(most_pixels)) {
    tile.count = 0;
    directions = (Direction*)a.take(most_pixels * (int64_t)sizeof(Direction) / 4 + 1);
    for (int i = 0; i < most_pixels; ++i) {
      Direction d = Direction::take(s, a);
      if (a.next) directions[i] = d;
    }
  }
};

struct Scratch {
  Layers weights, gradient;
  Transposed transposed;
  Tile tile;
  Composite composite;
  PixelSums* sums;  // [rays]
  Few few;
  Scratch(const Sizes& s, int most_pixels, int points, Arena& a)
      : weights(s, a), gradient(s, a), transposed(s, a), tile(s, a), composite(points + s.tile, a),
        sums((PixelSums*)a.take(most_pixels * (int64_t)sizeof(PixelSums) / 4 + 1)), few(s, most_pixels, a) {}
};

// Backward pass from t.gx (and from t.g_sigma, through the window) to the fit and the pose.
inline void points_backward(const Sizes& s, const Layers& w, Tile& t, Layers& g, const PoseMatrix& pose, float* g_pose) {
  int n = t.padded;
  for (int p = 0; s.radial && p < n; p += LANES) {
    Vec share = load(t.gx + 3 * s.tile + p) / load(t.x + 3 * s.tile + p);
    for (int i = 0; i < 2; ++i) store(t.gx + i * s.tile + p, load(t.gx + i * s.tile + p) + share * load(t.x + i * s.tile + p));
  }
  float sums[3], turned = 0.0f, grown = 0.0f;
  for (int i = 0; i < 3; ++i) {
    Vec moved = {}, stretched = {}, total = {};
    float base = i == 2 ? BASE_Z : 0.0f, factor = s.fitted ? expf(w.stretch[i]) : 1.0f;
    for (int p = 0; p < n; p += LANES) {
      Vec gx = load(t.gx + i * s.tile + p);
      moved += gx, stretched += gx * (load(t.x + i * s.tile + p) - base);
      store(t.gq[i] + p, gx * factor);
    }
    if (s.fitted) g.shift[i] -= factor * sum(moved), g.stretch[i] += sum(stretched);
    for (int p = 0; p < t.count; ++p)
      if (t.axis[p] == i) t.gq[i][p] += t.g_sigma[p] * t.mlp_sigma[p] * t.slope[p];
    for (int p = 0; p < n; p += LANES) total += load(t.gq[i] + p);
    sums[i] = sum(total);
  }
  for (int p = 0; p < n; p += LANES) {
    Vec x = load(t.q[0] + p), y = load(t.q[1] + p), z = load(t.q[2] + p) - BASE_Z;
    Vec gx = load(t.gq[0] + p), gy = load(t.gq[1] + p), gz = load(t.gq[2] + p);
    turned += sum(gx * y - gy * x);
    grown += sum(gx * x + gy * y + gz * z);
  }
  g_pose[0] += turned;
  g_pose[1] -= pose.inverse * (pose.c * sums[0] - pose.s * sums[1]);
  g_pose[2] -= pose.inverse * (pose.s * sums[0] + pose.c * sums[1]);
  g_pose[3] -= grown;
  g_pose[4] -= pose.inverse * sums[2];
}

// The terms of the pixels with crossings in k.few, and their gradient. Empties k.few.
inline void finish(const Sizes& s, const PixelModel& m, const Prepared& v, Scratch& k, const PoseMatrix& pose,
                   const Particle& o, PixelGradient& terms) {
  Few& few = k.few;
  Tile& t = few.tile;
  if (few.pixels == 0) return;
  const Pixel* pixels = v.pixels + few.first_pixel;
  bool coloured = pixels[0].coloured;
  pad(s, t);
  if (coloured) colour_forward(s, k.weights, few.directions, t);
  for (int r = 0; r < few.pixels; ++r)
    pixel_term(m, pixels[r], k.sums[few.first_pixel + r], k.composite, few.source, r ? few.ends[r - 1] : 0, few.ends[r],
               t, terms);
  if (o.g_pose && t.count > 0) {
    float per_density = m.per_density / pose.inverse;
    for (int p = 0; p < t.padded; p += LANES) store(t.g_sigma + p, load(t.g_sigma + p) * per_density);
    memset(t.g_encoding, 0, sizeof(float) * t.padded * s.E);
    memset(t.gx, 0, sizeof(float) * CHANNELS * s.tile);
    if (coloured) {
      colour_backward(s, k.weights, k.transposed, few.directions, t, k.gradient);
      for (int r = 0; r < few.pixels; ++r) {
        Direction& d = few.directions[r];
        direction_backward(s, k.weights, d, k.gradient);
        o.g_pose[0] += d.gd[0] * d.d[1] - d.gd[1] * d.d[0];
      }
    }
    density_backward(s, k.weights, k.transposed, t, k.gradient);
    encode_backward(s, t.g_encoding, t.encoding, t.gx, t.padded);
    points_backward(s, k.weights, t, k.gradient, pose, o.g_pose);
  }
  few.first_pixel += few.pixels;
  few.pixels = t.count = 0;
}

// Densities of a tile's crossings, and all terms without colour.
inline void tile_forward(const Sizes& s, const PixelModel& m, const Prepared& v, const TileRange& range,
                         const PoseMatrix& pose, float offset, Scratch& k) {
  const Pixel* pixels = v.pixels + range.first_pixel;
  Tile& t = k.tile;
  int first = pixels[0].first, n = up(range.points, LANES);
  t.count = range.points, t.padded = n;
  for (int p = 0; p < n; p += LANES) {
    Vec at[3], q[3];
    for (int i = 0; i < 3; ++i) at[i] = load(v.crossings.at[i] + first + p);
    pose.to_object(at[0], at[1], at[2], q);
    for (int i = 0; i < 3; ++i) store(t.q[i] + p, q[i]);
    Window w = window(q[0], q[1], q[2]);
    store(t.window + p, w.value), store(t.slope + p, w.slope), memcpy(t.axis + p, &w.axis, sizeof w.axis);
  }
  density_forward(s, k.weights, t);
  composite(m, v.crossings, pixels, range.pixels, m.per_density / pose.inverse, offset, t, k.composite,
            k.sums + range.first_pixel);
}

inline void one_particle(const Sizes& s, const PixelModel& m, const Prepared& v, Scratch& k, const Particle& o) {
  unpack_weights(s, o.weights, k.weights);
  if (o.g_pose) {
    k.transposed.set(s, k.weights);
    memset(k.gradient.first, 0, sizeof(float) * k.gradient.count);
    for (int i = 0; i < 6; ++i) o.g_pose[i] = 0.0f;
  }
  PoseMatrix pose(o.pose);
  PixelGradient terms;
  Few& few = k.few;
  for (int j = o.part; j < v.tile_count; j += o.parts) {
    const TileRange& range = v.tiles[j];
    tile_forward(s, m, v, range, pose, o.pose[5], k);
    for (int i = 0; i < range.pixels; ++i) {
      int pixel = range.first_pixel + i;
      const Pixel& ray = v.pixels[pixel];
      const float* weight = k.composite.weight + ray.first;
      int counted = 0;
      for (int p = 0; p < ray.count; ++p) counted += weight[p] > NEGLIGIBLE;
      bool next = few.pixels && few.first_pixel + few.pixels != pixel;  // another thread has the tile in between
      if (next || few.tile.count + counted > s.tile || (few.pixels && v.pixels[few.first_pixel].coloured != ray.coloured))
        finish(s, m, v, k, pose, o, terms);
      if (few.pixels == 0) few.first_pixel = pixel, few.tile.count = 0;
      if (ray.coloured) {
        const float* d = v.directions + 3 * pixel;
        Direction& to = few.directions[few.pixels];
        to.d[0] = pose.c * d[0] + pose.s * d[1], to.d[1] = pose.c * d[1] - pose.s * d[0], to.d[2] = d[2];
        direction_forward(s, k.weights, to);
      }
      int first = v.pixels[range.first_pixel].first;
      for (int p = 0, end; p < ray.count; p = end) {  // runs of kept crossings
        end = p + 1;
        if (!(weight[p] > NEGLIGIBLE)) continue;
        while (end < ray.count && weight[end] > NEGLIGIBLE) ++end;
        int to = few.tile.count;
        few.tile.count += end - p;
        copy_points(s, k.tile, ray.first - first + p, end - p, few.tile, to);
        for (int i = 0; i < end - p; ++i) few.source[to + i] = ray.first + p + i, few.tile.ray[to + i] = few.pixels;
      }
      few.ends[few.pixels++] = few.tile.count;
    }
  }
  finish(s, m, v, k, pose, o, terms);
  *o.value = (float)terms.value + nothing(s, k.weights, o.pose);
  if (!o.g_pose) return;
  pack_weights(s, k.gradient, o.g_weights);
  o.g_pose[3] += terms.log_scale;
  o.g_pose[5] = terms.offset;
}

inline int tile_of(const View& v) {
  int longest = 0;
  for (int i = 0; i < v.rays; ++i) {
    int n = Prepared::crossed(v, i);
    if (n > longest) longest = n;
  }
  return up(longest > FARSIDE_TILE ? longest : FARSIDE_TILE, 16);
}

// The number of floats that `run_view` needs.
int64_t view_floats(const FieldSizes& f, const PixelModel& m, const View& v) {
  Arena a{nullptr};
  Sizes s(f, tile_of(v));
  Prepared prepared(v, m, s, a);
  Scratch scratch(s, v.rays, prepared.points, a);
  return a.used;
}

void run_view(const FieldSizes& f, const PixelModel& m, const View& v, const Particle* particles, int count,
              float* memory) {
  Arena a{memory};
  Sizes s(f, tile_of(v));
  Prepared prepared(v, m, s, a);
  Scratch scratch(s, v.rays, prepared.points, a);
  for (int i = 0; i < count; ++i) one_particle(s, m, prepared, scratch, particles[i]);
}

}  // namespace FARSIDE_NAMESPACE
