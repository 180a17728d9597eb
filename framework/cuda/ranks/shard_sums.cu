// What shards of a step leave: gradients added element by element, rows copied behind each other.
#include <algorithm>

#include "core/check.h"
#include "cuda/kernels/device_code.cuh"
#include "cuda/ranks/shard_sums.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;
constexpr int kBlocks = 4;  // a multiprocessor

// Plain arrays: members of std::array are functions of the host.
struct Blocks {
  const float* of_shard[kShards];
};
struct Parts {
  EncoderRows part[kShards];
};

__device__ float4 sum(const float4& a, const float4& b) { return {a.x + b.x, a.y + b.y, a.z + b.z, a.w + b.w}; }

// Shards [first, first + 2^kLevel) as a tree.
template <int kLevel>
__device__ float4 subtree(const Blocks& blocks, int first, std::int64_t i) {
  if constexpr (kLevel == 0) {
    return reinterpret_cast<const float4*>(blocks.of_shard[first])[i];
  } else {
    return sum(subtree<kLevel - 1>(blocks, first, i), subtree<kLevel - 1>(blocks, first + (1 << (kLevel - 1)), i));
  }
}
static_assert(kShards == 1 << 3);

// blockIdx.y: tensor; 4 B per number of each shard read, 4 B of the sum read and written.
__global__ void __launch_bounds__(kThreads)
    add_kernel(const ShardTensor* tensors, const __grid_constant__ Blocks blocks) {
  const ShardTensor tensor = tensors[blockIdx.y];
  auto* const to = reinterpret_cast<float4*>(tensor.to);
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kThreads;
  for (std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x; i < tensor.count / 4;
       i += stride)
    to[i] = sum(to[i], subtree<3>(blocks, 0, tensor.at / 4 + i));
}

// blockIdx.y: part. A row in use: 24 + 4 D B read and written.
__global__ void __launch_bounds__(kThreads)
    join_kernel(const __grid_constant__ Parts parts, int count, bool by_fours, EncoderRows to) {
  std::int64_t begin = 0, rows = 0;
  for (int p = 0; p <= static_cast<int>(blockIdx.y); ++p) {
    begin += rows;
    rows = parts.part[p].count == nullptr ? parts.part[p].x.rows : *parts.part[p].count;
  }
  const EncoderRows& from = parts.part[blockIdx.y];
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kThreads;
  const std::int64_t thread = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  for (std::int64_t i = thread; i < 3 * rows; i += stride) to.x.data[3 * begin + i] = from.x.data[i];
  const std::int64_t numbers = rows * to.dy.cols, first = begin * to.dy.cols;
  if (by_fours) {
    const auto* const four = reinterpret_cast<const float4*>(from.dy.data);
    auto* const put = reinterpret_cast<float4*>(to.dy.data + first);
    for (std::int64_t i = thread; i < numbers / 4; i += stride) put[i] = four[i];
  } else {
    for (std::int64_t i = thread; i < numbers; i += stride) to.dy.data[first + i] = from.dy.data[i];
  }
  if (thread != 0 || static_cast<int>(blockIdx.y) != count - 1) return;
  *to.count = static_cast<std::int32_t>(begin + rows);
  for (int p = 0; p < count; ++p) {
    if (parts.part[p].largest != nullptr) *to.largest = max(*to.largest, *parts.part[p].largest);
  }
}

unsigned blocks_for(std::int64_t accesses) {
  return std::max(1U, std::min(blocks_of(accesses, kThreads), static_cast<unsigned>(kBlocks * multiprocessors())));
}

}  // namespace

void add_shards(const ShardTensors& tensors, const std::array<const float*, kShards>& block) {
  if (tensors.count == 0) return;
  Blocks plain{};
  std::copy(block.begin(), block.end(), plain.of_shard);
  const dim3 grid(blocks_for(tensors.longest / 4), static_cast<unsigned>(tensors.count));
  add_kernel<<<grid, kThreads, 0, launch().stream>>>(tensors.all, plain);
  check_launch("sum of the shards' gradients");
}

void join_rows(std::span<const EncoderRows> parts, const EncoderRows& to) {
  SEMFIELD_CHECK(parts.size() <= kShards, "a part of each shard");
  if (parts.empty()) {
    check(cudaMemsetAsync(to.count, 0, sizeof *to.count, launch().stream), "counting rows");
    return;
  }
  Parts plain{};
  std::int64_t most = 1;
  bool by_fours = to.dy.cols % 4 == 0;
  for (std::size_t p = 0; p < parts.size(); ++p) {
    SEMFIELD_CHECK(parts[p].x.contiguous() && parts[p].dy.contiguous(), "rows of an encoder lie behind each other");
    plain.part[p] = parts[p];
    most = std::max(most, parts[p].x.rows);
    by_fours = by_fours && reinterpret_cast<std::uintptr_t>(parts[p].dy.data) % sizeof(float4) == 0;
  }
  const dim3 grid(blocks_for(most * to.dy.cols / 4), static_cast<unsigned>(parts.size()));
  join_kernel<<<grid, kThreads, 0, launch().stream>>>(plain, static_cast<int>(parts.size()), by_fours, to);
  check_launch("joining rows of shards");
}

}  // namespace semfield::cuda
