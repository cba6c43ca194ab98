// Vectors of floats, with the compiler's vector extension, and a few functions of them. Compiled once per instruction
// set, each in its own namespace. No standard library templates: their instantiations would be shared between the sets.
#pragma once

#include <math.h>
#include <stdint.h>
#include <string.h>

#include <utility>

#define FARSIDE_JOIN_(a, b) a##b
#define FARSIDE_JOIN(a, b) FARSIDE_JOIN_(a, b)
#define FARSIDE_NAMESPACE FARSIDE_JOIN(farside_, FARSIDE_ISA)

namespace FARSIDE_NAMESPACE {

constexpr int LANES = FARSIDE_LANES;
typedef float Vec __attribute__((vector_size(4 * LANES)));
typedef int32_t Int __attribute__((vector_size(4 * LANES)));

inline Vec load(const float* p) {
  Vec v;
  memcpy(&v, p, sizeof v);
  return v;
}
inline void store(float* p, Vec v) { memcpy(p, &v, sizeof v); }
inline Vec splat(float x) { return x - Vec{}; }  // minus zero keeps the sign of a zero
inline Int bits(Vec v) { return (Int)v; }
inline Vec value(Int v) { return (Vec)v; }
inline Vec select(Int mask, Vec yes, Vec no) { return value((mask & bits(yes)) | (~mask & bits(no))); }
inline Vec maximum(Vec a, Vec b) { return select(a > b, a, b); }
inline Vec minimum(Vec a, Vec b) { return select(a < b, a, b); }
inline Vec absolute(Vec a) { return value(bits(a) & 0x7fffffff); }
inline float sum(Vec v) {
  float s = 0.0f;
  for (int i = 0; i < LANES; ++i) s += v[i];
  return s;
}
inline int up(int n, int step) { return (n + step - 1) / step * step; }

inline Vec root(Vec v) {
  for (int i = 0; i < LANES; ++i) v[i] = __builtin_sqrtf(v[i]);
  return v;
}

// Exchanges the off-diagonal blocks of S lanes of rows a and b.
template <int S, int... I>
inline void exchange(Vec& a, Vec& b, std::integer_sequence<int, I...>) {
  Vec low = __builtin_shufflevector(a, b, (I & S ? LANES + I - S : I)...);
  b = __builtin_shufflevector(a, b, (I & S ? LANES + I : I + S)...);
  a = low;
}
template <int S>
inline void exchange_all(Vec* rows) {
  if constexpr (S < LANES) {
    for (int i = 0; i < LANES; ++i)
      if (!(i & S)) exchange<S>(rows[i], rows[i + S], std::make_integer_sequence<int, LANES>());
    exchange_all<2 * S>(rows);
  }
}
// to[j][i] = from[i][j] for LANES x LANES numbers; rows of `from` are `stride` apart.
inline void transpose(const float* from, long stride, float* to) {
  Vec rows[LANES];
  for (int i = 0; i < LANES; ++i) rows[i] = load(from + i * stride);
  exchange_all<1>(rows);
  for (int i = 0; i < LANES; ++i) store(to + i * LANES, rows[i]);
}

// Lane i is the sum of rows[i], for LANES rows. The rows are overwritten.
template <int S = 1>
inline Vec sums(Vec* rows) {
  if constexpr (S < LANES) {
    for (int i = 0; i < LANES; i += 2 * S) {
      exchange<S>(rows[i], rows[i + S], std::make_integer_sequence<int, LANES>());
      rows[i] += rows[i + S];
    }
    return sums<2 * S>(rows);
  }
  return rows[0];
}

// Round to nearest for |x| < 2^22.
inline Vec nearest(Vec x) { return (x + 12582912.0f) - 12582912.0f; }
inline Vec power_of_two(Vec n) {  // n is an integer from -126 to 127
  return value((__builtin_convertvector(n, Int) + 127) << 23);
}

struct Exp {
  Vec value, minus_one;  // exp(x), exp(x) - 1; the second is accurate near 0
};

// Cody and Waite's reduction, then the polynomial of cephes' expf.
inline Exp exp_both(Vec x) {
  x = minimum(maximum(x, splat(-87.0f)), splat(88.0f));
  Vec n = nearest(x * 1.44269504f);
  Vec r = x - n * 0.693359375f;
  r = r + n * 2.12194440e-4f;
  Vec p = 1.9875691500e-4f * r + 1.3981999507e-3f;
  p = p * r + 8.3334519073e-3f;
  p = p * r + 4.1665795894e-2f;
  p = p * r + 1.6666665459e-1f;
  p = p * r + 5.0000001201e-1f;
  Vec m = p * r * r + r;
  Vec scale = power_of_two(n);
  return {scale * m + scale, scale * m + (scale - 1.0f)};
}
inline Vec exp(Vec x) { return exp_both(x).value; }

// cephes' logf, for normal positive x.
inline Vec log(Vec x) {
  Int i = bits(x) - 0x3f3504f3;  // sqrt(1/2)
  Vec n = __builtin_convertvector(i >> 23, Vec);
  Vec m = value((i & 0x007fffff) + 0x3f3504f3) - 1.0f;
  Vec z = m * m;
  Vec p = 7.0376836292e-2f * m - 1.1514610310e-1f;
  p = p * m + 1.1676998740e-1f;
  p = p * m - 1.2420140846e-1f;
  p = p * m + 1.4249322787e-1f;
  p = p * m - 1.6668057665e-1f;
  p = p * m + 2.0000714765e-1f;
  p = p * m - 2.4999993993e-1f;
  p = p * m + 3.3333331174e-1f;
  Vec y = p * m * z - n * 2.12194440e-4f - 0.5f * z;
  return m + y + n * 0.693359375f;
}
// x >= 0.
inline Vec log1p(Vec x) {
  Vec y = x + 1.0f;
  return log(y) + (x - (y - 1.0f)) / y;
}

// sin(pi u), cos(pi u): the arithmetic of probnerf.fields.mlp.sincospi.
inline void sincospi(Vec u, Vec& sine, Vec& cosine) {
  Vec half = 0.5f * u;
  Vec h = half - nearest(half);
  Vec y = h * h;
  Vec s = -0.00737043f * y + 0.08214589f;
  s = s * y - 0.59926453f;
  s = s * y + 2.55016404f;
  s = s * y - 5.16771278f;
  s = h * (s * y + 3.14159265f);
  Vec c = 0.00192957f * y - 0.02580689f;
  c = c * y + 0.23533063f;
  c = c * y - 1.33526277f;
  c = c * y + 4.05871213f;
  c = c * y - 4.93480220f;
  c = c * y + 1.0f;
  sine = 2.0f * s * c;
  cosine = (c - s) * (c + s);
}

// c[r][v] += sum over k of a[r ar + k ak] b[k bk + v] for R rows and V vectors of columns, in registers.
template <int R, int V>
inline void multiply_block(int k, const float* a, long ar, long ak, const float* b, long bk, float* c, long cr) {
  Vec sums[R][V];
  for (int r = 0; r < R; ++r)
    for (int v = 0; v < V; ++v) sums[r][v] = load(c + r * cr + v * LANES);
  for (int i = 0; i < k; ++i) {
    Vec row[V];
    for (int v = 0; v < V; ++v) row[v] = load(b + i * bk + v * LANES);
    for (int r = 0; r < R; ++r) {
      float x = a[r * ar + i * ak];
      for (int v = 0; v < V; ++v) sums[r][v] += x * row[v];
    }
  }
  for (int r = 0; r < R; ++r)
    for (int v = 0; v < V; ++v) store(c + r * cr + v * LANES, sums[r][v]);
}

template <int V>
inline void multiply_columns(int rows, int k, const float* a, long ar, long ak, const float* b, long bk, float* c,
                             long cr) {
  constexpr int R = LANES == 16 ? 8 : 4;  // as many sums as fit in the registers
  int r = 0;
  for (; r + R <= rows; r += R) multiply_block<R, V>(k, a + r * ar, ar, ak, b, bk, c + r * cr, cr);
  if (R > 4 && r + 4 <= rows) {
    multiply_block<4, V>(k, a + r * ar, ar, ak, b, bk, c + r * cr, cr);
    r += 4;
  }
  for (; r < rows; ++r) multiply_block<1, V>(k, a + r * ar, ar, ak, b, bk, c + r * cr, cr);
}

// The same for any number of rows; `columns` is a multiple of LANES.
inline void multiply(int rows, int columns, int k, const float* a, long ar, long ak, const float* b, long bk, float* c,
                     long cr) {
  int v = 0, vectors = columns / LANES;
  while (v < vectors) {
    int left = vectors - v;
    const float* bv = b + v * LANES;
    float* cv = c + v * LANES;
    if (left == 3 || left > 4) {
      multiply_columns<3>(rows, k, a, ar, ak, bv, bk, cv, cr);
      v += 3;
    } else if (left >= 2) {
      multiply_columns<2>(rows, k, a, ar, ak, bv, bk, cv, cr);
      v += 2;
    } else {
      multiply_columns<1>(rows, k, a, ar, ak, bv, bk, cv, cr);
      v += 1;
    }
  }
}

}  // namespace FARSIDE_NAMESPACE
