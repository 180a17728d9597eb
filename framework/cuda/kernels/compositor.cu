// Emission and absorption along rays on the device: a warp per ray, tiles of 32 samples, sums in float64.
#include <climits>
#include <limits>

#include "compute/math_functions.h"
#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/kernels.h"
#include "model/compositor.h"
#include "model/stages.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;

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
__global__ void __launch_bounds__(kThreads) density_kernel(DensityRule rule, Samples<float> samples, View<float> raw,
                                                           View<float> sigma, const StepCell* cell, FaultKey* fault) {
  const std::int64_t m = thread_index();
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
    density_slope_kernel(DensityActivation activation, float per_m, View<const float> raw, View<const float> d_sigma,
                         View<float> d_raw) {
  const std::int64_t m = thread_index();
  if (m < raw.rows) d_raw(m, 0) = d_sigma(m, 0) * slope_of(activation, raw(m, 0)) * per_m;
}

// Whether steps along rays were short enough.

// Both seen: the larger weight is first; of equal ones the earlier sample.
__device__ OpacitySums merged(const OpacitySums& a, const OpacitySums& b) {
  OpacitySums sum;
  sum.opacity = a.opacity + b.opacity;
  const bool take_b = b.first > a.first || (b.first == a.first && b.at < a.at);
  sum.first = take_b ? b.first : a.first;
  sum.at = take_b ? b.at : a.at;
  const double other = take_b ? a.first : b.first, own = take_b ? b.second : a.second;
  sum.second = other > own ? other : own;
  return sum;
}

// A warp per ray, 4 B per sample; fixed tree of sums.
__global__ void __launch_bounds__(kRayThreads)
    resolution_kernel(Samples<float> samples, View<const float> weight, FarMode far, double footprint_per_m,
                      View<OpacityResolution> result) {
  const WarpRay at(samples.first);
  if (!at.exists()) return;
  const std::int32_t end = at.end - (far == FarMode::background ? 1 : 0);
  OpacitySums sums;
  sums.at = INT_MAX;
  for (std::int32_t k = at.begin + at.lane; k < end; k += kWarp) {
    OpacitySums one;
    one.opacity = one.first = static_cast<double>(weight(k, 0));
    one.at = k;
    sums = merged(sums, one);
  }
  for (int offset = kWarp / 2; offset > 0; offset /= 2) {
    OpacitySums other;
    other.opacity = __shfl_xor_sync(kFullMask, sums.opacity, offset);
    other.first = __shfl_xor_sync(kFullMask, sums.first, offset);
    other.second = __shfl_xor_sync(kFullMask, sums.second, offset);
    other.at = __shfl_xor_sync(kFullMask, sums.at, offset);
    sums = merged(sums, other);
  }
  if (at.lane != 0) return;
  OpacityResolution found = OpacityResolution::clear;
  if (sums.opacity > 0) {
    found = resolution_of(sums, static_cast<double>(samples.t(sums.at, 0)),
                          static_cast<double>(samples.delta(sums.at, 0)), footprint_per_m);
  }
  result(at.ray, 0) = found;
}

// What a lane reads of its sample.
struct Sample {
  float sigma = 0, delta = 0, t = 0;
  float rgb[3] = {};
};

__device__ Sample read_sample(const Samples<float>& samples, const CompositeIn<float>& in, std::int32_t k,
                              std::int32_t begin, std::int32_t end) {
  Sample s;
  if (k < begin || k >= end) return s;
  s.sigma = in.sigma(k, 0);
  s.delta = samples.delta(k, 0);
  s.t = samples.t(k, 0);
  if (in.rgb.empty()) return s;
  for (int c = 0; c < 3; ++c) s.rgb[c] = in.rgb(k, c);
  return s;
}

// Alpha from float64 optical depth, and what passes through one: in float, as on the CPU.
__device__ float alpha_of(double depth) { return 0.0F - expm1f(static_cast<float>(-depth)); }
__device__ float passing(double depth) { return expf(static_cast<float>(-depth)); }

// 24 B read and 4 B written per sample; the next tile is on its way while one is summed. Fixed trees of sums. Weights
// of rows that no ray owns are cleared by all threads together.
__global__ void __launch_bounds__(kRayThreads)
    forward_kernel(Samples<float> samples, CompositeIn<float> in, CompositeOut<float> out, FaultKey* fault) {
  const WarpRay at(samples.first);
  at.clear_behind(samples.first, out.weight);
  if (!at.exists()) return;
  const std::int32_t rest = in.far == FarMode::background ? at.end - 1 : -1;  // it takes all that is left
  double depth_in_front = 0, opacity = 0, distance = 0, color[3] = {};
  Sample next = read_sample(samples, in, at.begin + at.lane, at.begin, at.end);
  for (std::int32_t first = at.begin; first < at.end; first += kWarp) {
    const Sample s = next;
    const std::int32_t k = first + at.lane;
    next = read_sample(samples, in, k + kWarp, at.begin, at.end);
    const double own = k == rest ? std::numeric_limits<double>::infinity() : optical_depth(s.sigma, s.delta);
    const double behind = depth_in_front + warp_prefix(own, at.lane);
    const double before = __shfl_up_sync(kFullMask, behind, 1);
    const float weight = passing(at.lane == 0 ? depth_in_front : before) * alpha_of(own);
    depth_in_front = __shfl_sync(kFullMask, behind, kWarp - 1);
    if (k >= at.end) continue;
    out.weight(k, 0) = weight;
    if (!(isfinite(s.rgb[0]) && isfinite(s.rgb[1]) && isfinite(s.rgb[2]))) note_fault(fault, Stage::color, k);
    if (weight == 0) continue;
    const double w = static_cast<double>(weight);
    opacity += w;
    distance += w * static_cast<double>(s.t);
    for (int c = 0; c < 3; ++c) color[c] += w * static_cast<double>(s.rgb[c]);
  }
  opacity = warp_sum(opacity);
  distance = warp_sum(distance);
  for (int c = 0; c < 3; ++c) color[c] = warp_sum(color[c]);
  if (at.lane != 0) return;
  const double behind = in.far == FarMode::closed ? 0.0 : static_cast<double>(passing(depth_in_front));
  for (int c = 0; c < 3 && !out.color.empty(); ++c) {
    out.color(at.ray, c) = static_cast<float>(color[c] + behind * in.background[static_cast<std::size_t>(c)]);
  }
  if (!out.depth.empty()) out.depth(at.ray, 0) = static_cast<float>(distance);
  if (!out.opacity.empty()) out.opacity(at.ray, 0) = static_cast<float>(opacity);
}

// Gradients at one ray's outputs.
struct RayGrad {
  double color[3] = {};
  double depth = 0, opacity = 0;
  double behind = 0;  // dL/dT_end: what the background colour gives

  __device__ RayGrad(const CompositeIn<float>& in, const CompositeGrad<float>& grad, std::int64_t r) {
    for (int c = 0; c < 3 && r < grad.color.rows; ++c) color[c] = static_cast<double>(grad.color(r, c));
    if (r < grad.depth.rows) depth = static_cast<double>(grad.depth(r, 0));
    if (r < grad.opacity.rows) opacity = static_cast<double>(grad.opacity(r, 0));
    for (int c = 0; c < 3 && in.far != FarMode::closed; ++c)
      behind += color[c] * in.background[static_cast<std::size_t>(c)];
  }
};

// Optical depth in front of each tile of the ray, 32 tiles at a time: lane i gets that of tile first_tile + i.
__device__ double depth_in_front_of_tiles(const Samples<float>& samples, const CompositeIn<float>& in,
                                          const WarpRay& at, std::int32_t first_tile, std::int32_t end_tile) {
  double depth = 0, held = 0;
#pragma unroll 4
  for (std::int32_t tile = 0; tile < end_tile; ++tile) {
    const std::int32_t k = at.begin + tile * kWarp + at.lane;
    const double own = k < at.end ? optical_depth(in.sigma(k, 0), samples.delta(k, 0)) : 0.0;
    if (tile - first_tile == at.lane) held = depth;
    depth += warp_sum(own);
  }
  return held;
}

// d_sigma by the recurrence from the back, R_k = R_{k+1} + alpha_k (v_k - R_{k+1}): within a tile as a suffix scan of
// the maps R -> (1 - alpha) R + alpha v. d_sigma holds dL/d(hidden) . h on entry for samples of the first `dot_rays`
// rays. 36 B read (sigma and delta twice, the second time from cache) and 4 B written per sample; fixed trees of sums.
__global__ void __launch_bounds__(kRayThreads)
    density_gradient_kernel(Samples<float> samples, CompositeIn<float> in, CompositeGrad<float> grad,
                            std::int64_t dot_rays, View<float> d_sigma) {
  const WarpRay at(samples.first);
  at.clear_behind(samples.first, d_sigma);
  if (!at.exists() || at.begin == at.end) return;
  const RayGrad ray(in, grad, at.ray);
  const bool with_dots = at.ray < dot_rays;
  const std::int32_t last = in.far == FarMode::background ? at.end - 1 : -1;
  const std::int32_t tiles = (at.end - at.begin + kWarp - 1) / kWarp;
  const auto read = [&](std::int32_t tile, float& dot) {
    const std::int32_t k = at.begin + tile * kWarp + at.lane;
    dot = with_dots && k >= at.begin && k < at.end ? d_sigma(k, 0) : 0.0F;
    return read_sample(samples, in, k, at.begin, at.end);
  };
  double result = ray.behind;  // R behind the tile
  float next_dot;
  Sample next = read(tiles - 1, next_dot);
  for (std::int32_t group = (tiles - 1) / kWarp * kWarp; group >= 0; group -= kWarp) {
    const std::int32_t end_tile = min(tiles, group + kWarp);
    const double in_front = depth_in_front_of_tiles(samples, in, at, group, end_tile);
    for (std::int32_t tile = end_tile - 1; tile >= group; --tile) {
      const Sample s = next;
      const double dot = static_cast<double>(next_dot);
      const std::int32_t k = at.begin + tile * kWarp + at.lane;
      next = read(tile - 1, next_dot);
      const double own = optical_depth(s.sigma, s.delta);
      const double depth = __shfl_sync(kFullMask, in_front, tile - group) + warp_prefix(own, at.lane);
      const double after = static_cast<double>(passing(depth));                 // T_{k+1}
      double value = ray.depth * static_cast<double>(s.t) + ray.opacity + dot;  // v_k = dL/dw_k
      for (int c = 0; c < 3; ++c) value += ray.color[c] * static_cast<double>(s.rgb[c]);
      if (!grad.weight.empty() && k >= at.begin && k < at.end) value += static_cast<double>(grad.weight(k, 0));
      Affine map;
      if (k == last) {
        map = {0, value};
      } else if (k < at.end) {
        const double alpha = static_cast<double>(alpha_of(own));
        map = {1 - alpha, alpha * value};
      }
      map = warp_suffix(map, at.lane);
      const double keep = __shfl_down_sync(kFullMask, map.keep, 1), gain = __shfl_down_sync(kFullMask, map.gain, 1);
      const double behind = at.lane == kWarp - 1 ? result : keep * result + gain;  // R_{k+1}
      result = __shfl_sync(kFullMask, map.keep * result + map.gain, 0);
      if (k >= at.end) continue;
      // Behind an opaque sample nothing is seen; an infinite interval is a switch without a slope; the last sample of a
      // background takes the rest whatever its density.
      const bool has_slope = after != 0 && !isinf(s.delta) && k != last;
      d_sigma(k, 0) = has_slope ? static_cast<float>(static_cast<double>(s.delta) * after * (value - behind)) : 0.0F;
    }
  }
}

constexpr int kColorRows = 128;  // a block
constexpr int kColorThreads = 3 * kColorRows;

// d_rgb = w dL/dC, one thread a channel of a sample: 8 B read and 12 B written per sample, all of it coalesced.
__global__ void __launch_bounds__(kColorThreads) color_gradient_kernel(Samples<float> samples, View<const float> weight,
                                                                       View<const float> d_color, View<float> d_rgb) {
  const std::int64_t m = static_cast<std::int64_t>(blockIdx.x) * kColorRows + threadIdx.x / 3;
  const int c = static_cast<int>(threadIdx.x % 3);
  if (m >= d_rgb.rows) return;
  float value = 0;
  if (m < samples.first(samples.first.rows - 1, 0)) {
    const std::int32_t r = samples.ray_of_sample(m, 0);
    if (r < d_color.rows) value = weight(m, 0) * d_color(r, c);
  }
  d_rgb(m, c) = value;
}

// Samples that a semantic branch keeps, what its network reads of them, and dropout; points in place of samples.

__device__ bool weighs(float weight, float least) { return weight >= least && weight > 0; }

// A thread per ray, 4 B per sample.
struct CountKept {
  View<const std::int32_t> first;
  View<const float> weight;
  float least;
  __device__ std::int32_t operator()(std::int64_t ray, FaultKey*) const {
    std::int32_t count = 0;
    for (std::int32_t m = first(ray, 0); m < first(ray + 1, 0); ++m) count += weighs(weight(m, 0), least) ? 1 : 0;
    return count;
  }
};

// A warp per ray: 4 B read per sample, 24 B moved a kept one. The sum of weights in a fixed tree.
__global__ void __launch_bounds__(kRayThreads)
    keep_kernel(Samples<float> samples, View<const float> weight, float least, BranchTrace<float> kept) {
  fill_unused_rows(kept.samples, kept.share.rows);
  for (std::int64_t k = kept.samples.first(kept.share.rows, 0) + thread_index(); k < kept.samples.count;
       k += grid_threads()) {
    kept.source(k, 0) = 0;
    kept.weight(k, 0) = 0;
  }
  const WarpRay at(samples.first);
  if (at.ray >= kept.share.rows) return;
  std::int32_t next = kept.samples.first(at.ray, 0);
  float share = 0;
  for (std::int32_t base = at.begin; base < at.end; base += kWarp) {
    const std::int32_t m = base + at.lane;
    const float w = m < at.end ? weight(m, 0) : 0.0F;
    const bool keeps = m < at.end && weighs(w, least);
    const unsigned all = __ballot_sync(kFullMask, keeps);
    if (keeps) {
      const std::int32_t k = next + __popc(all & ((1U << at.lane) - 1));
      kept.samples.t(k, 0) = samples.t(m, 0);
      kept.samples.delta(k, 0) = samples.delta(m, 0);
      kept.samples.ray_of_sample(k, 0) = static_cast<std::int32_t>(at.ray);
      kept.source(k, 0) = m;
      kept.weight(k, 0) = w;
      share += w;
    }
    next += __popc(all);
  }
  share = warp_sum(share);
  if (at.lane == 0) kept.share(at.ray, 0) = share;
}

// Calls `take(m, place)` of a lane's sample m, the place-th that is reached, and gives how many there are. A ray ends
// where light does, so that a warp reads little more than it finds.
template <class Take>
__device__ std::int32_t walk_reached(const WarpRay& at, const Samples<float>& samples, View<const float> sigma,
                                     const ReachedBy& rule, double deepest, const Take& take) {
  const std::int32_t end = static_cast<std::int32_t>(min(static_cast<std::int64_t>(at.end), at.begin + rule.end));
  const std::int64_t begin = at.begin + rule.begin;
  std::int32_t found = 0;
  double in_front = 0;
  for (std::int32_t base = at.begin; base < end && in_front <= deepest; base += kWarp) {
    const std::int32_t m = base + at.lane;
    const double own = m < end ? optical_depth(sigma(m, 0), samples.delta(m, 0)) : 0.0;
    const double behind = in_front + warp_prefix(own, at.lane);
    const double before = __shfl_up_sync(kFullMask, behind, 1);
    const bool is_reached = m < end && m >= begin && (at.lane == 0 ? in_front : before) <= deepest;
    const unsigned all = __ballot_sync(kFullMask, is_reached);
    if (is_reached) take(m, found + __popc(all & ((1U << at.lane) - 1)));
    found += __popc(all);
    in_front = __shfl_sync(kFullMask, behind, kWarp - 1);
  }
  return found;
}

// A warp per ray, 8 B per sample.
__global__ void __launch_bounds__(kRayThreads)
    count_reached_kernel(Samples<float> samples, View<const float> sigma, ReachedBy rule, double deepest,
                         View<std::int32_t> counts) {
  const WarpRay at(samples.first);
  if (!at.exists()) return;
  const std::int32_t found = walk_reached(at, samples, sigma, rule, deepest, [](std::int32_t, std::int32_t) {});
  if (at.lane == 0) counts(at.ray, 0) = found;
}

struct CountReached {
  View<const std::int32_t> counts;
  __device__ std::int32_t operator()(std::int64_t ray, FaultKey*) const { return counts(ray, 0); }
};

// A warp per ray, 8 B per sample and 20 B moved of one that is reached.
__global__ void __launch_bounds__(kRayThreads)
    take_reached_kernel(Samples<float> samples, View<const float> sigma, ReachedBy rule, double deepest,
                        ChosenSamples<float> chosen) {
  const WarpRay at(samples.first);
  fill_unused_rows(chosen.samples, at.rays);
  for (std::int64_t k = chosen.samples.first(at.rays, 0) + thread_index(); k < chosen.samples.count;
       k += grid_threads())
    chosen.source(k, 0) = 0;
  if (!at.exists()) return;
  const std::int32_t first = chosen.samples.first(at.ray, 0), room = chosen.samples.first(at.ray + 1, 0) - first;
  walk_reached(at, samples, sigma, rule, deepest, [&](std::int32_t m, std::int32_t place) {
    if (place >= room) return;
    const std::int32_t k = first + place;
    chosen.samples.t(k, 0) = samples.t(m, 0);
    chosen.samples.delta(k, 0) = samples.delta(m, 0);
    chosen.samples.ray_of_sample(k, 0) = static_cast<std::int32_t>(at.ray);
    chosen.source(k, 0) = m;
  });
}

// 12 B per row.
__global__ void __launch_bounds__(kThreads)
    spread_kernel(ChosenSamples<float> chosen, View<const float> from, View<float> to) {
  const std::int64_t k = thread_index();
  if (k < chosen.samples.first(chosen.samples.first.rows - 1, 0)) to(chosen.source(k, 0), 0) = from(k, 0);
}

// A warp a row of the input, 8 B a value.
__global__ void __launch_bounds__(kThreads)
    join_kernel(BranchTrace<float> trace, View<const float> position, View<const float> feature) {
  const std::int64_t k = thread_index() / kWarp;
  if (k >= trace.input.rows) return;
  const bool live = k < trace.samples.first(trace.share.rows, 0);
  const std::int64_t source = live ? trace.source(k, 0) : 0;
  for (std::int32_t c = static_cast<std::int32_t>(threadIdx.x) % kWarp; c < trace.input.cols; c += kWarp) {
    float value = 0;
    if (live) value = c < position.cols ? position(k, c) : feature(source, c - position.cols);
    trace.input(k, c) = value;
  }
}

// A thread kDropoutGroup values of a row, 8 B each.
__global__ void __launch_bounds__(kThreads)
    dropout_kernel(Dropout rule, Samples<float> samples, View<const float> from, View<float> to, const StepCell* cell) {
  const std::int64_t at = thread_index();
  const std::int32_t groups = (to.cols + kDropoutGroup - 1) / kDropoutGroup;
  const std::int64_t k = at / groups;
  const auto group = static_cast<std::int32_t>(at % groups);
  if (k >= to.rows) return;
  const std::int32_t begin = group * kDropoutGroup;
  const bool live = k < samples.first(samples.first.rows - 1, 0);
  DropoutFactors factors{};
  if (live) {
    const std::int32_t ray = samples.ray_of_sample(k, 0);
    factors = dropout_factors(at_step(rule.random, cell), rule.share, rule.first_ray + ray, k - samples.first(ray, 0),
                              group, to.cols);
  }
  for (std::int32_t i = 0; i < kDropoutGroup && begin + i < to.cols; ++i)
    to(k, begin + i) = live ? from(k, begin + i) * factors.of[i] : 0.0F;
}

__global__ void __launch_bounds__(kThreads) count_kernel(View<std::int32_t> numbers) {
  const std::int64_t i = thread_index();
  if (i < numbers.rows) numbers(i, 0) = static_cast<std::int32_t>(i);
}

// A warp per point; 8 B per number of its row.
__global__ void __launch_bounds__(kThreads)
    choose_kernel(View<const std::int32_t> choice, View<const float> from, View<const std::int16_t> logit,
                  View<float> to, View<std::int16_t> to_logit) {
  const std::int64_t i = thread_index() / kWarp;
  if (i >= to.rows) return;
  const std::int64_t point = choice(i, 0);
  const auto lane = static_cast<std::int32_t>(threadIdx.x % kWarp);
  for (std::int32_t c = lane; c < to.cols; c += kWarp) to(i, c) = from(point, c);
  if (lane == 0) to_logit(i, 0) = logit(point, 0);
}

// What rendering tells of classes, a warp per ray.

constexpr int kRays = 8;  // a block
constexpr int kClassThreads = kRays * kWarp;

// Exponentials in float64, as on the CPU. 4 C B read (again from cache for each sweep) and up to 14 + 4 C B
// written per ray.
__global__ void __launch_bounds__(kClassThreads) results_kernel(View<const float> logits, ClassResults<float> results) {
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

void density_forward(const DensityRule& rule, const Samples<float>* samples, View<float> raw, View<float> sigma) {
  queue("density", blocks_of(raw.rows, kThreads), kThreads, density_kernel, rule,
        samples == nullptr ? Samples<float>{} : *samples, raw, sigma, launch().cell, launch().fault);
}

void density_backward(const DensityRule& rule, View<const float> raw, View<const float> d_sigma, View<float> d_raw) {
  queue("density gradient", blocks_of(raw.rows, kThreads), kThreads, density_slope_kernel, rule.activation,
        static_cast<float>(rule.per_m), raw, d_sigma, d_raw);
}

void opacity_resolutions(const Samples<float>& samples, View<const float> weight, FarMode far, double footprint_per_m,
                         View<OpacityResolution> result) {
  queue("opacity resolution", blocks_of(samples.first.rows - 1, kRaysPerBlock), kRayThreads, resolution_kernel, samples,
        weight, far, footprint_per_m, result);
}

void composite_forward(const CompositeIn<float>& in, const CompositeOut<float>& out) {
  const Samples<float>& samples = *in.samples;
  const std::int64_t rays = samples.first.rows - 1;
  if (rays == 0 && out.weight.rows == 0) return;
  queue("compositing", ray_blocks(rays), kRayThreads, forward_kernel, samples, in, out, launch().fault);
  if (!in.hidden.empty() && !out.hidden.empty()) hidden_forward<float>(samples, out.weight, in.hidden, out.hidden);
}

void composite_backward(const CompositeIn<float>& in, const CompositeOut<float>& out, const CompositeGrad<float>& grad,
                        View<float> d_sigma, View<float> d_rgb, View<float> d_hidden) {
  const Samples<float>& samples = *in.samples;
  const std::int64_t rays = samples.first.rows - 1;
  const View<const float> d_out = in.hidden.empty() ? View<const float>() : grad.hidden;
  const bool with_dots = !d_sigma.empty() && !d_out.empty() && grad.hidden_moves_density;
  if (with_dots || !d_hidden.empty()) {
    hidden_backward<float>(samples,
                           {out.weight, in.hidden, d_out, with_dots ? d_sigma : View<float>(), d_hidden, false});
  }
  if (!d_sigma.empty() && d_sigma.rows > 0) {
    queue("gradient of density", ray_blocks(rays), kRayThreads, density_gradient_kernel, samples, in, grad,
          with_dots ? d_out.rows : grad.dotted_rays, d_sigma);
  }
  if (!d_rgb.empty() && d_rgb.rows > 0) {
    queue("gradient of colour", blocks_of(d_rgb.rows, kColorRows), kColorThreads, color_gradient_kernel, samples,
          out.weight, grad.color, d_rgb);
  }
}

void keep_samples(const Samples<float>& samples, View<const float> weight, float least,
                  const BranchTrace<float>& kept) {
  const std::int64_t rays = kept.share.rows;
  if (rays == 0) return;
  queue_offsets(CountKept{samples.first, weight, least}, rays, kept.samples.first);
  queue("samples of a semantic branch", ray_blocks(rays), kRayThreads, keep_kernel, samples, weight, least, kept);
}

void reached_samples(const Samples<float>& samples, View<const float> sigma, const ReachedBy& rule,
                     View<std::int32_t> counts, const ChosenSamples<float>& chosen) {
  const std::int64_t rays = counts.rows;
  if (rays == 0) return;
  const double deepest = -std::log(rule.least);
  queue("counting samples that are reached", ray_blocks(rays), kRayThreads, count_reached_kernel, samples, sigma, rule,
        deepest, counts);
  queue_offsets(CountReached{counts}, rays, chosen.samples.first, chosen.samples.count);
  queue("samples that are reached", ray_blocks(rays), kRayThreads, take_reached_kernel, samples, sigma, rule, deepest,
        chosen);
}

void spread_rows(const ChosenSamples<float>& chosen, View<const float> from, View<float> to) {
  queue("densities of samples", blocks_of(chosen.samples.count, kThreads), kThreads, spread_kernel, chosen, from, to);
}

void join_inputs(const BranchTrace<float>& trace, View<const float> position, View<const float> feature) {
  queue("inputs of a semantic branch", blocks_of(trace.input.rows * kWarp, kThreads), kThreads, join_kernel, trace,
        position, feature);
}

void drop_out(const Dropout& rule, const Samples<float>& samples, View<const float> from, View<float> to) {
  const std::int64_t groups = to.rows * ((to.cols + kDropoutGroup - 1) / kDropoutGroup);
  queue("dropout", blocks_of(groups, kThreads), kThreads, dropout_kernel, rule, samples, from, to, launch().cell);
}

void count_up(View<std::int32_t> numbers) {
  queue("numbers of rows", blocks_of(numbers.rows, kThreads), kThreads, count_kernel, numbers);
}

void choose_points(View<const std::int32_t> choice, View<const float> from, View<const std::int16_t> logit,
                   View<float> to, View<std::int16_t> to_logit) {
  queue("points of a lesson", blocks_of(to.rows * kWarp, kThreads), kThreads, choose_kernel, choice, from, logit, to,
        to_logit);
}

void class_results(View<float> logits, const ClassResults<float>& results) {
  queue("class results", blocks_of(logits.rows, kRays), kClassThreads, results_kernel, logits, results);
}

}  // namespace semfield::cuda
