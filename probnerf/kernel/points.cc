// Window x density at points of the view frame. Threads take pieces of one shape's points in turn. The pieces do not
// depend on the number of threads, so the result does not either. Compiled once per instruction set.
#include "place.h"

namespace FARSIDE_NAMESPACE {

constexpr int64_t PIECE = 1024;  // points per piece

struct Inside {  // a tile's points inside the window, and their indices in the shape
  Layers weights;
  Tile tile;
  int64_t* index;
  Inside(const Sizes& s, Arena& a) : weights(s, a), tile(s, a), index((int64_t*)a.take(2 * s.tile)) {}
};

inline void evaluate(const Sizes& s, Inside& k, float* density) {
  Tile& t = k.tile;
  t.padded = up(t.count, LANES);
  for (float* a : {t.q[0], t.q[1], t.q[2], t.window})
    for (int p = t.count; p < t.padded; ++p) a[p] = 0.0f;
  density_forward(s, k.weights, t);
  for (int p = 0; p < t.count; ++p) density[k.index[p]] += t.sigma[p];
  t.count = 0;
}

int64_t points_floats(const FieldSizes& f) {
  Arena a{nullptr};
  Inside inside(Sizes(f, FARSIDE_TILE), a);
  return a.used;
}

void run_points(const FieldSizes& f, const Points& points, const Shape* shapes, int64_t count, int64_t* next,
                float* memory) {
  Arena a{memory};
  Sizes s(f, FARSIDE_TILE);
  Inside inside(s, a);
  Tile& t = inside.tile;
  const Shape* unpacked = nullptr;
  float none = 0.0f;
  int64_t pieces = (points.count + PIECE - 1) / PIECE, item;
  while ((item = __atomic_fetch_add(next, 1, __ATOMIC_RELAXED)) < count * pieces) {
    const Shape& shape = shapes[item / pieces];
    if (unpacked != &shape) {
      unpack_weights(s, shape.weights, inside.weights);
      none = nothing(s, inside.weights, shape.pose);
      unpacked = &shape;
    }
    PoseMatrix pose(shape.pose);
    int64_t begin = item % pieces * PIECE, end = begin + PIECE < points.count ? begin + PIECE : points.count;
    t.count = 0;
    for (int64_t i = begin; i < end; i += LANES) {
      Vec at[3] = {}, q[3];
      int64_t lanes = end - i < LANES ? end - i : LANES;
      for (int64_t k = 0; k < lanes; ++k)
        for (int j = 0; j < 3; ++j) at[j][k] = points.at[3 * (i + k) + j];
      pose.to_object(at[0], at[1], at[2], q);
      Vec within = window(q[0], q[1], q[2]).value, nan = none + 0.0f * (q[0] + q[1] + q[2]);
      for (int64_t k = 0; k < lanes; ++k) {
        shape.density[i + k] = nan[k];
        if (within[k] == 0.0f) continue;
        for (int j = 0; j < 3; ++j) t.q[j][t.count] = q[j][k];
        t.window[t.count] = within[k], inside.index[t.count] = i + k;
        if (++t.count == s.tile) evaluate(s, inside, shape.density);
      }
    }
    evaluate(s, inside, shape.density);
  }
}

}  // namespace FARSIDE_NAMESPACE
