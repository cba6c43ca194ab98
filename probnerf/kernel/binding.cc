// The XLA FFI handler. It checks shapes, selects the instruction set and distributes work over threads.
#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <memory>
#include <numeric>
#include <string>
#include <string_view>
#include <system_error>
#include <thread>
#include <vector>

#include "problem.h"
#include "xla/ffi/api/ffi.h"

#define FARSIDE_DECLARE(isa)                                                                  \
  namespace farside_##isa {                                                                   \
  int64_t view_floats(const FieldSizes&, const PixelModel&, const View&);                     \
  void run_view(const FieldSizes&, const PixelModel&, const View&, const Particle*, int, float*); \
  int64_t points_floats(const FieldSizes&);                                                   \
  void run_points(const FieldSizes&, const Points&, const Shape*, int64_t, int64_t*, float*); \
  }
#define FARSIDE_ENTRY(isa) \
  {#isa, farside_##isa::view_floats, farside_##isa::run_view, farside_##isa::points_floats, farside_##isa::run_points}

struct Code {
  const char* name;
  int64_t (*view_floats)(const FieldSizes&, const PixelModel&, const View&);
  void (*run_view)(const FieldSizes&, const PixelModel&, const View&, const Particle*, int, float*);
  int64_t (*points_floats)(const FieldSizes&);
  void (*run_points)(const FieldSizes&, const Points&, const Shape*, int64_t, int64_t*, float*);
};

FARSIDE_DECLARE(plain)
#ifdef __x86_64__
FARSIDE_DECLARE(avx2)
FARSIDE_DECLARE(avx512)
#endif

// The widest instruction set of this machine, or the requested one; null if it is not available.
static const Code* code(std::string_view asked) {
  static const std::vector<Code> have = [] {
    std::vector<Code> all;
#ifdef __x86_64__
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512vl"))
      all.push_back(FARSIDE_ENTRY(avx512));
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) all.push_back(FARSIDE_ENTRY(avx2));
#endif
    all.push_back(FARSIDE_ENTRY(plain));
    return all;
  }();
  for (const Code& c : have)
    if (asked.empty() || asked == c.name) return &c;
  return nullptr;
}

// Runs work(i, memory) for i < count, each on its own thread, or on this thread if the system cannot start another.
// Returns false if memory for that many floats could not be allocated.
template <class Work>
static bool on_threads(int count, int64_t floats, const Work& work) {
  std::atomic<bool> enough{true};
  auto one = [&](int i) {
    std::unique_ptr<float, void (*)(void*)> memory((float*)std::aligned_alloc(64, (floats + 31) / 16 * 64), std::free);
    if (memory) work(i, memory.get());
    if (!memory) enough = false;
  };
  std::vector<std::thread> pool;
  pool.reserve(count);
  try {
    while (int(pool.size()) + 1 < count) pool.emplace_back(one, int(pool.size()) + 1);
  } catch (const std::system_error&) {
  }
  int begun = int(pool.size()) + 1;
  one(0);
  for (int i = begun; i < count; ++i) one(i);
  for (std::thread& thread : pool) thread.join();
  return enough;
}

namespace ffi = xla::ffi;
using F32 = ffi::Buffer<ffi::F32>;
using S32 = ffi::Buffer<ffi::S32>;
using F32Result = ffi::Result<F32>;

static ffi::Error wrong(const std::string& what) { return ffi::Error::InvalidArgument(what); }

// The error for a field of these sizes with this many weights and poses, or "" if there is none.
static std::string wrong_with(const FieldSizes& f, const F32& weights, const F32& pose) {
  if (weights.dimensions().size() != 2) return "weights must be a matrix";
  if (f.width < 1 || f.octaves < 0 || f.direction_octaves < 0) return "a field has a width, and no less than 0 octaves";
  if (f.octaves > MOST_OCTAVES || f.direction_octaves > MOST_OCTAVES)
    return "at most " + std::to_string(MOST_OCTAVES) + " octaves";
  int64_t h = f.width, size = weights.dimensions()[1];
  int64_t point = (3 + f.radial) * (1 + 2 * f.octaves), seen = 3 * (1 + 2 * f.direction_octaves);
  int64_t needed = (2 * point + seen + 1 + 2 * h + 4 + 4) * h + 4 + 6 * f.fitted;  // kernels and biases
  if (size != needed) return "the field has " + std::to_string(needed) + " weights, not " + std::to_string(size);
  if (int64_t(pose.element_count()) != 6 * weights.dimensions()[0]) return "each particle needs a pose of 6 numbers";
  return "";
}

static ffi::Error view_terms(F32 weights, F32 pose, F32 origin, F32 direction, F32 t, F32 rgb, F32 range,
                             F32 range_sigma, F32 limit, F32 weight, S32 status, S32 rgb_valid, S32 range_valid, F32Result values,
                             F32Result g_weights, F32Result g_pose, FieldSizes field, float mask_error, float outlier,
                             float outlier_span, float wall_sigma, float colour_sigma, float per_density,
                             int32_t colour_count, int32_t choices, int32_t threads, std::string_view isa) {
  const Code* chosen = code(isa);
  if (!chosen) return wrong("this machine has no instruction set " + std::string(isa));
  if (std::string what = wrong_with(field, weights, pose); !what.empty()) return wrong(what);
  if (t.dimensions().size() < 2) return wrong("t must be a matrix");
  size_t crossings = t.dimensions().back(), rays = t.element_count() / std::max<size_t>(crossings, 1);
  for (size_t count : {origin.element_count() / 3, direction.element_count() / 3, rgb.element_count() / 3,
                       range.element_count(), range_sigma.element_count(), limit.element_count(), weight.element_count(),
                       status.element_count(), rgb_valid.element_count(), range_valid.element_count()})
    if (count != rays) return wrong("t has " + std::to_string(rays) + " rays, other data " + std::to_string(count));
  int64_t particles = weights.dimensions()[0], size = weights.dimensions()[1];
  if (choices < 1 || rays % choices || particles % choices)
    return wrong(std::to_string(choices) + " choices of pixels divide " + std::to_string(rays) + " rays and " +
                 std::to_string(particles) + " particles with a remainder");
  PixelModel model{mask_error, outlier, outlier_span, wall_sigma, colour_sigma, per_density};
  std::vector<View> views;
  for (size_t each = rays / choices, at = 0; views.size() < size_t(choices); at += each)
    views.push_back({int(each), int(crossings), colour_count, origin.typed_data() + 3 * at,
                     direction.typed_data() + 3 * at, t.typed_data() + crossings * at, rgb.typed_data() + 3 * at,
                     range.typed_data() + at, range_sigma.typed_data() + at, limit.typed_data() + at,
                     weight.typed_data() + at, status.typed_data() + at, rgb_valid.typed_data() + at,
                     range_valid.typed_data() + at});
  // Each particle belongs to one thread, so the result does not depend on the number of threads. If there are too few
  // particles, each is split into parts with separate sums, so that all threads get the same number of parts.
  int workers = std::max(threads, 1);
  int64_t parts = particles < workers ? workers / std::gcd<int64_t>(workers, particles) : 1;
  bool gradients = g_pose->element_count() > 0;  // else only values are computed
  if (gradients && (g_weights->element_count() != weights.element_count() || g_pose->element_count() != pose.element_count()))
    return wrong("gradients are of the weights' shape and of the poses', or empty");
  int64_t row = size + 7, items = particles * parts;
  std::vector<float> sums(parts > 1 ? items * row : 0);  // value, gradients by pose and weights
  std::vector<Particle> all(items);
  for (int64_t i = 0; i < items; ++i) {
    int64_t p = i / parts;
    float* sum = sums.data() + i * row;
    all[i] = {weights.typed_data() + p * size, pose.typed_data() + 6 * p, values->typed_data() + p,
              g_weights->typed_data() + p * size, g_pose->typed_data() + 6 * p, int(i % parts), int(parts)};
    if (parts > 1) all[i].value = sum, all[i].g_pose = sum + 1, all[i].g_weights = sum + 7;
    if (!gradients) all[i].g_pose = all[i].g_weights = nullptr;
  }
  int count = int(std::max<int64_t>(1, std::min<int64_t>(workers, items)));
  auto work = [&](int i, float* memory) {
    int64_t begin = items * i / count, end = items * (i + 1) / count, block = items / choices;
    for (int64_t next; begin < end; begin = next) {  // the particles of one block look at one choice of pixels
      next = std::min(end, (begin / block + 1) * block);
      chosen->run_view(field, model, views[begin / block], all.data() + begin, int(next - begin), memory);
    }
  };
  int64_t floats = 0;
  for (const View& view : views) floats = std::max(floats, chosen->view_floats(field, model, view));
  bool done = on_threads(count, floats, work);
  for (int64_t p = 0; p < particles && parts > 1; ++p) {
    float* first = sums.data() + p * parts * row;
    for (int64_t i = 1; i < parts; ++i)
      for (int64_t k = 0; k < row; ++k) first[k] += first[i * row + k];
    values->typed_data()[p] = first[0];
    if (!gradients) continue;
    std::copy_n(first + 1, 6, g_pose->typed_data() + 6 * p);
    std::copy_n(first + 7, size, g_weights->typed_data() + p * size);
  }
  return done ? ffi::Error::Success() : ffi::Error(ffi::ErrorCode::kResourceExhausted, "no memory for the view");
}

static ffi::Error density(F32 weights, F32 pose, F32 at, F32Result found, FieldSizes field, int32_t threads,
                          std::string_view isa) {
  const Code* chosen = code(isa);
  if (!chosen) return wrong("this machine has no instruction set " + std::string(isa));
  if (std::string what = wrong_with(field, weights, pose); !what.empty()) return wrong(what);
  int64_t shapes = weights.dimensions()[0], size = weights.dimensions()[1], count = at.element_count() / 3, next = 0;
  if (int64_t(found->element_count()) != shapes * count) return wrong("points must have 3 coordinates");
  std::vector<Shape> all(shapes);
  for (int64_t p = 0; p < shapes; ++p)
    all[p] = {weights.typed_data() + p * size, pose.typed_data() + 6 * p, found->typed_data() + p * count};
  Points points{count, at.typed_data()};
  auto work = [&](int, float* memory) { chosen->run_points(field, points, all.data(), shapes, &next, memory); };
  bool done = on_threads(std::max(threads, 1), chosen->points_floats(field), work);
  return done ? ffi::Error::Success() : ffi::Error(ffi::ErrorCode::kResourceExhausted, "no memory for the points");
}

XLA_FFI_REGISTER_STRUCT_ATTR_DECODING(FieldSizes, ffi::StructMember<int32_t>("width"),
                                      ffi::StructMember<int32_t>("octaves"),
                                      ffi::StructMember<int32_t>("direction_octaves"),
                                      ffi::StructMember<int32_t>("radial"), ffi::StructMember<int32_t>("fitted"),
                                      ffi::StructMember<float>("density_scale"));

XLA_FFI_DEFINE_HANDLER_SYMBOL(FarsideViewTerms, view_terms,
                              ffi::Ffi::Bind()
                                  .Arg<F32>().Arg<F32>().Arg<F32>().Arg<F32>().Arg<F32>().Arg<F32>().Arg<F32>()
                                  .Arg<F32>().Arg<F32>().Arg<F32>().Arg<S32>().Arg<S32>().Arg<S32>()
                                  .Ret<F32>().Ret<F32>().Ret<F32>()
                                  .Attr<FieldSizes>("field")
                                  .Attr<float>("mask_error").Attr<float>("outlier")
                                  .Attr<float>("outlier_span").Attr<float>("wall_sigma").Attr<float>("colour_sigma")
                                  .Attr<float>("per_density").Attr<int32_t>("colour_count").Attr<int32_t>("choices")
                                  .Attr<int32_t>("threads").Attr<std::string_view>("isa"));

XLA_FFI_DEFINE_HANDLER_SYMBOL(FarsideDensity, density,
                              ffi::Ffi::Bind()
                                  .Arg<F32>().Arg<F32>().Arg<F32>().Ret<F32>()
                                  .Attr<FieldSizes>("field").Attr<int32_t>("threads").Attr<std::string_view>("isa"));
