// From raw density to attenuation and back, one thread per sample.
#include "compute/math_functions.h"
#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/rendering.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;

__device__ std::int64_t thread_number() { return static_cast<std::int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; }

// NaN stays NaN, as on the CPU.
__device__ float truncated_exp(float x) {
  constexpr float kMost = static_cast<float>(kTruncExpMax);
  return expf(x > kMost ? kMost : x);
}

__device__ float activated(DensityActivation activation, float raw) {
  switch (activation) {
    case DensityActivation::relu:
      return raw < 0 ? 0.0F : raw;
    case DensityActivation::softplus:
      return softplus(raw);
    case DensityActivation::trunc_exp:
      return truncated_exp(raw);
  }
  return raw;
}

__device__ float slope_of(DensityActivation activation, float raw) {
  switch (activation) {
    case DensityActivation::relu:
      return raw > 0 ? 1.0F : 0.0F;
    case DensityActivation::softplus:
      return sigmoid(raw);
    case DensityActivation::trunc_exp:
      return truncated_exp(raw);
  }
  return 0;
}

// 12 B per row, and 8 B more with noise; noise is drawn in float64.
__global__ void __launch_bounds__(kThreads) forward_kernel(DensityRule rule, Samples<float> samples, View<float> raw,
                                                           View<float> sigma, const StepCell* cell, FaultKey* fault) {
  const std::int64_t m = thread_number();
  if (m >= raw.rows) return;
  const bool ragged = !samples.first.empty();
  const bool in_use = !ragged || m < samples.first(samples.first.rows - 1, 0);
  float value = raw(m, 0);
  if (in_use && !isfinite(value)) note_fault(fault, Stage::raw_density, m);
  if (rule.bias != 0) value += static_cast<float>(rule.bias);
  if (rule.deviation != 0 && ragged && in_use) {
    const std::int32_t r = samples.ray_of_sample(m, 0);
    const auto index =
        (static_cast<std::uint64_t>(rule.first_ray + r) << 20) + static_cast<std::uint64_t>(m - samples.first(r, 0));
    value += static_cast<float>(rule.deviation * normal01(at_step(rule.random, cell), index));
  }
  raw(m, 0) = value;
  const float density = activated(rule.activation, value) * static_cast<float>(rule.per_m);
  sigma(m, 0) = density;
  if (in_use && !(density >= 0 && isfinite(density))) note_fault(fault, Stage::density, m);
}

// 12 B per row.
__global__ void __launch_bounds__(kThreads)
    backward_kernel(DensityActivation activation, float per_m, View<const float> raw, View<const float> d_sigma,
                    View<float> d_raw) {
  const std::int64_t m = thread_number();
  if (m < raw.rows) d_raw(m, 0) = d_sigma(m, 0) * slope_of(activation, raw(m, 0)) * per_m;
}

}  // namespace

void density_forward(const DensityRule& rule, const Samples<float>* samples, View<float> raw, View<float> sigma) {
  if (raw.rows == 0) return;
  forward_kernel<<<blocks_of(raw.rows, kThreads), kThreads, 0, launch().stream>>>(
      rule, samples == nullptr ? Samples<float>{} : *samples, raw, sigma, launch().cell, launch().fault);
  check_launch("density");
}

void density_backward(const DensityRule& rule, View<const float> raw, View<const float> d_sigma, View<float> d_raw) {
  if (raw.rows == 0) return;
  backward_kernel<<<blocks_of(raw.rows, kThreads), kThreads, 0, launch().stream>>>(
      rule.activation, static_cast<float>(rule.per_m), raw, d_sigma, d_raw);
  check_launch("density gradient");
}

}  // namespace semfield::cuda
