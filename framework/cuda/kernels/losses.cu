// The kernels of losses on the device.
#include <algorithm>

#include "core/check.h"
#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/kernels.h"

namespace semfield::cuda {

namespace {

// Squared colour error on the device, and counts of a pass.

constexpr int kThreads = 256;
constexpr int kEach = 16;  // values of a thread

// One thread kEach values, a block apart from each other; 12 B a value. A block's sum in a fixed tree.
__global__ void __launch_bounds__(kThreads) error_kernel(View<const float> color, View<const float> target,
                                                         double slope, View<float> d_color, double* of_block) {
  const std::int64_t size = 3 * color.rows;
  const std::int64_t begin = static_cast<std::int64_t>(blockIdx.x) * kThreads * kEach + threadIdx.x;
  double sum = 0;
#pragma unroll 4
  for (int j = 0; j < kEach; ++j) {
    const std::int64_t i = begin + static_cast<std::int64_t>(j) * kThreads;
    if (i >= size) break;
    const std::int64_t r = i / 3;
    const auto c = static_cast<std::int32_t>(i - 3 * r);
    const double error = static_cast<double>(color(r, c)) - static_cast<double>(target(r, c));
    sum += error * error;
    if (!d_color.empty()) d_color(r, c) = static_cast<float>(slope * error);
  }
  sum = block_sum<kThreads>(sum);
  if (threadIdx.x == 0) of_block[blockIdx.x] = sum;
}

// One block; the order of the sum depends on `count` alone.
__global__ void __launch_bounds__(kThreads) total_kernel(const double* of_block, std::int64_t count, double* total) {
  double sum = 0;
  for (std::int64_t i = threadIdx.x; i < count; i += kThreads) sum += of_block[i];
  sum = block_sum<kThreads>(sum);
  if (threadIdx.x == 0) *total = sum;
}

// One block; it stops at the first 4 kThreads samples among which one has density. At most 4 B per sample.
__global__ void __launch_bounds__(kThreads) count_kernel(View<const std::int32_t> first, View<const std::int32_t> drawn,
                                                         View<const float> sigma, LossSums* sums) {
  const std::int32_t count = first(first.rows - 1, 0);
  int dense = 0;
  for (std::int32_t begin = 0; begin < count && dense == 0; begin += 4 * kThreads) {
    for (int j = 0; j < 4; ++j) {
      const std::int32_t m = begin + j * kThreads + static_cast<std::int32_t>(threadIdx.x);
      if (m < count && sigma(m, 0) > 0) dense = 1;
    }
    dense = __syncthreads_or(dense);
  }
  if (threadIdx.x != 0) return;
  sums->samples = count;
  sums->drawn = drawn(drawn.rows - 1, 0);
  sums->dense = dense;
}

// Cross-entropy on the device, a warp per ray, by log-sum-exp from the row maximum; sums of a row are in float64.

constexpr int kRays = 8;  // a block
constexpr int kSoftmaxThreads = kRays * kWarp;

struct Term {
  double loss;
  long long labelled;
};

// What a ray needs besides its logits.
struct Rule {
  View<const std::int16_t> hard;
  View<const float> soft, class_weight;
  double slope;  // scale / normaliser
  FaultKey* fault;

  __device__ double weight_of(std::int32_t c) const {
    return class_weight.empty() ? 1.0 : static_cast<double>(class_weight(0, c));
  }
};

__device__ void clear_row(float* row, std::int32_t cols, int lane) {
  for (std::int32_t c = lane; c < cols && row != nullptr; c += kWarp) row[c] = 0;
}

// -log softmax(s)_c
__device__ double surprise_of(const float* logits, std::int32_t c, const RowTop& top, double rest) {
  return (static_cast<double>(top.largest) - static_cast<double>(logits[c])) + log1p(rest);
}

// Exponentials of a hard label in float: the gradient has no more digits, and the loss none to lose.
__device__ double hard_row(const Rule& rule, const float* logits, std::int32_t cols, std::int32_t label,
                           const RowTop& top, float* d_logits, int lane) {
  double rest = rest_of_row<float>(logits, cols, top, lane);
  // Exponentials below the normal range of float lose digits, and so would the loss of a row that is almost certain.
  if (rest < 1e-30) rest = rest_of_row<double>(logits, cols, top, lane);
  const double weight = rule.weight_of(label);
  const double share = 1.0 / (1.0 + rest), factor = rule.slope * weight * share;
  for (std::int32_t c = lane; c < cols && d_logits != nullptr; c += kWarp) {
    const double e = static_cast<double>(exp_below<float>(logits, c, top.largest));
    // p_y - 1 loses its digits when p_y is almost 1; for the row's largest it is -rest / (1 + rest).
    const double gap = label == top.argmax ? 0.0 - rest * share : e * share - 1.0;
    d_logits[c] = static_cast<float>(c == label ? rule.slope * weight * gap : factor * e);
  }
  return weight * surprise_of(logits, label, top, rest);
}

__device__ double soft_row(const Rule& rule, const float* logits, std::int32_t cols, const float* target,
                           double target_sum, const RowTop& top, float* d_logits, int lane) {
  const double rest = rest_of_row<double>(logits, cols, top, lane);
  double loss = 0, total = 0;
  for (std::int32_t c = lane; c < cols; c += kWarp) {
    const double mass = rule.weight_of(c) * static_cast<double>(target[c]) / target_sum;
    total += mass;
    if (mass > 0) loss += mass * surprise_of(logits, c, top, rest);
  }
  loss = warp_sum(loss);
  total = warp_sum(total);
  for (std::int32_t c = lane; c < cols && d_logits != nullptr; c += kWarp) {
    const double mass = rule.weight_of(c) * static_cast<double>(target[c]) / target_sum;
    const double p = (c == top.argmax ? 1.0 : exp_below<double>(logits, c, top.largest)) / (1.0 + rest);
    d_logits[c] = static_cast<float>(rule.slope * (total * p - mass));
  }
  return loss;
}

// Sum of a soft label, or -1 when a value is no probability.
__device__ double soft_sum(const float* target, std::int32_t cols, int lane) {
  double sum = 0;
  bool sound = true;
  for (std::int32_t c = lane; c < cols; c += kWarp) {
    sound = sound && target[c] >= 0 && isfinite(target[c]);
    sum += static_cast<double>(target[c]);
  }
  sum = warp_sum(sum);
  return __all_sync(kFullMask, sound) != 0 ? sum : -1.0;
}

// All lanes of a warp; every lane returns the same.
__device__ Term ray_term(const Rule& rule, View<const float> logits, View<float> d_logits, std::int64_t r, int lane) {
  const float* const row = logits.row(r);
  float* const d_row = d_logits.empty() ? nullptr : d_logits.row(r);
  const bool is_hard = !rule.hard.empty();
  const std::int32_t label = is_hard ? rule.hard(r, 0) : -1;
  const double target_sum = is_hard ? 0.0 : soft_sum(rule.soft.row(r), logits.cols, lane);
  const bool bad_label = is_hard ? label < -1 || label >= logits.cols : target_sum < 0;
  if (bad_label && lane == 0) note_fault(rule.fault, Stage::label, r);
  Term term{};
  if (bad_label || (is_hard ? label < 0 : target_sum == 0)) {
    clear_row(d_row, logits.cols, lane);
    return term;
  }
  const RowTop top = top_of_row(row, logits.cols, lane);
  if (!top.finite) {
    if (lane == 0) note_fault(rule.fault, Stage::logits, r);
    clear_row(d_row, logits.cols, lane);
    return term;
  }
  term.labelled = 1;
  if (is_hard) {
    term.loss = hard_row(rule, row, logits.cols, label, top, d_row, lane);
  } else {
    const float* const target = rule.soft.row(r);
    term.loss = soft_row(rule, row, logits.cols, target, target_sum, top, d_row, lane);
  }
  return term;
}

// A warp per ray; 4 C B read (again from cache for each of three sweeps) and 4 C B written per ray, soft labels 4 C B
// more. Rays of a block are added in order.
__global__ void __launch_bounds__(kSoftmaxThreads)
    cross_entropy_kernel(Rule rule, const StepCell* cell, double scale, View<const float> logits, View<float> d_logits,
                         Term* of_block) {
  __shared__ Term of_ray[kRays];
  const int lane = static_cast<int>(threadIdx.x % kWarp), warp = static_cast<int>(threadIdx.x / kWarp);
  const std::int64_t r = static_cast<std::int64_t>(blockIdx.x) * kRays + warp;
  const double normaliser = cell->semantic_normaliser;
  rule.slope = normaliser > 0 ? scale / normaliser : 0.0;
  Term term{};
  if (r < logits.rows) term = ray_term(rule, logits, d_logits, r, lane);
  if (lane == 0) of_ray[warp] = term;
  __syncthreads();
  if (threadIdx.x != 0) return;
  for (int w = 1; w < kRays; ++w) {
    term.loss += of_ray[w].loss;
    term.labelled += of_ray[w].labelled;
  }
  of_block[blockIdx.x] = term;
}

// One block; the order of the sum depends on `count` alone.
__global__ void __launch_bounds__(kSoftmaxThreads)
    term_total_kernel(const Term* of_block, std::int64_t count, LossSums* sums) {
  Term term{};
  for (std::int64_t i = threadIdx.x; i < count; i += kSoftmaxThreads) {
    term.loss += of_block[i].loss;
    term.labelled += of_block[i].labelled;
  }
  term.loss = block_sum<kSoftmaxThreads>(term.loss);
  term.labelled = block_sum<kSoftmaxThreads>(term.labelled);
  if (threadIdx.x != 0) return;
  sums->semantic = term.loss;
  sums->labelled = term.labelled;
}

// Looks for the largest size of a number: 4 B per number read.

constexpr int kRowsOfBlock = 32;

// A thread kCols columns of every n-th row: at most kThreads such pieces a row, with kCols of 4 on 16-byte boundaries.
template <int kCols>
__global__ void __launch_bounds__(kThreads)
    largest_kernel(View<const float> values, const std::int32_t* live_rows, std::uint32_t* largest) {
  struct alignas(sizeof(float) * kCols) Piece {
    float v[kCols];
  };
  const int pieces = values.cols / kCols, rows_at_once = kThreads / pieces;
  const int piece = static_cast<int>(threadIdx.x) % pieces, first = static_cast<int>(threadIdx.x) / pieces;
  const std::int64_t rows = first < rows_at_once ? live_count(live_rows, values.rows) : 0;
  const std::int64_t step = static_cast<std::int64_t>(gridDim.x) * rows_at_once;
  std::uint32_t most = 0;
#pragma unroll 4
  for (std::int64_t row = static_cast<std::int64_t>(blockIdx.x) * rows_at_once + first; row < rows; row += step) {
    const Piece d = reinterpret_cast<const Piece*>(values.row(row))[piece];
#pragma unroll
    for (int c = 0; c < kCols; ++c) most = max(most, __float_as_uint(fabsf(d.v[c])));
  }
  most = __reduce_max_sync(kFullMask, most);
  if (threadIdx.x % kWarp == 0 && most != 0) atomicMax(largest, most);
}

}  // namespace

void photometric_loss(Workspace& arena, View<const float> color, View<const float> target, double normaliser,
                      View<float> d_color, LossSums* sums) {
  const Workspace::Scope scope(arena);
  const unsigned blocks = blocks_of(3 * color.rows, kThreads * kEach);
  if (blocks == 0) {
    check(cudaMemsetAsync(&sums->squares, 0, sizeof sums->squares, launch().stream), "clearing a sum");
    return;
  }
  double* const of_block = blocks == 1 ? &sums->squares : arena.take<double>(blocks, 1).data;
  queue("colour loss", blocks, kThreads, error_kernel, color, target, 2.0 / normaliser, d_color, of_block);
  if (blocks == 1) return;
  sum_in_order(of_block, blocks, &sums->squares);
}

void sum_in_order(const double* numbers, std::int64_t count, double* total) {
  queue("sum of a loss", 1, kThreads, total_kernel, numbers, count, total);
}

void count_samples(View<const std::int32_t> first, View<const std::int32_t> drawn, View<const float> sigma,
                   LossSums* sums) {
  queue("counting samples", 1, kThreads, count_kernel, first, drawn, sigma, sums);
}

void semantic_cross_entropy(Workspace& arena, View<const float> logits, const SemanticTargets& targets,
                            View<const float> class_weight, double scale, View<float> d_logits, LossSums* sums) {
  SEMFIELD_CHECK(launch().cell != nullptr, "the divisor of the semantic loss is read from the step's cell");
  const Workspace::Scope scope(arena);
  const unsigned blocks = blocks_of(logits.rows, kRays);
  Term* const of_block = blocks == 0 ? nullptr : reinterpret_cast<Term*>(arena.take_bytes(blocks * sizeof(Term)));
  const Rule rule{targets.hard, targets.soft, class_weight, 0, launch().fault};
  queue("semantic loss", blocks, kSoftmaxThreads, cross_entropy_kernel, rule, launch().cell, scale, logits, d_logits,
        of_block);
  queue("sum of the semantic loss", 1, kSoftmaxThreads, term_total_kernel, of_block, blocks, sums);
}

void find_largest(View<const float> values, std::uint32_t* largest) {
  if (values.size() == 0) return;
  const bool by_four = values.cols % 4 == 0 && values.row_stride % 4 == 0 &&
                       reinterpret_cast<std::uintptr_t>(values.data) % sizeof(float4) == 0;
  SEMFIELD_CHECK(values.cols / (by_four ? 4 : 1) <= kThreads, "a block looks at whole rows");
  const auto kernel = by_four ? largest_kernel<4> : largest_kernel<1>;
  const unsigned most = 8U * static_cast<unsigned>(multiprocessors());
  queue("largest number", std::min(blocks_of(values.rows, kRowsOfBlock), most), kThreads, kernel, values,
        launch().live_rows, largest);
}

}  // namespace semfield::cuda
