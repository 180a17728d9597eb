// Kernels of 'ripples' for CUDA devices.
#include "cuda/kernels/device_code.cuh"
#include "plugin/kernels.h"
#include "ripples_kernels.h"

namespace semfield::cuda {

void ripples_cuda_kernels(KernelTables& tables);

namespace {

constexpr int kThreads = 256;

__global__ void forward_kernel(View<const double> x, View<float> y) {
  const std::int64_t r = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (r >= x.rows) return;
  const double s = outside::ripples_phase(x.row(r), x.cols);
  for (std::int32_t b = 0; b < y.cols; ++b) y(r, b) = static_cast<float>(cos((b + 1) * s));
}

__global__ void backward_kernel(View<const double> x, View<const float> dy, View<float> dx) {
  const std::int64_t r = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (r >= x.rows) return;
  const double s = outside::ripples_phase(x.row(r), x.cols);
  double slope = 0;
  for (std::int32_t b = 0; b < dy.cols; ++b) slope -= static_cast<double>(dy(r, b)) * (b + 1) * sin((b + 1) * s);
  for (std::int32_t d = 0; d < dx.cols; ++d) dx(r, d) = static_cast<float>(slope);
}

void forward(View<const double> x, View<float> y) {
  if (x.rows == 0) return;
  forward_kernel<<<blocks_of(x.rows, kThreads), kThreads, 0, launch().stream>>>(x, y);
  check_launch("ripples");
}

void backward(View<const double> x, View<const float> dy, View<float> dx) {
  if (x.rows == 0 || dx.empty()) return;
  backward_kernel<<<blocks_of(x.rows, kThreads), kThreads, 0, launch().stream>>>(x, dy, dx);
  check_launch("ripples, backward");
}

constexpr outside::RipplesKernels<float> kTable{forward, backward, "cuda"};

}  // namespace

void ripples_cuda_kernels(KernelTables& tables) { tables.add(Device::cuda, "encoder 'ripples'", &kTable); }

}  // namespace semfield::cuda
