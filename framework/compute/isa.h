// Instruction sets: kernels are compiled once for each, the best that the CPU has is chosen when the program
// starts.
#pragma once

#include <cstdint>
#include <iterator>
#include <string>
#include <string_view>

#include "compute/gemm.h"
#include "core/non_copyable.h"

/// Namespace of the variant that is being compiled, isa_avx2 for one; set by the build (cmake/Isa.cmake).
#ifndef SEMFIELD_ISA
#define SEMFIELD_ISA isa_build
#endif

namespace semfield {

/// Weakest first. amx_emulated: the kernels of amx_bf16 with its tile instructions written in those of avx512_bf16, for
/// tests; never chosen unless it is asked for. `build`: the only variant of a build that compiles its kernels once,
/// with its own flags.
enum class Isa : std::uint8_t { generic, avx2, avx512, avx512_bf16, amx_emulated, amx_bf16, build };

std::string_view isa_name(Isa isa);

/// The instruction set in use: the best that this CPU and this build have, or less by the environment variable
/// SEMFIELD_ISA (generic, avx2, avx512, avx512_bf16, amx_emulated, amx_bf16). Throws Error(config) when that names
/// something else or something that is missing.
Isa isa();

/// Whether this CPU has tile registers with products of bf16 (AMX), and the kernel lets this process use them.
bool processor_has_tiles();

/// Variants of this build, e.g. "generic avx2 avx512 avx512_bf16 amx_emulated amx_bf16".
std::string isas_of_build();
/// Those of them that this CPU has.
std::string isas_of_machine();

template <class Function>
struct IsaVariant {
  Isa isa;
  Function function;
};
/// With SEMFIELD_FOR_EACH_ISA: the declaration of a variant's `fill`, which fills a table, and its place in a list.
#define SEMFIELD_DECLARE_VARIANT(name, fill, Table) \
  namespace isa_##name {                            \
    void fill(Table&);                              \
  }
#define SEMFIELD_VARIANT(name, fill) {Isa::name, isa_##name::fill},

/// The last variant that needs no more than isa(); variants are listed weakest first and begin with the weakest of the
/// build.
template <class Function, std::size_t kCount>
Function best_variant(const IsaVariant<Function> (&variants)[kCount]) {
  const Isa best = isa();
  std::size_t chosen = 0;
  for (std::size_t i = 1; i < kCount; ++i) {
    if (variants[i].isa <= best) chosen = i;
  }
  return variants[chosen].function;
}

// The vectorised loops of core/, compiled once per instruction set (compute/isa.h).

template <class Real>
struct CpuKernels {
  void (*gemm)(const Gemm<Real>&);
  void (*exp_inplace)(Real*, std::int64_t);
  void (*expm1_inplace)(Real*, std::int64_t);
  void (*sigmoid_inplace)(Real*, std::int64_t);
  void (*softplus_inplace)(Real*, std::int64_t);
  void (*sine_inplace)(Real* z, std::int64_t, Real frequency, Real* slope);
  Real (*largest_of)(const Real*, std::int64_t);
  bool (*all_finite)(const Real*, std::int64_t);
  double (*sum_of)(const Real*, std::int64_t);
  void (*relu_backward)(View<const Real> y, View<Real> dy);
  void (*bias_backward)(View<const Real> dz, View<Real> d_bias);
  void (*per_ray_backward)(View<const Real> dz, View<const std::int32_t> ray_of_sample, View<Real> d_ray_term);
};

/// Of the instruction set in use.
template <class Real>
const CpuKernels<Real>& cpu_kernels();

/// Whether products of bf16 run by instructions of the CPU; false: emulated, slower than fp32.
bool bf16_is_native();
/// Whether they are also faster than those of fp32: on tiles, and by the dot products of AMD's CPUs. Intel's do
/// half as many of these as fp32 multiply-adds.
bool bf16_is_faster();

// The floating-point mode of compute threads: set on entering numerical work, the caller's own restored on leaving.

/// While it lives, this thread computes as every compute thread does: subnormal inputs and results count as 0, results
/// are rounded to nearest, and nothing traps. Subnormal numbers carry no information that training or rendering needs,
/// and some CPUs take 25 times as long over them. The mode is that of SSE and AVX (MXCSR) or AArch64 (FPCR);
/// elsewhere this does nothing. Scopes nest.
class ComputeFloatMode : NonCopyable {
 public:
  ComputeFloatMode();
  ~ComputeFloatMode();

  /// This thread is in the mode; always where there is no such mode.
  static bool in_effect();

 private:
  std::uint64_t before_;
};

}  // namespace semfield
