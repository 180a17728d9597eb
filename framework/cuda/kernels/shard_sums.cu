// Gradients of shards added, element by element: 4 B an element of each array read, and 4 B written.
#include <algorithm>

#include "core/check.h"
#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/shard_sums.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;
constexpr int kBlocks = 8;  // a multiprocessor

// Plain arrays: members of std::array are functions of the host.
struct Carried {
  const float* of_level[kShardLevels];
  int count;
};
struct Tree {
  const float* node[kShards];
  int level[kShards];
};

__device__ float4 four_of(const float* from, std::int64_t i) { return reinterpret_cast<const float4*>(from)[i]; }
__device__ float4& four_in(float* to, std::int64_t i) { return reinterpret_cast<float4*>(to)[i]; }
__device__ float4 sum(const float4& a, const float4& b) { return {a.x + b.x, a.y + b.y, a.z + b.z, a.w + b.w}; }

// The subtree of kLevel that begins with shard `first`.
template <int kLevel>
__device__ float4 subtree(const Tree& tree, int first, std::int64_t i) {
  if constexpr (kLevel == 0) {
    return four_of(tree.node[first], i);
  } else {
    if (tree.level[first] == kLevel) return four_of(tree.node[first], i);
    return sum(subtree<kLevel - 1>(tree, first, i), subtree<kLevel - 1>(tree, first + (1 << (kLevel - 1)), i));
  }
}

__global__ void __launch_bounds__(kThreads)
    carry_kernel(float* gradients, std::int64_t fours, const __grid_constant__ Carried carried, float* to) {
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kThreads;
  for (std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x; i < fours; i += stride) {
    float4 total = four_of(gradients, i);
#pragma unroll
    for (int l = 0; l < kShardLevels; ++l) {
      if (l < carried.count) total = sum(four_of(carried.of_level[l], i), total);
    }
    if (to != gradients) four_in(gradients, i) = float4{0, 0, 0, 0};
    four_in(to, i) = total;
  }
}

__global__ void __launch_bounds__(kThreads)
    tree_kernel(const __grid_constant__ Tree tree, std::int64_t fours, float* gradients) {
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kThreads;
  for (std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x; i < fours; i += stride)
    four_in(gradients, i) = subtree<kShardLevels>(tree, 0, i);
}

unsigned blocks_for(std::int64_t fours) {
  return std::min(blocks_of(fours, kThreads), static_cast<unsigned>(kBlocks * multiprocessors()));
}

std::int64_t fours_of(std::span<float> gradients) {
  SEMFIELD_CHECK(gradients.size() % 4 == 0, "gradients of a store are padded");
  return static_cast<std::int64_t>(gradients.size() / 4);
}

}  // namespace

void carry_gradients(std::span<float> gradients, const CarriedSums& carried, float* to) {
  const std::int64_t fours = fours_of(gradients);
  if (fours == 0) return;
  Carried plain{};
  std::copy(carried.of_level.begin(), carried.of_level.end(), plain.of_level);
  plain.count = carried.count;
  carry_kernel<<<blocks_for(fours), kThreads, 0, launch().stream>>>(gradients.data(), fours, plain, to);
  check_launch("sum of a shard's gradients");
}

void add_tree(const TreeSums& tree, std::span<float> gradients) {
  const std::int64_t fours = fours_of(gradients);
  if (fours == 0) return;
  Tree plain{};
  std::copy(tree.node.begin(), tree.node.end(), plain.node);
  std::copy(tree.level.begin(), tree.level.end(), plain.level);
  tree_kernel<<<blocks_for(fours), kThreads, 0, launch().stream>>>(plain, fours, gradients.data());
  check_launch("sum of all shards' gradients");
}

}  // namespace semfield::cuda
