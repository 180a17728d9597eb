// Rows of activations are read in vectors of 16 bytes (bf16) or one by one (fp32). Forward: some lanes of a warp share
// a row and add their parts by shuffles. Backward: a thread owns the same columns of all rows of its block's range, so
// that weight gradients stay in registers; blocks leave parts that are added in order.
#include <algorithm>
#include <type_traits>

#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/layers.h"
#include "fields/nerf_mlp/nerf_mlp_heads.cuh"
#include "fields/nerf_mlp/nerf_mlp_math.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;
constexpr int kChannels = 3;

template <class Act>
constexpr int kVector = std::is_same_v<Act, float> ? 1 : 8;

template <class Act>
struct alignas(sizeof(Act) * kVector<Act>) Pack {
  Act v[kVector<Act>];
};

__device__ inline float to_float(float x) { return x; }
__device__ inline float to_float(__nv_bfloat16 x) { return __bfloat162float(x); }
__device__ inline void assign(float& to, float value) { to = value; }
__device__ inline void assign(__nv_bfloat16& to, float value) { to = __float2bfloat16_rn(value); }

template <class Act>
__device__ inline Pack<Act> load(View<const Act> m, std::int64_t row, int group) {
  return *reinterpret_cast<const Pack<Act>*>(m.row(row) + group * kVector<Act>);
}
template <class Act>
__device__ inline void store(View<Act> m, std::int64_t row, int group, const Pack<Act>& value) {
  *reinterpret_cast<Pack<Act>*>(m.row(row) + group * kVector<Act>) = value;
}

// Lanes that share a row: a power of two, enough for its vectors or a warp.
int lanes_of(int groups) {
  int lanes = 1;
  while (lanes < groups && lanes < kWarp) lanes *= 2;
  return lanes;
}

// Sum over the `lanes` lanes of a row.
__device__ inline float row_sum(float value, int lanes) {
  for (int offset = lanes / 2; offset > 0; offset /= 2) value += __shfl_xor_sync(kFullMask, value, offset);
  return value;
}

// `lanes` lanes per row. Moves width * sizeof(Act) + 4 bytes per row, and 4 width more with a feature.
template <class Act>
__global__ void density_forward_kernel(DensityHead<Act> call, int lanes, bool wide_feature) {
  constexpr int kV = kVector<Act>;
  extern __shared__ float weight[];  // [width of h], padding 0
  for (int k = static_cast<int>(threadIdx.x); k < call.h.cols; k += kThreads) {
    weight[k] = k < call.weight.rows ? call.weight(k, 0) : 0;
  }
  __syncthreads();
  const std::int64_t thread = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  const std::int64_t row = thread / lanes;
  const int lane = static_cast<int>(thread % lanes), groups = call.h.cols / kV;
  const bool live = row < call.h.rows;
  float sum = 0;
  for (int group = lane; live && group < groups; group += lanes) {
    const Pack<Act> h = load(call.h, row, group);
    const int col = group * kV;
#pragma unroll
    for (int k = 0; k < kV; ++k) sum = fmaf(to_float(h.v[k]), weight[col + k], sum);
    if (call.feature.empty()) continue;
    float* to = call.feature.row(row) + col;
    if (kV == 8 && wide_feature) {
#pragma unroll
      for (int k = 0; k < kV; k += 4) {
        reinterpret_cast<float4*>(to)[k / 4] = make_float4(to_float(h.v[k]), to_float(h.v[(k + 1) % kV]),
                                                           to_float(h.v[(k + 2) % kV]), to_float(h.v[(k + 3) % kV]));
      }
    } else {
#pragma unroll
      for (int k = 0; k < kV; ++k) {
        if (col + k < call.feature.cols) to[k] = to_float(h.v[k]);
      }
    }
  }
  sum = row_sum(sum, lanes);
  if (live && lane == 0 && !call.sigma.empty()) call.sigma(row, 0) = sum + call.bias(0, 0);
}

// What a thread owns in a backward: one vector of columns, in every slots-th row of the block's range.
struct Owner {
  int group, local, slot, slots, owned;
  __device__ Owner(int groups, int first) {
    owned = groups - first < kThreads ? groups - first : kThreads;
    slots = kThreads / owned;
    local = static_cast<int>(threadIdx.x) % owned;
    slot = static_cast<int>(threadIdx.x) / owned;
    group = first + local;
  }
  __device__ bool idle() const { return slot >= slots; }
};

// blockIdx.x: range of rows; blockIdx.y: range of up to kThreads vectors of columns. Moves up to 2 width sizeof(Act) +
// 4 width + 4 bytes per row. partial [blocks, width of h + 1], the last column for the bias.
template <class Act>
__global__ void density_backward_kernel(DensityHeadGrad<Act> call, std::int64_t rows_each, View<float> partial,
                                        bool wide_feature) {
  constexpr int kV = kVector<Act>;
  __shared__ float share[kThreads][kV + 1];
  const Owner own(call.dh.cols / kV, static_cast<int>(blockIdx.y) * kThreads);
  const std::int64_t begin = static_cast<std::int64_t>(blockIdx.x) * rows_each;
  const std::int64_t end = begin + rows_each < call.dh.rows ? begin + rows_each : call.dh.rows;
  const int col = own.group * kV;
  const bool with_sigma = !call.d_sigma.empty(), with_feature = !call.d_feature.empty();
  const bool reads_h = with_sigma || call.masked;
  float weight[kV], sum[kV], sigma_sum = 0;
#pragma unroll
  for (int k = 0; k < kV; ++k) {
    weight[k] = !own.idle() && col + k < call.weight.rows ? call.weight(col + k, 0) : 0;
    sum[k] = 0;
  }
#pragma unroll 4
  for (std::int64_t row = own.idle() ? end : begin + own.slot; row < end; row += own.slots) {
    const float d_sigma = with_sigma ? call.d_sigma(row, 0) : 0;
    float value[kV];
    if (!call.d_rounded_feature.empty()) {
      Pack<Act> rounded{};
      if (row < call.d_rounded_feature.rows) rounded = load(call.d_rounded_feature, row, own.group);
#pragma unroll
      for (int k = 0; k < kV; ++k) value[k] = to_float(rounded.v[k]);
    } else if (kV == 8 && wide_feature && with_feature) {
      const auto* from = reinterpret_cast<const float4*>(call.d_feature.row(row) + col);
#pragma unroll
      for (int k = 0; k < kV; k += 4) {
        const float4 four = from[k / 4];
        value[k] = four.x;
        value[(k + 1) % kV] = four.y;
        value[(k + 2) % kV] = four.z;
        value[(k + 3) % kV] = four.w;
      }
    } else {
#pragma unroll
      for (int k = 0; k < kV; ++k)
        value[k] = with_feature && col + k < call.d_feature.cols ? call.d_feature(row, col + k) : 0;
    }
    Pack<Act> h{}, result;
    if (reads_h) h = load(call.h, row, own.group);
#pragma unroll
    for (int k = 0; k < kV; ++k) {
      const float activation = to_float(h.v[k]);
      sum[k] = fmaf(activation, d_sigma, sum[k]);
      const float gradient = fmaf(d_sigma, weight[k], value[k]);
      assign(result.v[k], call.masked && !(activation > 0) ? 0.0F : gradient);
    }
    sigma_sum += d_sigma;
    store(call.dh, row, own.group, result);
  }
  if (!with_sigma) return;
#pragma unroll
  for (int k = 0; k < kV; ++k) share[threadIdx.x][k] = sum[k];
  share[threadIdx.x][kV] = sigma_sum;
  __syncthreads();
  if (own.slot > 0) return;
  for (int k = 0; k <= kV; ++k) {
    float total = 0;
    for (int slot = 0; slot < own.slots; ++slot) total += share[slot * own.owned + own.local][k];
    if (k < kV) {
      partial(blockIdx.x, col + k) = total;
    } else if (own.group == 0) {
      partial(blockIdx.x, call.dh.cols) = total;
    }
  }
}

// `lanes` lanes per row. Moves 2 view sizeof(Act) + 4 (view / samples per ray) + 16 bytes per row.
template <class Act>
__global__ void color_forward_kernel(ColorHead<Act> call, int lanes) {
  constexpr int kV = kVector<Act>;
  extern __shared__ float weight[];  // [3, width of v], padding 0
  const int width = call.v.cols, groups = width / kV;
  for (int k = static_cast<int>(threadIdx.x); k < width * kChannels; k += kThreads) {
    const int col = k % width;
    weight[k] = col < call.weight.rows ? call.weight(col, k / width) : 0;
  }
  __syncthreads();
  const std::int64_t thread = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  const std::int64_t row = thread / lanes;
  const int lane = static_cast<int>(thread % lanes);
  const bool live = row < call.v.rows, with_term = !call.ray_term.empty();
  const float* term = live && with_term ? call.ray_term.row(call.ray_of_sample(row, 0)) : nullptr;
  float sum[kChannels] = {0, 0, 0};
  for (int group = lane; live && group < groups; group += lanes) {
    const View<const Act> v_view = call.v;
    Pack<Act> v = load(v_view, row, group);
    const int col = group * kV;
    if (with_term) {
#pragma unroll
      for (int k = 0; k < kV; ++k) {
        const float value = to_float(v.v[k]) + (col + k < call.ray_term.cols ? term[col + k] : 0.0F);
        assign(v.v[k], value < 0 ? 0.0F : value);
      }
      store(call.v, row, group, v);
    }
#pragma unroll
    for (int c = 0; c < kChannels; ++c) {
#pragma unroll
      for (int k = 0; k < kV; ++k) sum[c] = fmaf(to_float(v.v[k]), weight[c * width + col + k], sum[c]);
    }
  }
#pragma unroll
  for (int c = 0; c < kChannels; ++c) sum[c] = row_sum(sum[c], lanes);
  if (!live || lane > 0) return;
  for (int c = 0; c < kChannels; ++c) call.rgb(row, c) = 1 / (1 + expf(-(sum[c] + call.bias(0, c))));
}

// As density_backward_kernel. Moves 2 view sizeof(Act) + 24 bytes per row. partial [blocks, 3 width of v + 3].
template <class Act>
__global__ void color_backward_kernel(ColorHeadGrad<Act> call, std::int64_t rows_each, View<float> partial) {
  constexpr int kV = kVector<Act>;
  __shared__ float share[kThreads][kV + 1];
  const Owner own(call.v.cols / kV, static_cast<int>(blockIdx.y) * kThreads);
  const std::int64_t begin = static_cast<std::int64_t>(blockIdx.x) * rows_each;
  const std::int64_t end = begin + rows_each < call.v.rows ? begin + rows_each : call.v.rows;
  const int col = own.group * kV;
  float weight[kChannels][kV], sum[kChannels][kV], logit_sum[kChannels];
#pragma unroll
  for (int c = 0; c < kChannels; ++c) {
    logit_sum[c] = 0;
#pragma unroll
    for (int k = 0; k < kV; ++k) {
      weight[c][k] = !own.idle() && col + k < call.weight.rows ? call.weight(col + k, c) : 0;
      sum[c][k] = 0;
    }
  }
#pragma unroll 2
  for (std::int64_t row = own.idle() ? end : begin + own.slot; row < end; row += own.slots) {
    float d_logit[kChannels];
#pragma unroll
    for (int c = 0; c < kChannels; ++c) {
      d_logit[c] = call.d_rgb(row, c) * nerf_mlp_sigmoid_slope(call.rgb(row, c));
      logit_sum[c] += d_logit[c];
    }
    const Pack<Act> v = load(call.v, row, own.group);
    Pack<Act> result;
#pragma unroll
    for (int k = 0; k < kV; ++k) {
      const float activation = to_float(v.v[k]);
      float gradient = 0;
#pragma unroll
      for (int c = 0; c < kChannels; ++c) {
        gradient = fmaf(d_logit[c], weight[c][k], gradient);
        sum[c][k] = fmaf(activation, d_logit[c], sum[c][k]);
      }
      assign(result.v[k], activation > 0 ? gradient : 0.0F);
    }
    store(call.dv, row, own.group, result);
  }
#pragma unroll
  for (int c = 0; c < kChannels; ++c) {
    __syncthreads();
#pragma unroll
    for (int k = 0; k < kV; ++k) share[threadIdx.x][k] = sum[c][k];
    share[threadIdx.x][kV] = logit_sum[c];
    __syncthreads();
    if (own.slot > 0) continue;
    for (int k = 0; k <= kV; ++k) {
      float total = 0;
      for (int slot = 0; slot < own.slots; ++slot) total += share[slot * own.owned + own.local][k];
      if (k < kV) {
        partial(blockIdx.x, (col + k) * kChannels + c) = total;
      } else if (own.group == 0) {
        partial(blockIdx.x, call.v.cols * kChannels + c) = total;
      }
    }
  }
}

// Ranges of rows of a backward, a function of their number alone.
struct Ranges {
  std::int64_t blocks, rows_each;
  explicit Ranges(std::int64_t rows) {
    constexpr std::int64_t kMostBlocks = 1024, kLeastRows = 64;
    blocks = std::min<std::int64_t>(kMostBlocks, (rows + kLeastRows - 1) / kLeastRows);
    rows_each = (rows + blocks - 1) / blocks;
    blocks = (rows + rows_each - 1) / rows_each;
  }
};

bool wide(View<const float> m, std::int32_t cols) {
  return !m.empty() && m.cols == cols && m.row_stride % 4 == 0 && reinterpret_cast<std::uintptr_t>(m.data) % 16 == 0;
}

// A gradient tensor as one row.
View<float> flat(View<float> m) { return View<float>(m.data, 1, static_cast<std::int32_t>(m.size()), -1, m.device); }

}  // namespace

template <class Act>
void density_forward(const DensityHead<Act>& call) {
  if (call.h.rows == 0 || (call.sigma.empty() && call.feature.empty())) return;
  const int lanes = lanes_of(call.h.cols / kVector<Act>);
  density_forward_kernel<Act>
      <<<blocks_of(call.h.rows * lanes, kThreads), kThreads, static_cast<std::size_t>(call.h.cols) * sizeof(float),
         launch().stream>>>(call, lanes, wide(call.feature, call.h.cols));
  check_launch("density");
}

template <class Act>
void density_backward(const DensityHeadGrad<Act>& call, Workspace& arena) {
  if (call.dh.rows == 0) return;
  const Workspace::Scope scope(arena);
  const Ranges ranges(call.dh.rows);
  const View<float> partial = arena.take<float>(ranges.blocks, call.dh.cols + 1);
  const dim3 grid(static_cast<unsigned>(ranges.blocks), blocks_of(call.dh.cols / kVector<Act>, kThreads));
  density_backward_kernel<Act>
      <<<grid, kThreads, 0, launch().stream>>>(call, ranges.rows_each, partial, wide(call.d_feature, call.dh.cols));
  check_launch("density backward");
  if (call.d_sigma.empty()) return;
  add_partials(partial.col_range(0, static_cast<std::int32_t>(call.d_weight.size())), flat(call.d_weight));
  add_partials(partial.col_range(call.dh.cols, 1), call.d_bias);
}

template <class Act>
void color_forward(const ColorHead<Act>& call) {
  if (call.v.rows == 0) return;
  const int lanes = lanes_of(call.v.cols / kVector<Act>);
  const std::size_t shared = static_cast<std::size_t>(call.v.cols) * kChannels * sizeof(float);
  color_forward_kernel<Act>
      <<<blocks_of(call.v.rows * lanes, kThreads), kThreads, shared, launch().stream>>>(call, lanes);
  check_launch("colour");
}

template <class Act>
void color_backward(const ColorHeadGrad<Act>& call, Workspace& arena) {
  if (call.v.rows == 0) return;
  const Workspace::Scope scope(arena);
  const Ranges ranges(call.v.rows);
  const View<float> partial = arena.take<float>(ranges.blocks, call.v.cols * kChannels + kChannels);
  const dim3 grid(static_cast<unsigned>(ranges.blocks), blocks_of(call.v.cols / kVector<Act>, kThreads));
  color_backward_kernel<Act><<<grid, kThreads, 0, launch().stream>>>(call, ranges.rows_each, partial);
  check_launch("colour backward");
  add_partials(partial.col_range(0, static_cast<std::int32_t>(call.d_weight.size())), flat(call.d_weight));
  add_partials(partial.col_range(call.v.cols * kChannels, kChannels), call.d_bias);
}

#define SEMFIELD_INSTANTIATE(Act)                                               \
  template void density_forward<Act>(const DensityHead<Act>&);                  \
  template void density_backward<Act>(const DensityHeadGrad<Act>&, Workspace&); \
  template void color_forward<Act>(const ColorHead<Act>&);                      \
  template void color_backward<Act>(const ColorHeadGrad<Act>&, Workspace&);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(__nv_bfloat16)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield::cuda
