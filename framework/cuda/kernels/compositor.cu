// Emission and absorption along rays on the device: a warp per ray, tiles of 32 samples, sums in float64.
#include <limits>

#include "cuda/kernels/hidden_channels.h"
#include "cuda/kernels/ray_scan.cuh"
#include "cuda/kernels/rendering.h"
#include "model/compositor.h"

namespace semfield::cuda {

namespace {

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

}  // namespace

void composite_forward(const CompositeIn<float>& in, const CompositeOut<float>& out) {
  const Samples<float>& samples = *in.samples;
  const std::int64_t rays = samples.first.rows - 1;
  if (rays == 0 && out.weight.rows == 0) return;
  forward_kernel<<<ray_blocks(rays), kRayThreads, 0, launch().stream>>>(samples, in, out, launch().fault);
  check_launch("compositing");
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
    density_gradient_kernel<<<ray_blocks(rays), kRayThreads, 0, launch().stream>>>(
        samples, in, grad, with_dots ? d_out.rows : grad.dotted_rays, d_sigma);
    check_launch("gradient of density");
  }
  if (!d_rgb.empty() && d_rgb.rows > 0) {
    color_gradient_kernel<<<blocks_of(d_rgb.rows, kColorRows), kColorThreads, 0, launch().stream>>>(samples, out.weight,
                                                                                                    grad.color, d_rgb);
    check_launch("gradient of colour");
  }
}

}  // namespace semfield::cuda
