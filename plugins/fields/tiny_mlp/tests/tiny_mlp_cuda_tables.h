// Kernel tables of the small network as its device tests need them, and the comparison of two devices' results.
#pragma once

#include "cuda/kernel_tables.h"
#include "fields/tiny_mlp/tiny_mlp.h"
#include "tests/cuda/device_field.h"

namespace semfield::testing {

namespace tiny {
inline const KernelTables& cpu_tables() {
  static const KernelTables tables = tables_of({mlp_kernels});
  return tables;
}
inline const KernelTables& device_tables() {
  static const KernelTables tables = tables_of({cuda::add_plugin_kernels});
  return tables;
}
}  // namespace tiny

inline std::string near_norm(const DeviceMatrix<float>& got, const DeviceMatrix<float>& want, double tolerance) {
  const std::vector<double> values = widen(want.read());
  return near_norm(got, host_view(values, want.view().cols), tolerance);
}

inline std::string near_norm(const DeviceMatrix<float>& got, View<const float> want, double tolerance) {
  std::vector<double> values;
  for (std::int64_t r = 0; r < want.rows; ++r) values.insert(values.end(), want.row(r), want.row(r) + want.cols);
  return near_norm(got, host_view(values, want.cols), tolerance);
}

}  // namespace semfield::testing
