// CUDA kernels of the identity encoder: one thread per number.
#include "cuda/kernels/device_code.cuh"
#include "encoders/identity/identity_kernels.h"
#include "plugin/kernels.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;

__global__ void forward_kernel(View<const double> x, View<float> y, FaultKey* fault) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= x.size()) return;
  const std::int64_t row = i / x.cols;
  const auto col = static_cast<std::int32_t>(i % x.cols);
  const double value = x(row, col);
  if (!isfinite(value)) note_fault(fault, Stage::encoded_position, row);
  y(row, col) = static_cast<float>(value);
}

__global__ void backward_kernel(View<const float> dy, View<float> dx) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= dx.size()) return;
  dx(i / dx.cols, static_cast<std::int32_t>(i % dx.cols)) = dy(i / dx.cols, static_cast<std::int32_t>(i % dx.cols));
}

std::int64_t forward(const IdentityShape&, View<const double> x, View<float> y) {
  if (x.size() == 0) return -1;
  forward_kernel<<<blocks_of(x.size(), kThreads), kThreads, 0, launch().stream>>>(x, y, launch().fault);
  check_launch("identity forward");
  return first_fault_row(Stage::encoded_position);
}

void backward(const IdentityShape&, View<const double>, View<const float> dy, View<float> dx) {
  if (dx.size() == 0) return;
  backward_kernel<<<blocks_of(dx.size(), kThreads), kThreads, 0, launch().stream>>>(dy, dx);
  check_launch("identity backward");
}

const RowKernels<float, IdentityShape> kTable{forward, backward};

}  // namespace

void identity_cuda_kernels(KernelTables& tables) { tables.add(Device::cuda, "encoder 'identity'", &kTable); }

}  // namespace semfield::cuda
