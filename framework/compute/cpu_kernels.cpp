#include "compute/cpu_kernels.h"

#include "compute/isa.h"
#include "isa_list.h"

namespace semfield {

#define SEMFIELD_DECLARE(name)              \
  namespace isa_##name {                    \
    void gemm_kernels(CpuKernels<float>&);  \
    void gemm_kernels(CpuKernels<double>&); \
    void loop_kernels(CpuKernels<float>&);  \
    void loop_kernels(CpuKernels<double>&); \
  }
SEMFIELD_FOR_EACH_ISA(SEMFIELD_DECLARE)
#undef SEMFIELD_DECLARE
namespace {

template <class Real>
CpuKernels<Real> chosen_kernels() {
  using Fill = void (*)(CpuKernels<Real>&);
  static constexpr IsaVariant<Fill> kGemm[] = {
#define SEMFIELD_LIST(name) {Isa::name, isa_##name::gemm_kernels},
      SEMFIELD_FOR_EACH_ISA(SEMFIELD_LIST)
#undef SEMFIELD_LIST
  };
  static constexpr IsaVariant<Fill> kLoops[] = {
#define SEMFIELD_LIST(name) {Isa::name, isa_##name::loop_kernels},
      SEMFIELD_FOR_EACH_ISA(SEMFIELD_LIST)
#undef SEMFIELD_LIST
  };
  CpuKernels<Real> kernels{};
  best_variant(kGemm)(kernels);
  best_variant(kLoops)(kernels);
  return kernels;
}

}  // namespace

template <class Real>
const CpuKernels<Real>& cpu_kernels() {
  static const CpuKernels<Real> kernels = chosen_kernels<Real>();
  return kernels;
}

bool bf16_is_native() {
#if defined(__AVX512BF16__)
  return true;  // the whole build has them
#else
  return isa() >= Isa::avx512_bf16 && isa() != Isa::build;
#endif
}

bool bf16_is_faster() {
#if defined(__x86_64__)
  return isa() == Isa::amx_bf16 || (bf16_is_native() && __builtin_cpu_is("amd") != 0);
#else
  return false;
#endif
}

template const CpuKernels<float>& cpu_kernels<float>();
template const CpuKernels<double>& cpu_kernels<double>();

}  // namespace semfield
