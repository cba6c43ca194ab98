// The XLA FFI handler: checks shapes, chooses the instruction set of this machine, shares particles out over threads.
#include <algorithm>
#include <cstdlib>
#include <memory>
#include <string>
#include <string_view>
#include <thread>
#include <vector>

#include "problem.h"
#include "xla/ffi/api/ffi.h"

#define FARSIDE_DECLARE(isa)                                                                                     \
  namespace farside_##isa {                                                                                      \
  int64_t scratch_floats(const FieldSizes&, const PixelModel&, const View&);                                     \
  void run(const FieldSizes&, const PixelModel&, const View&, const Particle*, int, float*);                     \
  }
#define FARSIDE_ENTRY(isa) {#isa, farside_##isa::scratch_floats, farside_##isa::run}

struct Code {
  const char* name;
  int64_t (*scratch_floats)(const FieldSizes&, const PixelModel&, const View&);
  void (*run)(const FieldSizes&, const PixelModel&, const View&, const Particle*, int, float*);
};

FARSIDE_DECLARE(plain)
#ifdef __x86_64__
FARSIDE_DECLARE(avx2)
FARSIDE_DECLARE(avx512)
#endif

// The widest that this machine has, or the one asked for; null where it has no such one.
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

namespace ffi = xla::ffi;
using F32 = ffi::Buffer<ffi::F32>;
using S32 = ffi::Buffer<ffi::S32>;
using F32Result = ffi::Result<F32>;

static ffi::Error view_terms(F32 weights, F32 pose, F32 origin, F32 direction, F32 t, F32 rgb, F32 range,
                             F32 range_sigma, F32 limit, S32 status, S32 rgb_valid, S32 range_valid, F32Result values,
                             F32Result g_weights, F32Result g_pose, int32_t width, int32_t octaves,
                             int32_t direction_octaves, int32_t radial, int32_t fitted,
                             float density_scale, float mask_error, float outlier, float outlier_span,
                             float wall_sigma, float colour_sigma, float per_density, int32_t colour_count,
                             int32_t threads, std::string_view isa) {
  auto rows = weights.dimensions(), crossings = t.dimensions();
  if (rows.size() != 2 || crossings.size() != 2) return ffi::Error::InvalidArgument("weights and t must be matrices");
  const Code* chosen = code(isa);
  if (!chosen) return ffi::Error::InvalidArgument("this machine has no instruction set " + std::string(isa));
  int64_t particles = rows[0], size = rows[1], h = width;
  if (octaves > 30 || direction_octaves > 30) return ffi::Error::InvalidArgument("at most 30 octaves");
  int64_t point = (3 + radial) * (1 + 2 * octaves), seen = 3 * (1 + 2 * direction_octaves);
  int64_t needed = (2 * point + seen + 1 + 2 * h + 4 + 4) * h + 4 + 6 * fitted;  // kernels and biases
  if (size != needed)
    return ffi::Error::InvalidArgument("the field has " + std::to_string(needed) + " weights, not " + std::to_string(size));
  FieldSizes field{width, octaves, direction_octaves, radial, fitted, density_scale};
  PixelModel model{mask_error, outlier, outlier_span, wall_sigma, colour_sigma, per_density};
  View view{int(crossings[0]), int(crossings[1]), colour_count, origin.typed_data(), direction.typed_data(),
            t.typed_data(), rgb.typed_data(), range.typed_data(), range_sigma.typed_data(), limit.typed_data(),
            status.typed_data(), rgb_valid.typed_data(), range_valid.typed_data()};
  std::vector<Particle> all(particles);
  for (int64_t p = 0; p < particles; ++p)
    all[p] = {weights.typed_data() + p * size, pose.typed_data() + 6 * p, values->typed_data() + p,
              g_weights->typed_data() + p * size, g_pose->typed_data() + 6 * p};
  int count = int(std::max<int64_t>(1, std::min<int64_t>(threads, particles)));
  int64_t floats = chosen->scratch_floats(field, model, view) + 16;
  auto work = [&](int i) {
    // each particle is one thread's own: the answer does not depend on their number
    int64_t begin = particles * i / count, end = particles * (i + 1) / count;
    std::unique_ptr<float, void (*)(void*)> memory((float*)std::aligned_alloc(64, (floats + 15) / 16 * 64), std::free);
    chosen->run(field, model, view, all.data() + begin, int(end - begin), memory.get());
  };
  std::vector<std::thread> pool;
  for (int i = 1; i < count; ++i) pool.emplace_back(work, i);
  work(0);
  for (std::thread& thread : pool) thread.join();
  return ffi::Error::Success();
}

XLA_FFI_DEFINE_HANDLER_SYMBOL(FarsideViewTerms, view_terms,
                              ffi::Ffi::Bind()
                                  .Arg<F32>().Arg<F32>().Arg<F32>().Arg<F32>().Arg<F32>().Arg<F32>().Arg<F32>()
                                  .Arg<F32>().Arg<F32>().Arg<S32>().Arg<S32>().Arg<S32>()
                                  .Ret<F32>().Ret<F32>().Ret<F32>()
                                  .Attr<int32_t>("width").Attr<int32_t>("octaves").Attr<int32_t>("direction_octaves")
                                  .Attr<int32_t>("radial").Attr<int32_t>("fitted")
                                  .Attr<float>("density_scale").Attr<float>("mask_error").Attr<float>("outlier")
                                  .Attr<float>("outlier_span").Attr<float>("wall_sigma").Attr<float>("colour_sigma")
                                  .Attr<float>("per_density").Attr<int32_t>("colour_count")
                                  .Attr<int32_t>("threads").Attr<std::string_view>("isa"));
