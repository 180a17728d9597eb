// Forward of the fused small network.
#include <algorithm>

#include "core/check.h"
#include "cuda/matmul.h"
#include "fields/tiny_mlp/tiny_mlp_fused.cuh"
#include "plugin/kernels.h"

namespace semfield::cuda::tiny {

namespace {

constexpr int kThreads = 128;
constexpr int kWarps = kThreads / kWarp;

struct Outputs : FieldOut<float> {
  View<__nv_bfloat16> shared;  ///< the hidden layer, in place of `feature`; whole groups of columns
};

/// Zeros in the outputs of a tile's rows from `begin` on.
__device__ void clear_rows(const Outputs& out, std::int64_t begin, std::int64_t end, int lane) {
  const auto clear = [&]<class T>(View<T> view) {
    if (view.empty()) return;
    for (std::int64_t i = begin * view.cols + lane; i < end * view.cols; i += kWarp)
      view(i / view.cols, static_cast<std::int32_t>(i % view.cols)) = T(0.0f);
  };
  clear(out.sigma);
  clear(out.rgb);
  clear(out.feature);
  clear(out.shared);
}

__device__ inline float sigmoid(float z) { return 1.0f / (1.0f + expf(-z)); }

/// A warp takes 16 rows at a time through all layers; the block keeps the weights in shared memory, and the next rows'
/// inputs are on their way meanwhile. A row moves 4 D + 4 (ray) bytes in and 4 + 12 + 4 F out, 2 F where the feature is
/// wanted in bf16 (D = 32, F = 64: 404 bytes, 276 with bf16), and takes 2 . 9,728 operations (with a direction, padding
/// included). Rows do not depend on each other.
template <int kPositionTiles, int kDirectionTiles>
__global__ void __launch_bounds__(kThreads, 3) forward_kernel(const FusedCall call, const Outputs out) {
  extern __shared__ __align__(16) unsigned char shared_memory[];
  auto& weights = *reinterpret_cast<Weights<kPositionTiles, kDirectionTiles>*>(shared_memory);
  weights.load(call.network);
  __syncthreads();
  const int lane_number = static_cast<int>(threadIdx.x) % kWarp;
  const Lane lane(lane_number);
  const std::int64_t all = call.in.position.rows, rows = live_count(call.live, all);
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kWarps * kTileRows;
  std::int64_t row0 =
      (static_cast<std::int64_t>(blockIdx.x) * kWarps + static_cast<int>(threadIdx.x) / kWarp) * kTileRows;
  Inputs<kPositionTiles, kDirectionTiles> inputs;
  inputs.load(call.in, lane, row0, rows, call.vector_position);
  for (; row0 < rows; row0 += stride) {
    Fragment x[kPositionTiles];
    inputs.pack_position(x);
    const auto current = inputs;
    inputs.load(call.in, lane, row0 + stride, rows, call.vector_position);

    Fragment h[4];
    Sums geometry[2];
    {
      Sums sums[8];
      weights.hidden_layer(lane, x, sums);
      if (!out.feature.empty() && call.hidden_feature)
        store_rows<4>(lane, sums, row0, rows, call.vector_feature, out.feature);
      pack_all(sums, h);
    }
    if (!out.shared.empty()) store_rows(lane, h, row0, rows, out.shared);
    weights.geometry_layer(lane, h, geometry);
#pragma unroll
    for (int half = 0; half < 2; ++half) {
      const std::int64_t row = row0 + lane.g + 8 * half;
      if (row >= rows) continue;
      if (lane.q == 0 && !out.sigma.empty()) out.sigma(row, 0) = geometry[0].value[2 * half];
      if (!out.feature.empty() && !call.hidden_feature) {
#pragma unroll
        for (int i = 0; i < 4; ++i) {
          const int feature = 4 * lane.q + i - 1;  // sigma is column 0
          if (feature >= 0 && feature < out.feature.cols)
            out.feature(row, feature) = geometry[i / 2].value[2 * half + i % 2];
        }
      }
    }

    if (!out.rgb.empty()) {
      Fragment c[4];
      {
        Fragment in[1 + kDirectionTiles];
        current.color_input(call.in, lane, call.vector_direction, geometry, in);
        Sums sums[8];
        weights.color_0_layer(lane, in, sums);
        pack_all(sums, c);
      }
      {
        Sums sums[8];
        weights.color_1_layer(lane, c, sums);
        pack_all(sums, c);
      }
      const Sums logit = weights.rgb_layer(lane, c);
#pragma unroll
      for (int half = 0; half < 2; ++half) {
        const std::int64_t row = row0 + lane.g + 8 * half;
        if (row >= rows || lane.q > 1) continue;
        out.rgb(row, 2 * lane.q) = sigmoid(logit.value[2 * half]);
        if (lane.q == 0) out.rgb(row, 1) = sigmoid(logit.value[2 * half + 1]);
      }
    }
    if (row0 + kTileRows > rows) clear_rows(out, rows, row0 + kTileRows < all ? row0 + kTileRows : all, lane_number);
  }
  for (; row0 < all; row0 += stride)
    clear_rows(out, row0, row0 + kTileRows < all ? row0 + kTileRows : all, lane_number);
}

}  // namespace

std::size_t shared_memory_limit() {
  int device = 0, bytes = 0;
  check(cudaGetDevice(&device), "asking for the device");
  check(cudaDeviceGetAttribute(&bytes, cudaDevAttrMaxSharedMemoryPerBlockOptin, device), "asking for shared memory");
  return static_cast<std::size_t>(bytes);
}

bool fused_applies(const TinyMlpShape& s) {
  static_assert(kTinyFusedWidth == kWidth && kTinyFusedPosition == 4 * kGroup && kTinyFusedDirection == kGroup);
  static_assert(kTinyFusedGeometry == kGroup - 1);
  return fused_takes(s) && shared_memory_limit() >= kMostSharedMemory;
}

bool shares_feature(const TinyMlpShape& s) { return s.feature == TinyFeature::hidden && s.hidden_width % kGroup == 0; }

FusedCall fused_call(const TinyMlpShape& s, const Tensors<float>& t, const FieldIn<float>& in) {
  FusedCall call;
  call.network = network_of<const float>(
      s, [&](int index) -> View<const float> { return t.value[static_cast<std::size_t>(index)]; });
  call.in = in;
  call.hidden_feature = s.feature == TinyFeature::hidden;
  call.live = launch().live_rows;
  call.vector_position = allows_vectors(in.position);
  call.vector_direction = allows_vectors(in.direction);
  return call;
}

unsigned resident_blocks(const void* kernel, int threads, std::size_t bytes) {
  check(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, static_cast<int>(bytes)),
        "small network: shared memory");
  int each = 0;
  check(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&each, kernel, threads, bytes), "small network: occupancy");
  return static_cast<unsigned>(std::max(each, 1) * multiprocessors());
}

void fused_forward(const TinyMlpShape& s, const Tensors<float>& t, const FieldIn<float>& in,
                   const FieldOut<float>& wanted) {
  if (in.position.rows == 0) return;
  FusedCall call = fused_call(s, t, in);
  Outputs out{wanted, as_bf16(wanted.fused.feature)};
  call.vector_feature = allows_vectors(out.feature);
  with_tiles(s, [&]<int kPositionTiles, int kDirectionTiles>() {
    const auto kernel = forward_kernel<kPositionTiles, kDirectionTiles>;
    constexpr std::size_t kBytes = sizeof(Weights<kPositionTiles, kDirectionTiles>);
    const unsigned blocks = std::min(resident_blocks(reinterpret_cast<const void*>(kernel), kThreads, kBytes),
                                     blocks_of(in.position.rows, kWarps * kTileRows));
    kernel<<<blocks, kThreads, kBytes, launch().stream>>>(call, out);
    check_launch("small network: fused forward");
  });
}

}  // namespace semfield::cuda::tiny

// The fused CUDA kernels of the small network, as the field finds them: of the whole network in its usual widths, and
// of one that is asked for its hidden feature alone.

namespace semfield::cuda {

namespace {

bool serve(const TinyMlpShape& s) { return tiny::fused_applies(s) || tiny::feature_applies(s); }

void forward(const TinyMlpShape& s, const StepContext&, const Tensors<float>& t, const FieldIn<float>& in,
             const FieldOut<float>& out, Saved saved) {
  if (tiny::fused_applies(s)) return tiny::fused_forward(s, t, in, out);
  tiny::feature_forward(s, t, in.position, out.feature, saved);
}

void backward(const TinyMlpShape& s, const StepContext& ctx, const Tensors<float>& t, const FieldIn<float>& in,
              const FieldOut<float>& out, const FieldGrad<float>& grad, Saved saved, View<float> d_position) {
  if (tiny::fused_applies(s)) return tiny::fused_backward(s, *ctx.workspace, t, in, out.rgb, grad, d_position);
  tiny::feature_backward(s, *ctx.workspace, t, grad.feature, saved, d_position);
}

std::size_t saved_bytes(const TinyMlpShape& s, std::int64_t samples) {
  return tiny::fused_applies(s) ? 0 : tiny::feature_saved_bytes(s, samples);
}

FeatureForm feature_form(const TinyMlpShape& s, std::int32_t) {
  return tiny::fused_applies(s) && tiny::shares_feature(s) ? FeatureForm::rounded : FeatureForm::full;
}

constexpr TinyMlpFused<float> kFused{serve, forward, backward, saved_bytes, feature_form};

}  // namespace

void tiny_mlp_cuda_kernels(KernelTables& tables) {
  tables.add(Device::cuda, "field 'tiny_mlp'", &kFused, Precision::bf16);
}

}  // namespace semfield::cuda
