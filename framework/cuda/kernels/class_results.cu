// What rendering tells of classes, a warp per ray.
#include "cuda/kernels/losses.h"
#include "cuda/kernels/softmax_row.cuh"

namespace semfield::cuda {

namespace {

constexpr int kRays = 8;  // a block
constexpr int kThreads = kRays * kWarp;

// Exponentials in float64, as on the CPU. 4 C B read (again from cache for each sweep) and up to 14 + 4 C B
// written per ray.
__global__ void __launch_bounds__(kThreads) results_kernel(View<const float> logits, ClassResults<float> results) {
  const int lane = static_cast<int>(threadIdx.x % kWarp);
  const std::int64_t r = static_cast<std::int64_t>(blockIdx.x) * kRays + threadIdx.x / kWarp;
  if (r >= logits.rows) return;
  const float* const row = logits.row(r);
  const RowTop top = top_of_row(row, logits.cols, lane);
  const double rest = rest_of_row<double>(row, logits.cols, top, lane);
  const auto largest = static_cast<float>(1.0 / (1.0 + rest));
  // Of classes whose probabilities are equal in float the first is the ray's.
  std::int32_t best = top.argmax;
  double entropy = 0;  // H = ln Z + sum p_c (largest - s_c)
  for (std::int32_t c = lane; c < logits.cols; c += kWarp) {
    const double p = (c == top.argmax ? 1.0 : exp_below<double>(row, c, top.largest)) / (1.0 + rest);
    if (static_cast<float>(p) >= largest && c < best) best = c;
    if (!results.probability.empty()) results.probability(r, c) = static_cast<float>(p);
    if (p > 0) entropy += p * (static_cast<double>(top.largest) - static_cast<double>(row[c]));
  }
  best = __reduce_min_sync(kFullMask, best);
  entropy = warp_sum(entropy);
  if (lane != 0) return;
  if (!results.label.empty()) results.label(r, 0) = static_cast<std::int16_t>(best);
  if (!results.entropy.empty()) results.entropy(r, 0) = static_cast<float>(log1p(rest) + entropy);
  if (!results.confidence.empty()) results.confidence(r, 0) = largest;
  if (results.truth_probability.empty()) return;
  const std::int32_t truth = results.truth(r, 0);
  float p = 0;
  if (truth == top.argmax) {
    p = largest;
  } else if (truth >= 0 && truth < logits.cols) {
    p = static_cast<float>(exp_below<double>(row, truth, top.largest) / (1.0 + rest));
  }
  results.truth_probability(r, 0) = p;
}

}  // namespace

void class_results(View<float> logits, const ClassResults<float>& results) {
  if (logits.rows == 0) return;
  results_kernel<<<blocks_of(logits.rows, kRays), kThreads, 0, launch().stream>>>(logits, results);
  check_launch("class results");
}

}  // namespace semfield::cuda
