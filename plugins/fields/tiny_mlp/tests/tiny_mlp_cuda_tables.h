// Kernel tables of the small network as its device tests need them, and the comparison of two devices' results.
#pragma once

#include "cuda/kernel_tables.h"
#include "fields/tiny_mlp/tiny_mlp_layers.cuh"
#include "tests/cuda/device_field.h"

namespace semfield::testing {

namespace tiny {
inline const KernelTables& cpu_tables() {
  static const KernelTables tables = tables_of({tiny_mlp_kernels});
  return tables;
}
inline const KernelTables& device_tables() {
  static const KernelTables tables = tables_of({cuda::add_plugin_kernels});
  return tables;
}
/// Layer by layer whatever the widths.
inline const KernelTables& layer_tables() {
  static const TinyMlpKernels<float> table{cuda::tiny::layers_forward, cuda::tiny::layers_backward,
                                           [](const TinyMlpShape&, const Tensors<float>&) {},
                                           cuda::tiny::layers_saved_bytes};
  static const KernelTables tables = [] {
    KernelTables t;
    t.add(Device::cuda, "field 'tiny_mlp'", &table);
    t.add(Device::cuda, "field 'tiny_mlp'", &table, Precision::bf16);
    return t;
  }();
  return tables;
}

}  // namespace tiny

inline std::string near_norm(const DeviceMatrix<float>& got, const DeviceMatrix<float>& want, double tolerance) {
  const std::vector<double> values = widen(want.read());
  return near_norm(got, host_view(values, want.view().cols), tolerance);
}

}  // namespace semfield::testing
