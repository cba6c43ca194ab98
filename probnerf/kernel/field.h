// MLPField on a tile of points, forward and backward: the arithmetic of probnerf/fields/mlp.py. Vector lanes hold
// hidden units or features ([point][unit]). Only encodings are computed for LANES points at a time.
#pragma once

#include "problem.h"
#include "simd.h"

namespace FARSIDE_NAMESPACE {


constexpr int CHANNELS = 4;
constexpr float BASE_Z = -0.75f;

struct Sizes {
  int width, octaves, direction_octaves, channels;
  bool radial, fitted;
  float density_scale;
  int encoded, encoded_direction;  // features of a point and of a direction
  int H, E;                        // units of a layer and features of a point, rounded up to whole vectors
  int tile;                               // points per tile: they and their layers fit in the L2 cache
  Sizes(const FieldSizes& f, int tile)
      : width(f.width), octaves(f.octaves), direction_octaves(f.direction_octaves), channels(3 + f.radial),
        radial(f.radial), fitted(f.fitted), density_scale(f.density_scale), tile(tile) {
    encoded = channels * (1 + 2 * octaves);
    encoded_direction = 3 * (1 + 2 * direction_octaves);
    H = up(width, LANES);
    E = up(encoded, LANES);
  }
};

// Allocates from one block of memory, at multiples of 64 bytes. Without a block, it only counts the size needed.
struct Arena {
  float* next;
  int64_t used = 0;
  float* take(int64_t count) {
    float* p = next;
    count = (count + 15) / 16 * 16;
    used += count;
    if (next) next += count;
    return p;
  }
};

// One object's weights, or their gradient. Rows are padded to whole vectors.
struct Layers {
  float *k0, *b0, *k1, *b1, *k2, *b2;                     // density: [encoded][H], [H], [width][H], [H], [H], [1]
  float *k3, *k3d, *k3s, *b3, *k4, *b4, *k5, *b5;         // colour: k3's rows for point, direction, density; k5 [3][H]
  float *stretch, *shift;                                 // [3], [3]
  float* first;
  int64_t count;
  Layers(const Sizes& s, Arena& a) {
    first = a.next;
    int64_t before = a.used;
    int H = s.H;
    k0 = a.take(s.encoded * H), b0 = a.take(H), k1 = a.take(s.width * H), b1 = a.take(H), k2 = a.take(H), b2 = a.take(1);
    k3 = a.take(s.encoded * H), k3d = a.take(s.encoded_direction * H), k3s = a.take(H), b3 = a.take(H);
    k4 = a.take(s.width * H), b4 = a.take(H), k5 = a.take(3 * H), b5 = a.take(3);
    stretch = a.take(3), shift = a.take(3);
    count = a.used - before;
  }
};

// Calls visit(part, rows, columns, row stride, transposed) in the order of the flat vector (MLPField.shapes).
template <class Visit>
inline void for_each_part(const Sizes& s, const Layers& l, Visit visit) {
  visit(l.k0, s.encoded, s.width, s.H, false), visit(l.b0, 1, s.width, s.H, false);
  visit(l.k1, s.width, s.width, s.H, false), visit(l.b1, 1, s.width, s.H, false);
  visit(l.k2, s.width, 1, s.H, true), visit(l.b2, 1, 1, 1, false);
  visit(l.k3, s.encoded, s.width, s.H, false), visit(l.k3d, s.encoded_direction, s.width, s.H, false);
  visit(l.k3s, 1, s.width, s.H, false), visit(l.b3, 1, s.width, s.H, false);
  visit(l.k4, s.width, s.width, s.H, false), visit(l.b4, 1, s.width, s.H, false);
  visit(l.k5, s.width, 3, s.H, true), visit(l.b5, 1, 3, 3, false);
  if (s.fitted) visit(l.stretch, 1, 3, 3, false), visit(l.shift, 1, 3, 3, false);
}

inline void unpack_weights(const Sizes& s, const float* flat, Layers& l) {
  memset(l.first, 0, sizeof(float) * l.count);
  for_each_part(s, l, [&](float* part, int rows, int columns, int stride, bool transposed) {
    for (int i = 0; i < rows; ++i)
      for (int j = 0; j < columns; ++j) part[transposed ? j * stride + i : i * stride + j] = *flat++;
  });
}

inline void pack_weights(const Sizes& s, const Layers& l, float* flat) {
  for_each_part(s, l, [&](const float* part, int rows, int columns, int stride, bool transposed) {
    for (int i = 0; i < rows; ++i)
      for (int j = 0; j < columns; ++j) *flat++ = part[transposed ? j * stride + i : i * stride + j];
  });
}

struct Transposed {
  float *k0, *k1, *k3, *k4;  // [width][E], [width][H], [width][E], [width][H]
  Transposed(const Sizes& s, Arena& a)
      : k0(a.take(s.width * s.E)), k1(a.take(s.width * s.H)), k3(a.take(s.width * s.E)),
        k4(a.take(s.width * s.H)) {}
  void set(const Sizes& s, const Layers& l) {
    one(s, l.k0, s.encoded, k0, s.E), one(s, l.k1, s.width, k1, s.H), one(s, l.k3, s.encoded, k3, s.E);
    one(s, l.k4, s.width, k4, s.H);
  }

 private:
  static void one(const Sizes& s, const float* from, int rows, float* to, int stride) {
    for (int j = 0; j < s.width; ++j) {
      for (int i = 0; i < rows; ++i) to[j * stride + i] = from[i * s.H + j];
      for (int i = rows; i < stride; ++i) to[j * stride + i] = 0.0f;
    }
  }
};

// All data of one tile. Rows [.][tile] have a point per lane, rows [tile][.] a unit or feature per lane.
struct Tile {
  int count, padded;                   // points; the next multiple of LANES
  float *q[3], *gq[3];                 // points in the object frame, and their gradient
  float *x, *gx;                       // [4][tile] input points of the field: after the fit, with the radius
  float *encoding, *g_encoding;        // [encoded][tile], [tile][E]
  float *h0, *h1, *c0, *c1, *g0, *g1;  // [tile][H]
  float *output, *mlp_sigma;           // the density network's output, and its density before the window
  float *window, *slope;               // window, and its derivative with respect to ...
  int* axis;                           // ... this coordinate
  float *sigma, *g_sigma;              // density with the window
  float* log_sigma;                    // log(1 + sigma), the colour network's input
  float *colour[3], *g_colour[3];
  int* ray;                            // index of each point's ray in the tile
  Tile(const Sizes& s, Arena& a) {
    for (int i = 0; i < 3; ++i) q[i] = a.take(s.tile), gq[i] = a.take(s.tile), colour[i] = a.take(s.tile), g_colour[i] = a.take(s.tile);
    x = a.take(CHANNELS * s.tile), gx = a.take(CHANNELS * s.tile);
    encoding = a.take(s.encoded * s.tile), g_encoding = a.take(s.tile * s.E);
    for (float** h : {&h0, &h1, &c0, &c1, &g0, &g1}) *h = a.take(s.tile * s.H);
    for (float** h : {&output, &mlp_sigma, &window, &slope, &sigma, &g_sigma, &log_sigma}) *h = a.take(s.tile);
    axis = (int*)a.take(s.tile), ray = (int*)a.take(s.tile);
  }
};

// Copies `count` points, from p, of a tile with known densities to another tile, from `to`.
inline void copy_points(const Sizes& s, const Tile& from, int p, int count, Tile& t, int to) {
  auto copy = [&](const float* a, float* b) {
    for (int i = 0; i < count; ++i) b[to + i] = a[p + i];
  };
  for (int i = 0; i < 3; ++i) copy(from.q[i], t.q[i]);
  for (int c = 0; c < s.channels; ++c) copy(from.x + c * s.tile, t.x + c * s.tile);
  for (int f = 0; f < s.encoded; ++f) copy(from.encoding + f * s.tile, t.encoding + f * s.tile);
  memcpy(t.h0 + to * s.H, from.h0 + p * s.H, sizeof(float) * s.H * count);
  memcpy(t.h1 + to * s.H, from.h1 + p * s.H, sizeof(float) * s.H * count);
  copy(from.output, t.output), copy(from.mlp_sigma, t.mlp_sigma), copy(from.sigma, t.sigma);
  copy(from.window, t.window), copy(from.slope, t.slope);
  for (int i = 0; i < count; ++i) t.axis[to + i] = from.axis[p + i];
}

// Padding points that fill the last vector. They do not contribute.
inline void pad(const Sizes& s, Tile& t) {
  t.padded = up(t.count, LANES);
  for (int p = t.count; p < t.padded; ++p) {
    for (int i = 0; i < 3; ++i) t.q[i][p] = t.g_colour[i][p] = 0.0f;
    for (int c = 0; c < s.channels; ++c) t.x[c * s.tile + p] = 1.0f;
    for (int f = 0; f < s.encoded; ++f) t.encoding[f * s.tile + p] = 0.0f;
    memset(t.h0 + p * s.H, 0, sizeof(float) * s.H);
    memset(t.h1 + p * s.H, 0, sizeof(float) * s.H);
    t.output[p] = t.mlp_sigma[p] = t.sigma[p] = t.window[p] = t.slope[p] = t.g_sigma[p] = 0.0f;
    t.ray[p] = 0;
  }
}

inline void fill_rows(float* c, int rows, int columns, const float* row) {
  for (int r = 0; r < rows; ++r)
    for (int v = 0; v < columns; v += LANES) store(c + r * columns + v, load(row + v));
}
inline void add_rows(float* total, const float* a, int rows, int columns) {
  for (int v = 0; v < columns; v += LANES) {
    Vec t = load(total + v);
    for (int r = 0; r < rows; ++r) t += load(a + r * columns + v);
    store(total + v, t);
  }
}
inline void relu(float* h, int count) {
  for (int i = 0; i < count; i += LANES) store(h + i, maximum(load(h + i), Vec{}));
}
inline void only_where_positive(float* g, const float* h, int count) {
  for (int i = 0; i < count; i += LANES) store(g + i, value(bits(load(g + i)) & (load(h + i) > 0.0f)));
}
inline float total(const float* a, int count) {
  Vec t = {};
  for (int i = 0; i < count; i += LANES) t += load(a + i);
  return sum(t);
}
// out[r] = a[r] . b for rows of `columns`; both numbers are multiples of LANES.
inline void dot_rows(const float* a, int rows, int columns, const float* b, float* out) {
  for (int r = 0; r < rows; r += LANES) {
    Vec parts[LANES];
    for (int i = 0; i < LANES; ++i) {
      parts[i] = load(a + (r + i) * columns) * load(b);
      for (int v = LANES; v < columns; v += LANES) parts[i] += load(a + (r + i) * columns + v) * load(b + v);
    }
    store(out + r, sums(parts));
  }
}
inline float dot(const float* a, const float* b, int count) {
  Vec t = {};
  for (int i = 0; i < count; i += LANES) t += load(a + i) * load(b + i);
  return sum(t);
}

// Features [x, sin 2^j pi x, cos 2^j pi x] of every channel, in the order of probnerf.fields.mlp.encode.
inline void encode(const Sizes& s, const float* x, int channels, int octaves, float* out, int n) {
  for (int c = 0; c < channels; ++c)
    for (int p = 0; p < n; p += LANES) {
      Vec at = load(x + c * s.tile + p), sine = at, cosine = at;
      store(out + c * s.tile + p, at);
      for (int j = 0; j < octaves; ++j) {
        if (j % 3 == 0) {
          sincospi(at * float(1 << j), sine, cosine);
        } else {
          Vec twice = 2.0f * sine * cosine;
          cosine = (cosine - sine) * (cosine + sine);
          sine = twice;
        }
        store(out + ((1 + 2 * j) * channels + c) * s.tile + p, sine);
        store(out + ((2 + 2 * j) * channels + c) * s.tile + p, cosine);
      }
    }
}

// g_x[c] += the gradient through the encoding; g is [point][E].
inline void encode_backward(const Sizes& s, const float* g, const float* encoding, float* gx, int n) {
  int C = s.channels;
  for (int p = 0; p < n; p += LANES) {
    // gradients of LANES points, transposed so that lanes hold points
    float turned[256 * LANES] __attribute__((aligned(64)));
    for (int f = 0; f < s.E; f += LANES) transpose(g + p * s.E + f, s.E, turned + f * LANES);
    for (int c = 0; c < C; ++c) {
      Vec total = load(gx + c * s.tile + p) + load(turned + c * LANES);
      for (int j = 0; j < s.octaves; ++j) {
        int sine = (1 + 2 * j) * C + c, cosine = sine + C;
        Vec part = load(turned + sine * LANES) * load(encoding + cosine * s.tile + p) -
                   load(turned + cosine * LANES) * load(encoding + sine * s.tile + p);
        total += float(1 << j) * 3.14159265f * part;
      }
      store(gx + c * s.tile + p, total);
    }
  }
}

// Computes a tile's density from t.q.
inline void density_forward(const Sizes& s, const Layers& w, Tile& t) {
  int n = t.padded;
  for (int i = 0; i < 3; ++i) {
    float base = i == 2 ? BASE_Z : 0.0f;
    float shift = s.fitted ? w.shift[i] : 0.0f, factor = s.fitted ? expf(w.stretch[i]) : 1.0f;
    for (int p = 0; p < n; p += LANES) store(t.x + i * s.tile + p, (load(t.q[i] + p) - base - shift) * factor + base);
  }
  for (int p = 0; s.radial && p < n; p += LANES) {
    Vec a = load(t.x + p), b = load(t.x + s.tile + p);
    store(t.x + 3 * s.tile + p, root(a * a + b * b + 1e-4f));
  }
  encode(s, t.x, s.channels, s.octaves, t.encoding, n);
  fill_rows(t.h0, n, s.H, w.b0);
  multiply(n, s.H, s.encoded, t.encoding, 1, s.tile, w.k0, s.H, t.h0, s.H);
  relu(t.h0, n * s.H);
  fill_rows(t.h1, n, s.H, w.b1);
  multiply(n, s.H, s.width, t.h0, s.H, 1, w.k1, s.H, t.h1, s.H);
  relu(t.h1, n * s.H);
  dot_rows(t.h1, n, s.H, w.k2, t.output);
  for (int p = 0; p < n; p += LANES) {
    Vec o = load(t.output + p) + w.b2[0];
    store(t.output + p, o);
    Vec density = s.density_scale * (maximum(o, Vec{}) + log1p(exp(-absolute(o))));  // softplus
    store(t.mlp_sigma + p, density);
    store(t.sigma + p, density * load(t.window + p));
  }
}

// Backward pass from t.g_sigma and t.g_encoding to the weights and t.gx. t.gx must be zero or colour's gradient before.
inline void density_backward(const Sizes& s, const Layers& w, const Transposed& wt, Tile& t, Layers& g) {
  int n = t.padded;
  float* go = t.output;  // the derivative of softplus is the logistic function
  for (int p = 0; p < n; p += LANES) {
    Vec o = load(t.output + p);
    Vec logistic = 1.0f / (1.0f + exp(-o));
    store(go + p, load(t.g_sigma + p) * load(t.window + p) * s.density_scale * logistic);
  }
  for (int v = 0; v < s.H; v += LANES) {
    Vec k = load(w.k2 + v), gk = load(g.k2 + v);
    for (int p = 0; p < n; ++p) {
      Vec h = load(t.h1 + p * s.H + v);
      store(t.g1 + p * s.H + v, value(bits(go[p] * k) & (h > 0.0f)));
      gk += go[p] * h;
    }
    store(g.k2 + v, gk);
  }
  g.b2[0] += total(go, n);
  multiply(s.width, s.H, n, t.h0, 1, s.H, t.g1, s.H, g.k1, s.H);
  add_rows(g.b1, t.g1, n, s.H);
  memset(t.g0, 0, sizeof(float) * n * s.H);
  multiply(n, s.H, s.width, t.g1, s.H, 1, wt.k1, s.H, t.g0, s.H);
  only_where_positive(t.g0, t.h0, n * s.H);
  multiply(s.encoded, s.H, n, t.encoding, s.tile, 1, t.g0, s.H, g.k0, s.H);
  add_rows(g.b0, t.g0, n, s.H);
  multiply(n, s.E, s.width, t.g0, s.H, 1, wt.k0, s.E, t.g_encoding, s.E);
}

}  // namespace FARSIDE_NAMESPACE
