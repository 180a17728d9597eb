// Layouts and machinery that the fused kernels of the NeRF network share.
//
// A warpgroup takes 64 rows through all layers; two of them make a block, two blocks a cluster, and the cluster's
// blocks share every slab of weights that comes from memory. Activations of the running layer stay in shared memory; a
// copy goes to memory for backward.
//
// "Blocked" matrices [rows, cols] of bf16 consist of 8 x 8 blocks of 128 contiguous bytes, blocks of 8 rows one behind
// the other: what a matrix product of Hopper reads from shared memory, so that tiles move by bulk copies as they are.
#pragma once

#include <cuda_bf16.h>

#include <algorithm>
#include <cstdint>

#include "cuda/kernels/hopper.cuh"
#include "cuda/launch.h"

namespace semfield::cuda::fused {

inline constexpr int kWidth = 256;    ///< of the trunk
inline constexpr int kView = 128;     ///< of the view layer
inline constexpr int kPosition = 64;  ///< encoded position, padded
inline constexpr int kMaxDepth = 15;  ///< biases of all layers fit into shared memory
inline constexpr int kChannels = 3;
inline constexpr int kRows = 64;    ///< of a warpgroup
inline constexpr int kGroups = 2;   ///< warpgroups of a block that compute; one more feeds them
inline constexpr int kCluster = 2;  ///< blocks that share slabs of weights; 1: none
inline constexpr int kTileRows = kRows * kGroups * kCluster;
inline constexpr int kThreads = hopper::kWarpgroup * (kGroups + 1);
inline constexpr int kTerms = 64;                  ///< of a slab: rows of a weight matrix
inline constexpr std::uint32_t kBlockBytes = 128;  ///< of an 8 x 8 block
inline constexpr std::uint32_t kSlabBytes = kTerms * kWidth * 2;
inline constexpr std::uint32_t kViewSlabBytes = kTerms * kView * 2;
inline constexpr std::uint32_t kTileBytes = kRows * kWidth * 2;
inline constexpr std::uint32_t kPositionBytes = kRows * kPosition * 2;

/// Bytes from a block of 8 rows of a blocked matrix to the next.
__host__ __device__ constexpr std::uint32_t row_step(int cols) { return static_cast<std::uint32_t>(cols) * 16; }

/// Place of a thread in its warpgroup's product: it holds rows `row` and `row` + 8, columns 8 j + 2 quad and the next;
/// accumulators 4 j to 4 j + 3 are (row, col), (row, col + 1), (row + 8, col), (row + 8, col + 1).
struct Lane {
  int thread, warp, lane, quad, row;
  __device__ Lane() {
    thread = static_cast<int>(threadIdx.x) % hopper::kWarpgroup;
    warp = thread / 32;
    lane = thread % 32;
    quad = lane % 4;
    row = warp * 16 + lane / 4;
  }
};

/// Slabs of weights on their way through shared memory, in the same order on both sides.
template <int kStages>
class Ring {
 public:
  __device__ Ring(std::uint32_t slabs, std::uint32_t barriers)
      : slabs_(slabs), full_(barriers), empty_(barriers + 8 * kStages) {}
  static constexpr std::uint32_t kBarrierBytes = 16 * kStages;
  /// One thread of the block, before a cluster barrier.
  __device__ void init() const {
    for (std::uint32_t s = 0; s < kStages; ++s) {
      hopper::barrier_init(full_ + 8 * s, 1);
      hopper::barrier_init(empty_ + 8 * s, kCluster * kGroups * 4);
    }
  }
  /// The feeding thread: waits for room and orders the next slab; each block of the cluster fetches its share for all.
  __device__ void feed(const std::byte* from, std::uint32_t bytes, std::uint32_t rank) {
    const std::uint32_t stage = count_ % kStages, parity = count_ / kStages % 2;
    hopper::barrier_wait(empty_ + 8 * stage, parity ^ 1);
    hopper::barrier_expect(full_ + 8 * stage, bytes);
    const std::uint32_t share = bytes / kCluster, to = slabs_ + stage * kSlabBytes + rank * share;
    if constexpr (kCluster > 1) {
      hopper::bulk_load_to_all(to, from + rank * share, share, full_ + 8 * stage, (1 << kCluster) - 1);
    } else {
      hopper::bulk_load(to, from, bytes, full_ + 8 * stage);
    }
    ++count_;
  }
  /// All threads of a computing warpgroup: waits for the next slab and gives its address.
  __device__ std::uint32_t next() {
    const std::uint32_t stage = count_ % kStages, parity = count_ / kStages % 2;
    hopper::barrier_wait(full_ + 8 * stage, parity);
    ++count_;
    return slabs_ + stage * kSlabBytes;
  }
  /// The same: this warp will not read the slab any more that was given `ago` calls before the last one.
  __device__ void release(std::uint32_t ago) const {
    if (threadIdx.x % 32 != 0) return;
    const std::uint32_t barrier = empty_ + 8 * ((count_ - 1 - ago) % kStages);
    if constexpr (kCluster > 1) {
#pragma unroll
      for (std::uint32_t rank = 0; rank < kCluster; ++rank) hopper::barrier_arrive_at(barrier, rank);
    } else {
      hopper::barrier_arrive(barrier);
    }
  }

 private:
  std::uint32_t slabs_, full_, empty_, count_ = 0;
};

/// A warpgroup's blocked operand of 64 rows in shared memory: where it starts, bytes from a block of 8 rows to the
/// next, and columns.
struct Rows {
  std::uint32_t address = 0, step = 0;
  int cols = 0;
};

/// acc = (or +=, unless `start`) A B over as many slabs of the ring as A has columns. Ends with everything computed and
/// released.
template <int kColumns, int kStages>
__device__ inline void multiply(float (&acc)[kColumns / 2], const Rows& a, bool start, Ring<kStages>& ring) {
  constexpr std::uint32_t kTermStep = kColumns * 16;  // of a slab: from 8 terms to the next 8
  const int slabs = a.cols / kTerms;
  for (int s = 0; s < slabs; ++s) {
    const std::uint32_t slab = ring.next();
    const std::uint32_t terms = a.address + static_cast<std::uint32_t>(s) * (kTerms / 8) * kBlockBytes;
    hopper::wgmma_fence();
#pragma unroll
    for (int k = 0; k < kTerms / 16; ++k) {
      hopper::wgmma(acc, hopper::operand(terms + 2 * k * kBlockBytes, kBlockBytes, a.step),
                    hopper::operand(slab + 2 * k * kTermStep, kTermStep, kBlockBytes), !(start && s == 0 && k == 0));
    }
    hopper::wgmma_commit();
    if (s > 0) {
      hopper::wgmma_wait<1>();
      ring.release(1);
    }
  }
  hopper::wgmma_wait<0>();
  ring.release(0);
}

/// For every number whether it is above 0: bit 15 - i % 16 (the first number of pair i) and 31 - i % 16 (the second) of
/// word i / 16. Pair 2 j: accumulators 4 j and 4 j + 1; pair 2 j + 1: the next two.
template <int kColumns>
struct MaskBits {
  std::uint32_t word[kColumns / 64];
  /// A pair that is 0 or above, packed.
  __device__ void add(int pair, std::uint32_t packed) {
    word[pair / 16] |= ((packed + 0x7FFF7FFFu) & 0x80008000u) >> (pair % 16);
  }
  /// The packed pair where its bits are set, else 0.
  __device__ std::uint32_t apply(int pair, std::uint32_t packed) const {
    return packed & hopper::spread_signs(word[pair / 16] << (pair % 16));
  }
};

/// The warpgroup's numbers as bf16 to its blocked tile in shared memory; packed(i) gives pair i as MaskBits counts
/// them.
template <int kColumns, class Packed>
__device__ inline void store_tile(std::uint32_t tile, const Lane& at, Packed&& packed) {
  const std::uint32_t address =
      tile +
      (2 * static_cast<std::uint32_t>(at.warp) + static_cast<std::uint32_t>(at.lane / 8 % 2)) * row_step(kColumns) +
      static_cast<std::uint32_t>(at.lane / 16) * kBlockBytes + static_cast<std::uint32_t>(at.lane % 8) * 16;
#pragma unroll
  for (int j = 0; j < kColumns / 8; j += 2) {
    const std::uint32_t m0 = packed(2 * j), m1 = packed(2 * j + 1), m2 = packed(2 * j + 2), m3 = packed(2 * j + 3);
    hopper::store_matrices(address + static_cast<std::uint32_t>(j) * kBlockBytes, m0, m1, m2, m3);
  }
}

/// Before a warpgroup writes its tile: all its products have read it, and so has the bulk store of what it held.
__device__ inline void tile_is_free(const Lane& at, int group) {
  if (at.thread == 0) hopper::bulk_stores_have_read();
  hopper::named_barrier(1 + group, hopper::kWarpgroup);
}
/// After it wrote: the next products may read the tile, and with `to` a copy goes to memory.
__device__ inline void tile_is_written(const Lane& at, int group, std::uint32_t tile, void* to, std::uint32_t bytes) {
  hopper::fence_shared_writes();
  hopper::named_barrier(1 + group, hopper::kWarpgroup);
  if (to != nullptr && at.thread == 0) hopper::bulk_store(to, tile, bytes);
}

/// Tiles of a block: of every cluster's tile, the block takes the rank-th piece of kGroups warpgroups.
struct Tiles {
  std::int64_t count, step, first;
  std::uint32_t rank;
  __device__ explicit Tiles(std::int64_t blocks) {
    rank = kCluster > 1 ? hopper::cluster_rank() : 0;
    count = blocks / (kGroups * kCluster);
    step = gridDim.x / kCluster;
    first = blockIdx.x / kCluster;
  }
  /// Piece of 64 rows of a warpgroup.
  __device__ std::int64_t block(std::int64_t tile, int group) const {
    return (tile * kCluster + rank) * kGroups + group;
  }
};

/// to[k] = from(k) for k < count, by the whole block.
template <class From>
__device__ inline void fill_shared(float* to, int count, const From& from) {
  for (int k = static_cast<int>(threadIdx.x); k < count; k += kThreads) to[k] = from(k);
}

/// The rest of a block's life once its memory is filled: init() by one thread, then one thread feeds the ring and
/// kGroups warpgroups compute, each with the block's tiles of `blocks`.
template <class Init, class Feed, class Compute>
__device__ inline void run_warpgroups(std::int64_t blocks, const Init& init, const Feed& feed, const Compute& compute) {
  if (threadIdx.x == 0) {
    init();
    hopper::fence_barrier_init();
  }
  __syncthreads();
  if constexpr (kCluster > 1) hopper::cluster_barrier();
  const Tiles tiles(blocks);
  const int group = static_cast<int>(threadIdx.x) / hopper::kWarpgroup;
  if (group == kGroups) {
    hopper::fewer_registers<24>();
    if (threadIdx.x % hopper::kWarpgroup == 0) feed(tiles);
  } else {
    hopper::more_registers<240>();
    compute(tiles, group);
  }
  if constexpr (kCluster > 1) hopper::cluster_barrier();  // a block's memory must last while others copy into it
}

/// Sum over the four lanes that hold a row.
__device__ inline float row_sum(float value) {
  value += __shfl_xor_sync(0xFFFFFFFFu, value, 1);
  return value + __shfl_xor_sync(0xFFFFFFFFu, value, 2);
}

/// A persistent launch of a kernel over tiles: as many clusters as run at once.
template <class Call>
void launch_in_clusters(void (*kernel)(Call), const Call& call, std::uint32_t shared, std::int64_t blocks,
                        const char* what) {
  check(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, static_cast<int>(shared)), what);
  const std::int64_t tiles = blocks / (kGroups * kCluster);
  cudaLaunchAttribute cluster;
  cluster.id = cudaLaunchAttributeClusterDimension;
  cluster.val.clusterDim.x = kCluster;
  cluster.val.clusterDim.y = 1;
  cluster.val.clusterDim.z = 1;
  cudaLaunchConfig_t config{};
  const int clusters = std::max(1, multiprocessors() / kCluster);
  config.gridDim = dim3(static_cast<unsigned>(std::min<std::int64_t>(tiles, clusters)) * kCluster);
  config.blockDim = dim3(kThreads);
  config.dynamicSmemBytes = shared;
  config.stream = launch().stream;
  config.attrs = &cluster;
  config.numAttrs = 1;
  check(cudaLaunchKernelEx(&config, kernel, call), what);
}

}  // namespace semfield::cuda::fused
