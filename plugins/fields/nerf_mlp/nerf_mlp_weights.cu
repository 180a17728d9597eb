#include "core/error.h"
#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/layers.h"
#include "fields/nerf_mlp/nerf_mlp_weights.cuh"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;
constexpr int kMostMatrices = 2 * (kMaxDepth + 3);

struct Rounding {
  const float* from = nullptr;
  __nv_bfloat16* to = nullptr;
  std::int32_t rows = 0, cols = 0, stride = 0;
  std::int32_t padded_rows = 0, padded_cols = 0;
};
struct Roundings {
  Rounding all[kMostMatrices];
};

// blockIdx.y: matrix; the blocks of a row share its numbers, one per thread. 6 bytes per number.
__global__ void round_kernel(Roundings roundings) {
  const Rounding& r = roundings.all[blockIdx.y];
  const std::int32_t size = r.padded_rows * r.padded_cols;
  for (std::int32_t i = static_cast<std::int32_t>(blockIdx.x * blockDim.x + threadIdx.x); i < size;
       i += static_cast<std::int32_t>(gridDim.x * blockDim.x)) {
    const std::int32_t row = i / r.padded_cols, col = i % r.padded_cols;
    const bool inside = row < r.rows && col < r.cols;
    r.to[i] = __float2bfloat16_rn(inside ? r.from[static_cast<std::int64_t>(row) * r.stride + col] : 0.0F);
  }
}

// Gives matrices in the type of the products: themselves, or copies that finish() makes.
template <class Act>
class Source;
template <>
class Source<float> {
 public:
  explicit Source(Workspace&) {}
  View<const float> matrix(View<const float> m) { return m; }
  View<const float> vector(View<const float> m) { return m; }
  void finish() {}
};
template <>
class Source<__nv_bfloat16> {
 public:
  explicit Source(Workspace& arena) : arena_(arena) {}
  View<const __nv_bfloat16> matrix(View<const float> m) {
    return add(m, padded_cols<__nv_bfloat16>(static_cast<std::int32_t>(m.rows)));
  }
  View<const __nv_bfloat16> vector(View<const float> m) { return add(m, 1); }
  void finish() {
    if (count_ == 0) return;
    constexpr unsigned kBlocksEach = 32;
    round_kernel<<<dim3(kBlocksEach, static_cast<unsigned>(count_)), kThreads, 0, launch().stream>>>(roundings_);
    check_launch("weights to bf16");
  }

 private:
  View<const __nv_bfloat16> add(View<const float> m, std::int32_t padded_rows) {
    const std::int32_t cols = padded_cols<__nv_bfloat16>(m.cols);
    const View<__nv_bfloat16> copy = arena_.take<__nv_bfloat16>(padded_rows, cols);
    roundings_.all[count_++] = {
        m.data,      copy.data, static_cast<std::int32_t>(m.rows), m.cols, static_cast<std::int32_t>(m.row_stride),
        padded_rows, cols};
    return copy;
  }
  Workspace& arena_;
  Roundings roundings_{};
  int count_ = 0;
};

// One thread per number.
template <class Act>
__global__ void gather_kernel(View<const float> direction, View<const std::int32_t> ray_of_sample, View<Act> gathered) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= gathered.size()) return;
  const std::int64_t row = i / gathered.cols;
  const auto col = static_cast<std::int32_t>(i % gathered.cols);
  gathered(row, col) = Act(col < direction.cols ? direction(ray_of_sample(row, 0), col) : 0.0F);
}

}  // namespace

template <class Act>
NerfMlpWeights<Act> nerf_mlp_weights(const NerfMlpShape& s, const Tensors<float>& tensors, Workspace& arena) {
  if (s.depth > kMaxDepth)
    throw Error(ErrorKind::config, "config.value.range", "field 'nerf_mlp': at most 32 trunk layers on the device");
  const auto value = [&](int index) -> View<const float> { return tensors.value[static_cast<std::size_t>(index)]; };
  Source<Act> source(arena);
  NerfMlpWeights<Act> w;
  for (int i = 0; i < s.depth; ++i) {
    const auto n = static_cast<std::size_t>(i);
    View<const float> weight = value(s.trunk[n].weight);
    if (i > 0 && i == s.skip_at) {
      w.skip = source.matrix(weight.row_range(0, s.position_dims));
      weight = weight.row_range(s.position_dims, s.width);
    }
    w.trunk[n] = source.matrix(weight);
    w.bias[n] = source.vector(value(s.trunk[n].bias));
  }
  if (s.has_feature_activation()) {
    w.feature = source.matrix(value(s.feature.weight));
    w.feature_bias = source.vector(value(s.feature.bias));
  }
  w.view = source.matrix(s.folds() ? value(s.folded.weight) : value(s.view.weight).row_range(0, s.width));
  w.view_bias = source.vector(value(s.folds() ? s.folded.bias : s.view.bias));
  if (s.has_direction() && !s.direction_once) {
    w.direction = source.matrix(value(s.view.weight).row_range(s.width, s.direction_dims));
  }
  source.finish();
  return w;
}

template <class Act>
void gather_directions(View<const float> direction, View<const std::int32_t> ray_of_sample, View<Act> gathered) {
  if (gathered.size() == 0) return;
  gather_kernel<Act>
      <<<blocks_of(gathered.size(), kThreads), kThreads, 0, launch().stream>>>(direction, ray_of_sample, gathered);
  check_launch("directions of samples");
}

#define SEMFIELD_INSTANTIATE(Act)                                                                             \
  template NerfMlpWeights<Act> nerf_mlp_weights<Act>(const NerfMlpShape&, const Tensors<float>&, Workspace&); \
  template void gather_directions<Act>(View<const float>, View<const std::int32_t>, View<Act>);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(__nv_bfloat16)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield::cuda
