// log p(observation | weights, pose) and its gradient, particle by particle: one pass over tiles of whole rays, forwards
// and at once backwards, so that nothing of size points x width is ever stored. Compiled once per instruction set.
#include "colour.h"
#include "pixels.h"

namespace FARSIDE_NAMESPACE {

constexpr float FAR = 1e3f;  // probnerf.foam.FAR
constexpr int OBJECT = 1;

struct TileRange {
  int first_pixel, pixels, points;
};

// The view as tiles see it. With an arena that only counts, only the sizes are right.
struct Prepared {
  Pixel* pixels;
  float* directions;  // [pixels][3]
  TileRange* tiles;
  Crossings crossings;
  int tile_count = 0;

  static int crossed(const View& v, int ray) {
    int n = 0;
    while (n < v.crossings && v.t[ray * v.crossings + n] < FAR) ++n;
    return n;
  }

  Prepared(const View& v, const PixelModel& m, const Sizes& s, Arena& a) {
    int total = 0;
    for (int i = 0; i < v.rays; ++i) total += crossed(v, i);
    pixels = (Pixel*)a.take((v.rays + 1) * (int64_t)sizeof(Pixel) / 4 + 1);
    directions = a.take(3 * (v.rays + 1));
    tiles = (TileRange*)a.take((v.rays + 1) * (int64_t)sizeof(TileRange) / 4 + 1);
    Crossings& c = crossings;
    for (float** p : {&c.at[0], &c.at[1], &c.at[2], &c.t, &c.measured, &c.inverse_deviation, &c.peak, &c.floor})
      *p = a.take(total + s.tile);
    if (!a.next) return;
    for (float* p : {c.at[0], c.at[1], c.at[2], c.t, c.measured, c.inverse_deviation, c.peak, c.floor})
      memset(p, 0, sizeof(float) * (total + s.tile));
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
        pixels[pixel] = {point, n, object, coloured, {}, ranged ? 1.0f / m.outlier_span : 1.0f, v.limit[i]};
        for (int j = 0; j < 3; ++j) pixels[pixel].rgb[j] = v.rgb[3 * i + j], directions[3 * pixel + j] = v.direction[3 * i + j];
        const float* t = v.t + i * v.crossings;
        for (int k = 0; k < n; ++k, ++point) {
          for (int j = 0; j < 3; ++j) c.at[j][point] = v.origin[3 * i + j] + t[k] * v.direction[3 * i + j];
          c.t[point] = t[k];
          c.floor[point] = ranged ? m.outlier / m.outlier_span : 1.0f;
          if (!ranged) continue;
          // the surface lies in the gap before the face (probnerf.foam.gap_before)
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

struct Scratch {
  Layers weights, gradient;
  Transposed transposed;
  Tile tile;
  PixelScratch pixels;
  Direction* directions;
  Scratch(const Sizes& s, int most_pixels, Arena& a)
      : weights(s, a), gradient(s, a), transposed(s, a), tile(s, a), pixels(s, a) {
    directions = (Direction*)a.take(most_pixels * (int64_t)sizeof(Direction) / 4 + 1);
    for (int i = 0; i < most_pixels; ++i) {
      Direction d = Direction::take(s, a);
      if (a.next) directions[i] = d;
    }
  }
};

// The window of probnerf.foam.window at the tile's points, and its derivative by one coordinate.
inline void window(Tile& t) {
  const float margin = 0.1f;
  for (int p = 0; p < t.padded; ++p) {
    int axis = 0;
    for (int i = 1; i < 3; ++i)
      if (fabsf(t.q[i][p]) > fabsf(t.q[axis][p])) axis = i;
    float beyond = fabsf(t.q[axis][p]) - 1.0f, below = 5.0f * (BASE_Z - 0.02f - t.q[2][p]);
    float u = 1.0f - (beyond > below ? beyond : below) / margin;
    float slope = beyond > below ? (t.q[axis][p] > 0.0f ? -1.0f : 1.0f) : 5.0f;
    t.axis[p] = beyond > below ? axis : 2;
    t.slope[p] = u > 0.0f && u < 1.0f ? 6.0f * u * (1.0f - u) * slope / margin : 0.0f;
    u = u < 0.0f ? 0.0f : u > 1.0f ? 1.0f : u;
    t.window[p] = u * u * (3.0f - 2.0f * u);
  }
}

struct PoseMatrix {
  float c, s, inverse, x, y, z;
  explicit PoseMatrix(const float* pose)
      : c(cosf(pose[0])), s(sinf(pose[0])), inverse(expf(-pose[3])), x(pose[1]), y(pose[2]), z(BASE_Z + pose[4]) {}
};

// The gradient by t.gx (and by the window, from t.g_sigma) brought back to fit and pose.
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

inline void one_particle(const Sizes& s, const PixelModel& m, const Prepared& v, Scratch& k, const Particle& o) {
  unpack_weights(s, o.weights, k.weights);
  k.transposed.set(s, k.weights);
  memset(k.gradient.first, 0, sizeof(float) * k.gradient.count);
  for (int i = 0; i < 6; ++i) o.g_pose[i] = 0.0f;
  PoseMatrix pose(o.pose);
  PixelGradient terms;
  Tile& t = k.tile;
  for (int j = 0; j < v.tile_count; ++j) {
    const TileRange& range = v.tiles[j];
    const Pixel* pixels = v.pixels + range.first_pixel;
    int first = pixels[0].first, n = up(range.points, LANES);
    t.count = range.points, t.padded = n;
    for (int p = 0; p < n; p += LANES) {
      Vec x = load(v.crossings.at[0] + first + p) - pose.x, y = load(v.crossings.at[1] + first + p) - pose.y;
      Vec z = load(v.crossings.at[2] + first + p) - pose.z;
      store(t.q[0] + p, pose.inverse * (pose.c * x + pose.s * y));
      store(t.q[1] + p, pose.inverse * (pose.c * y - pose.s * x));
      store(t.q[2] + p, pose.inverse * z + BASE_Z);
    }
    window(t);
    density_forward(s, k.weights, t);
    bool coloured = pixels[0].coloured;
    if (coloured) {
      for (int p = 0; p < n; ++p) t.ray[p] = 0;
      for (int r = 0; r < range.pixels; ++r) {
        const float* d = v.directions + 3 * (range.first_pixel + r);
        Direction& to = k.directions[r];
        to.d[0] = pose.c * d[0] + pose.s * d[1], to.d[1] = pose.c * d[1] - pose.s * d[0], to.d[2] = d[2];
        direction_forward(s, k.weights, to);
        for (int p = 0; p < pixels[r].count; ++p) t.ray[pixels[r].first - first + p] = r;
      }
      colour_forward(s, k.weights, k.directions, t);
    }
    pixel_terms(s, m, v.crossings, pixels, range.pixels, 1.0f / pose.inverse, o.pose[5], t, k.pixels, terms);
    memset(t.g_encoding, 0, sizeof(float) * n * s.E);
    memset(t.gx, 0, sizeof(float) * CHANNELS * s.tile);
    if (coloured) {
      colour_backward(s, k.weights, k.transposed, k.directions, t, k.gradient);
      for (int r = 0; r < range.pixels; ++r) {
        Direction& d = k.directions[r];
        direction_backward(s, k.weights, d, k.gradient);
        o.g_pose[0] += d.gd[0] * d.d[1] - d.gd[1] * d.d[0];
      }
    }
    density_backward(s, k.weights, k.transposed, t, k.gradient);
    encode_backward(s, t.g_encoding, t.encoding, t.gx, n);
    points_backward(s, k.weights, t, k.gradient, pose, o.g_pose);
  }
  pack_weights(s, k.gradient, o.g_weights);
  float nothing = 0.0f;  // not a number where a weight or the pose is none: a ReLU would hide it
  for_each_part(s, k.weights, [&](const float* part, int rows, int columns, int stride, bool transposed) {
    for (int i = 0; i < (transposed ? columns : rows) * stride; ++i) nothing += part[i] * 0.0f;
  });
  for (int i = 0; i < 6; ++i) nothing += o.pose[i] * 0.0f;
  *o.value = (float)terms.value + nothing;
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

// The number of floats that `run` needs.
int64_t scratch_floats(const FieldSizes& f, const PixelModel& m, const View& v) {
  Arena a{nullptr};
  Sizes s(f, tile_of(v));
  Prepared prepared(v, m, s, a);
  Scratch scratch(s, v.rays, a);
  return a.used;
}

void run(const FieldSizes& f, const PixelModel& m, const View& v, const Particle* particles, int count, float* memory) {
  Arena a{memory};
  Sizes s(f, tile_of(v));
  Prepared prepared(v, m, s, a);
  Scratch scratch(s, v.rays, a);
  for (int i = 0; i < count; ++i) one_particle(s, m, prepared, scratch, particles[i]);
}

}  // namespace FARSIDE_NAMESPACE
