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

struct EndOfRow {
  LayerEnd end;
  __device__ void operator()(std::int64_t row, std::int32_t col) const {
    float value = end.sums(row, col);
    if (!end.start.empty() && col < end.start.cols)
      value += end.start(!end.row_of.empty() ? end.row_of(row, 0) : end.start.rows == 1 ? 0 : row, col);
    if (end.relu && value < 0) value = 0;  // NaN stays NaN
    if (!end.mask.empty() && !(end.mask(row, col) > 0)) value = 0;
    end.out(row, col) = value;
  }
};

struct SineOfRow {
  View<const float> sums;
  float frequency;
  View<float> value, slope;
  __device__ void operator()(std::int64_t row, std::int32_t col) const {
    double turns = static_cast<double>(sums(row, col)) * (static_cast<double>(frequency) * 0.15915494309189535);
    turns -= rint(turns);
    float sine = 0, cosine = 0;
    sincos_of_quarters(4.0 * turns, sine, cosine);
    value(row, col) = sine;
    if (!slope.empty()) slope(row, col) = frequency * cosine;
  }
};

struct SlopeOfRow {
  View<const float> slope, sums;
  View<float> dz;
  __device__ void operator()(std::int64_t row, std::int32_t col) const {
    dz(row, col) = sums(row, col) * slope(row, col);
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

void finish_rows(const LayerEnd& end) { for_each(end.out.rows, end.out.cols, "the end of a layer", EndOfRow{end}); }

void sine_rows(View<const float> sums, float frequency, View<float> value, View<float> slope) {
  for_each(value.rows, value.cols, "a layer of sines", SineOfRow{sums, frequency, value, slope});
}

void times_slope(View<const float> slope, View<const float> sums, View<float> dz) {
  for_each(dz.rows, dz.cols, "the gradient of a layer of sines", SlopeOfRow{slope, sums, dz});
}

void gather_rows(View<const float> in, View<const std::int32_t> ray_of_sample, View<float> out) {
  for_each(out.rows, out.cols, "rows of rays for samples", GatherOfRow{in, ray_of_sample, out});
}

void sigmoid_rows(View<float> rows) { for_each(rows.rows, rows.cols, "a sigmoid", SigmoidOfRow{rows}); }

void logit_gradient(View<const float> value, View<const float> d_value, View<float> d_logit) {
  for_each(d_logit.rows, d_logit.cols, "the gradient of a sigmoid", LogitOfRow{value, d_value, d_logit});
}

}  // namespace semfield::cuda
