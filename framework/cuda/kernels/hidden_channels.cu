// Sums of hidden channels along rays. The H channels of a sample (4 B each, in bf16 2 B), read once, are most of what
// compositing moves.
#include <algorithm>
#include <type_traits>

#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/kernels.h"

namespace semfield::cuda {

namespace {

constexpr int kWarps = 4;     // a block of the forward sum: one ray
constexpr int kBlocks = 8;    // of a multiprocessor: room in registers for the rows in flight
constexpr int kInFlight = 8;  // rows that a warp asks for before it adds the first
// The same of the backward kernel, which has more warps: 16 channels of a lane.
template <int kVec>
constexpr int kRowsAtOnce = kVec == 8 ? 2 : 4;
constexpr int kBackWarps = 8;   // a block of the backward kernel
constexpr int kBackBlocks = 3;  // of a multiprocessor, as many as its registers hold without spills

// kVec consecutive channels of a lane, one access.
template <int kVec>
struct alignas(sizeof(float) * kVec) Channels {
  float v[kVec];
};

// As they lie in memory.
template <class Act, int kVec>
struct alignas(sizeof(Act) * kVec) Stored {
  Act v[kVec];
};

template <int kVec, class Act>
__device__ Channels<kVec> load(const Act* from) {
  const Stored<Act, kVec> stored = *reinterpret_cast<const Stored<Act, kVec>*>(from);
  Channels<kVec> values;
#pragma unroll
  for (int v = 0; v < kVec; ++v) values.v[v] = static_cast<float>(stored.v[v]);
  return values;
}
template <int kVec, class Act>
__device__ void store(Act* to, const Channels<kVec>& values) {
  Stored<Act, kVec> stored;
#pragma unroll
  for (int v = 0; v < kVec; ++v) stored.v[v] = static_cast<Act>(values.v[v]);
  *reinterpret_cast<Stored<Act, kVec>*>(to) = stored;
}

// A row is held by kWarp / kBeside lanes of kVec channels each; kBeside rows lie beside each other in a warp, so that
// few channels leave no lane idle. More channels than a row's lanes hold are taken in turns.
template <int kBeside, int kVec>
struct Lanes {
  static constexpr int kOfRow = kWarp / kBeside;
  static constexpr int kColumns = kOfRow * kVec;  // at once
  int part = static_cast<int>(threadIdx.x % kWarp) / kOfRow;
  int column = static_cast<int>(threadIdx.x % kWarp) % kOfRow * kVec;
};

// Every kBeside-th bit.
template <int kBeside>
constexpr unsigned every_bit() {
  unsigned bits = 0;
  for (int i = 0; i < kWarp; i += kBeside) bits |= 1U << i;
  return bits;
}

// A block per ray; its warps take every fourth sample, so that short rays occupy them all, and a warp skips samples
// without weight. Sample: its channels and 4 B read. Order of a channel's sum: warp by warp ascending samples, then
// warps.
template <int kBeside, int kVec, class Act>
__global__ void __launch_bounds__(kWarps* kWarp, kBlocks)
    forward_kernel(View<const std::int32_t> first, View<const float> weight, View<const Act> hidden, View<float> out) {
  using Row = Lanes<kBeside, kVec>;
  __shared__ Channels<kVec> of_warp[kWarps][Row::kOfRow];
  const std::int64_t ray = blockIdx.x;
  const std::int32_t begin = first(ray, 0), end = first(ray + 1, 0);
  const int lane = static_cast<int>(threadIdx.x % kWarp), warp = static_cast<int>(threadIdx.x / kWarp);
  const Row at;
  for (std::int32_t base = 0; base < out.cols; base += Row::kColumns) {
    const std::int32_t column = base + at.column;
    const bool has_column = column < out.cols;
    Channels<kVec> sum{};
    for (std::int32_t tile = begin; tile < end; tile += kWarp * kWarps) {
      const std::int32_t own = tile + lane * kWarps + warp;
      const float own_weight = own < end ? weight(own, 0) : 0.0F;
      const unsigned live = __ballot_sync(kFullMask, own_weight != 0);
      int rounds = 0;
      for (int part = 0; part < kBeside; ++part) rounds = max(rounds, __popc(live & every_bit<kBeside>() << part));
      unsigned mine = live & every_bit<kBeside>() << at.part;
      for (int done = 0; done < rounds; done += kInFlight) {
        Channels<kVec> row[kInFlight];
        float w[kInFlight];
#pragma unroll
        for (int i = 0; i < kInFlight; ++i) {
          // Without a sample left: a row that another part reads, with weight 0, so that no load waits for a branch.
          const int source = __ffs(static_cast<int>(mine == 0 ? live : mine)) - 1;
          const float weight_there = __shfl_sync(kFullMask, own_weight, source);
          w[i] = mine == 0 ? 0.0F : weight_there;
          row[i] = load<kVec>(hidden.row(tile + source * kWarps + warp) + (has_column ? column : 0));
          mine &= mine - 1;
        }
#pragma unroll
        for (int i = 0; i < kInFlight; ++i) {
          for (int v = 0; v < kVec; ++v) sum.v[v] += w[i] * row[i].v[v];
        }
      }
    }
    for (int offset = Row::kOfRow; offset < kWarp; offset *= 2) {
      for (int v = 0; v < kVec; ++v) sum.v[v] += __shfl_xor_sync(kFullMask, sum.v[v], offset);
    }
    __syncthreads();  // the columns before these may still be read
    if (at.part == 0) of_warp[warp][lane] = sum;
    __syncthreads();
    if (warp == 0 && at.part == 0 && has_column) {
      for (int v = 0; v < kVec; ++v) {
        sum.v[v] = (sum.v[v] + of_warp[1][lane].v[v]) + (of_warp[2][lane].v[v] + of_warp[3][lane].v[v]);
      }
      store<kVec>(out.row(ray) + column, sum);
    }
  }
}

// A warp takes kRowsAtOnce * kBeside consecutive samples of whatever rays. Sample: its channels and 8 B read, as many
// channels and 4 B written, each once; dL/d(out) of a ray stays in cache for its samples. Products of a lane's channels
// in float, sums over lanes in float64 in a fixed tree.
template <int kBeside, int kVec, class Act>
__global__ void __launch_bounds__(kBackWarps* kWarp, kBackBlocks)
    backward_kernel(Samples<float> samples, HiddenBackward<Act> call) {
  const View<const float> weight = call.weight, d_out = call.d_out;
  const View<const Act> hidden = call.hidden;
  const View<float> dots = call.dots;
  const View<Act> d_hidden = call.d_hidden;
  using Row = Lanes<kBeside, kVec>;
  const Row at;
  const std::int64_t warp = static_cast<std::int64_t>(blockIdx.x) * kBackWarps + threadIdx.x / kWarp;
  const std::int64_t first_row = warp * kRowsAtOnce<kVec> * kBeside + at.part;
  const std::int64_t rays = samples.first.rows - 1;
  const std::int64_t live_rows = samples.first(d_out.rows < rays ? d_out.rows : rays, 0);
  const std::int32_t cols = d_hidden.empty() ? hidden.cols : d_hidden.cols;
  const bool with_dots = !dots.empty(), reads_hidden = with_dots || call.relu_output;
  float w[kRowsAtOnce<kVec>];
  const float* grad[kRowsAtOnce<kVec>];
  double dot[kRowsAtOnce<kVec>] = {};
#pragma unroll
  for (int i = 0; i < kRowsAtOnce<kVec>; ++i) {
    const std::int64_t m = first_row + i * kBeside;
    w[i] = 0;
    grad[i] = nullptr;
    if (m >= live_rows) continue;
    w[i] = weight(m, 0);
    grad[i] = d_out.row(samples.ray_of_sample(m, 0));
  }
  for (std::int32_t base = 0; base < cols; base += Row::kColumns) {
    const std::int32_t column = base + at.column;
    if (column >= cols) continue;
    Channels<kVec> row[kRowsAtOnce<kVec>], slope[kRowsAtOnce<kVec>];
#pragma unroll
    for (int i = 0; i < kRowsAtOnce<kVec>; ++i) {
      row[i] = slope[i] = {};
      if (grad[i] == nullptr) continue;
      if (reads_hidden) row[i] = load<kVec>(hidden.row(first_row + i * kBeside) + column);
      slope[i] = load<kVec>(grad[i] + column);
    }
#pragma unroll
    for (int i = 0; i < kRowsAtOnce<kVec>; ++i) {
      const std::int64_t m = first_row + i * kBeside;
      float product = 0;
      for (int v = 0; v < kVec; ++v) product += slope[i].v[v] * row[i].v[v];
      dot[i] += static_cast<double>(product);
      for (int v = 0; v < kVec; ++v) {
        slope[i].v[v] = call.relu_output && !(row[i].v[v] > 0) ? 0.0F : slope[i].v[v] * w[i];
      }
      if (m >= d_hidden.rows) continue;
      Act* const to = call.blocked ? d_hidden.data + (m / 8 * (cols / 8) + column / 8) * 64 + m % 8 * 8 + column % 8
                                   : d_hidden.row(m) + column;
      store<kVec>(to, slope[i]);
    }
  }
  if (!with_dots) return;
#pragma unroll
  for (int i = 0; i < kRowsAtOnce<kVec>; ++i) {
    for (int offset = Row::kOfRow / 2; offset > 0; offset /= 2) dot[i] += __shfl_xor_sync(kFullMask, dot[i], offset);
    if (at.column == 0 && grad[i] != nullptr) dots(first_row + i * kBeside, 0) = static_cast<float>(dot[i]);
  }
}

// Whether rows of a view can be read so many channels at a time.
template <class T>
bool by(int channels, const View<T>& view) {
  return view.empty() ||
         (view.cols % channels == 0 && view.row_stride % channels == 0 &&
          reinterpret_cast<std::uintptr_t>(view.data) % (static_cast<unsigned>(channels) * sizeof(T)) == 0);
}
template <class... Views>
int channels_at_once(int most, const Views&... views) {
  for (int channels = most; channels > 1; channels /= 2) {
    if (channels != 2 && (by(channels, views) && ...)) return channels;
  }
  return 1;
}
// 16 bytes of the type that most of the bytes have.
template <class Act>
constexpr int kMostAtOnce = std::is_same_v<Act, float> ? 4 : 8;

// Calls f with the numbers that suit `cols` channels: rows beside each other, channels of a lane.
template <class F>
void for_width(std::int32_t cols, int channels, const F& f) {
  using std::integral_constant;
  const auto beside = [&](auto vec) {
    const int lanes = (cols + vec.value - 1) / vec.value;
    if (lanes <= 8) return f(integral_constant<int, 4>(), vec);
    if (lanes <= 16) return f(integral_constant<int, 2>(), vec);
    return f(integral_constant<int, 1>(), vec);
  };
  if (channels == 8) return beside(integral_constant<int, 8>());
  if (channels == 4) return beside(integral_constant<int, 4>());
  return f(integral_constant<int, 1>(), integral_constant<int, 1>());
}

}  // namespace

template <class Act>
void hidden_forward(const Samples<float>& samples, View<const float> weight, View<const Act> hidden, View<float> out) {
  for_width(out.cols, channels_at_once(kMostAtOnce<Act>, hidden, out), [&](auto beside, auto vec) {
    queue("compositing hidden channels", static_cast<unsigned>(out.rows), kWarps * kWarp,
          forward_kernel<beside.value, vec.value, Act>, samples.first, weight, hidden, out);
  });
}

template <class Act>
void hidden_backward(const Samples<float>& samples, const HiddenBackward<Act>& call) {
  const std::int64_t rows =
      std::max(call.d_hidden.empty() ? 0 : call.d_hidden.rows, call.dots.empty() ? 0 : call.hidden.rows);
  const std::int32_t cols = call.d_hidden.empty() ? call.hidden.cols : call.d_hidden.cols;
  const int channels = channels_at_once(kMostAtOnce<Act>, call.hidden, call.d_out, call.d_hidden);
  for_width(cols, channels, [&](auto beside, auto vec) {
    queue("gradient of hidden channels", blocks_of(rows, kBackWarps * kRowsAtOnce<vec.value> * beside.value),
          kBackWarps * kWarp, backward_kernel<beside.value, vec.value, Act>, samples, call);
  });
}

#define SEMFIELD_INSTANTIATE(Act)                                                                            \
  template void hidden_forward<Act>(const Samples<float>&, View<const float>, View<const Act>, View<float>); \
  template void hidden_backward<Act>(const Samples<float>&, const HiddenBackward<Act>&);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(__nv_bfloat16)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield::cuda
