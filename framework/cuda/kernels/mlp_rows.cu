// One thread per number, bound by memory; rows are short and strided, so a thread finds its row by a division.
#include "compute/math_functions.h"
#include "compute/sine.h"
#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/mlp_rows.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;

/// body(row, column) for every number of `rows` x `cols`.
template <class Body>
__global__ void each_kernel(std::int64_t rows, std::int32_t cols, Body body) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < rows * cols) body(i / cols, static_cast<std::int32_t>(i % cols));
}
template <class Body>
void for_each(std::int64_t rows, std::int32_t cols, const char* what, Body body) {
  if (rows == 0 || cols == 0) return;
  each_kernel<<<blocks_of(rows * cols, kThreads), kThreads, 0, launch().stream>>>(rows, cols, body);
  check_launch(what);
}

__device__ inline float wide(float value) { return value; }
__device__ inline float wide(__nv_bfloat16 value) { return __bfloat162float(value); }
template <class Act>
__device__ Act narrow(float value) {
  if constexpr (sizeof(Act) == sizeof(float)) {
    return value;
  } else {
    return __float2bfloat16_rn(value);
  }
}

template <class Sums, class Act>
struct EndOfRow {
  LayerEnd<Sums, Act> end;
  __device__ void operator()(std::int64_t row, std::int32_t col) const {
    float value = wide(end.sums(row, col));
    if (!end.start.empty() && col < end.start.cols)
      value += end.start(!end.row_of.empty() ? end.row_of(row, 0) : end.start.rows == 1 ? 0 : row, col);
    if (end.relu && value < 0) value = 0;  // NaN stays NaN
    if (!end.mask.empty() && !(wide(end.mask(row, col)) > 0)) value = 0;
    end.out(row, col) = narrow<Act>(value);
  }
};

template <class Act>
struct SineOfRow {
  View<const float> sums;
  float frequency;
  View<Act> value, slope;
  __device__ void operator()(std::int64_t row, std::int32_t col) const {
    double turns = static_cast<double>(sums(row, col)) * (static_cast<double>(frequency) * 0.15915494309189535);
    turns -= rint(turns);
    float sine = 0, cosine = 0;
    sincos_of_quarters(4.0 * turns, sine, cosine);
    value(row, col) = narrow<Act>(sine);
    if (!slope.empty()) slope(row, col) = narrow<Act>(frequency * cosine);
  }
};

template <class Act>
struct SlopeOfRow {
  View<const Act> slope;
  View<const float> sums;
  View<Act> dz;
  __device__ void operator()(std::int64_t row, std::int32_t col) const {
    dz(row, col) = narrow<Act>(sums(row, col) * wide(slope(row, col)));
  }
};

struct GatherOfRow {
  View<const float> in;
  View<const std::int32_t> ray_of_sample;
  View<float> out;
  __device__ void operator()(std::int64_t row, std::int32_t col) const {
    out(row, col) = in(ray_of_sample(row, 0), col);
  }
};

struct SigmoidOfRow {
  View<float> rows;
  __device__ void operator()(std::int64_t row, std::int32_t col) const { rows(row, col) = sigmoid(rows(row, col)); }
};

struct LogitOfRow {
  View<const float> value, d_value;
  View<float> d_logit;
  __device__ void operator()(std::int64_t row, std::int32_t col) const {
    d_logit(row, col) = d_value(row, col) * (value(row, col) * (1.0F - value(row, col)));
  }
};

}  // namespace

template <class Sums, class Act>
void finish_rows(const LayerEnd<Sums, Act>& end) {
  for_each(end.out.rows, end.out.cols, "the end of a layer", EndOfRow<Sums, Act>{end});
}

template <class Act>
void sine_rows(View<const float> sums, float frequency, View<Act> value, View<Act> slope) {
  for_each(value.rows, value.cols, "a layer of sines", SineOfRow<Act>{sums, frequency, value, slope});
}

template <class Act>
void times_slope(View<const Act> slope, View<const float> sums, View<Act> dz) {
  for_each(dz.rows, dz.cols, "the gradient of a layer of sines", SlopeOfRow<Act>{slope, sums, dz});
}

#define SEMFIELD_INSTANTIATE(Act)                                               \
  template void sine_rows<Act>(View<const float>, float, View<Act>, View<Act>); \
  template void times_slope<Act>(View<const Act>, View<const float>, View<Act>);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(__nv_bfloat16)
#undef SEMFIELD_INSTANTIATE
template void finish_rows<float, float>(const LayerEnd<float, float>&);
template void finish_rows<float, __nv_bfloat16>(const LayerEnd<float, __nv_bfloat16>&);
template void finish_rows<__nv_bfloat16, __nv_bfloat16>(const LayerEnd<__nv_bfloat16, __nv_bfloat16>&);

void gather_rows(View<const float> in, View<const std::int32_t> ray_of_sample, View<float> out) {
  for_each(out.rows, out.cols, "rows of rays for samples", GatherOfRow{in, ray_of_sample, out});
}

void sigmoid_rows(View<float> rows) { for_each(rows.rows, rows.cols, "a sigmoid", SigmoidOfRow{rows}); }

void logit_gradient(View<const float> value, View<const float> d_value, View<float> d_logit) {
  for_each(d_logit.rows, d_logit.cols, "the gradient of a sigmoid", LogitOfRow{value, d_value, d_logit});
}

}  // namespace semfield::cuda
