// What the files of group I share: the kernels of every instruction set side by side, and a device under test.
#pragma once

#include "compute/isa.h"
#include "execution/device_library.h"
#include "isa_list.h"
#include "named_case.h"
#include "plugin/encoder.h"

namespace semfield {

// The makers that compute/isa.cpp chooses from; the suite calls each of them.
#define SEMFIELD_DECLARE(name)              \
  namespace isa_##name {                    \
    void gemm_kernels(CpuKernels<float>&);  \
    void gemm_kernels(CpuKernels<double>&); \
    void loop_kernels(CpuKernels<float>&);  \
    void loop_kernels(CpuKernels<double>&); \
  }
SEMFIELD_FOR_EACH_ISA(SEMFIELD_DECLARE)
#undef SEMFIELD_DECLARE

namespace numerics {

/// The same cases' rows on a device beside the CPU, "fp32 on cuda" (device_cases.cpp, device_step_cases.cpp).
struct DeviceUnderTest {
  Registry registry;  ///< with the device's kernels
  DeviceCalls calls;
};
/// Opens a row; without a device it is absent, with the reason, and nothing is returned.
std::optional<DeviceUnderTest> device_row(CaseRun& run, std::string_view precision = "fp32 on cuda");
void encoder_guards_on_device(CaseRun& run, const DeviceUnderTest& device);

/// Frequencies and angle of the encoder whose sines are looked at, and their largest error in units of the last place
/// of 1.
const std::map<std::string, std::string>& sine_settings();
template <class Real>
double worst_sine(const Encoder<Real>& encoder);

template <class Real>
struct IsaTable {
  Isa isa = Isa::generic;
  CpuKernels<Real> kernels{};
};

/// Kernels of every instruction set of this build up to the one in use, weakest first.
template <class Real>
std::vector<IsaTable<Real>> isa_tables() {
  std::vector<IsaTable<Real>> out;
  const auto add = [&](Isa which, void (*gemm)(CpuKernels<Real>&), void (*loops)(CpuKernels<Real>&)) {
    if (which > isa()) return;
    IsaTable<Real> table{which, {}};
    gemm(table.kernels);
    loops(table.kernels);
    out.push_back(table);
  };
#define SEMFIELD_LIST(name) add(Isa::name, isa_##name::gemm_kernels, isa_##name::loop_kernels);
  SEMFIELD_FOR_EACH_ISA(SEMFIELD_LIST)
#undef SEMFIELD_LIST
  return out;
}

}  // namespace numerics
}  // namespace semfield
