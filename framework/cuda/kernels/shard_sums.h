// Gradients of shards added on the device, in the order of the tree of cuda/ranks/shards.h.
#pragma once

#include <array>
#include <cstdint>
#include <span>

#include "cuda/ranks/shards.h"

namespace semfield::cuda {

/// What waits below a shard whose sums are complete: of each level, lowest first.
struct CarriedSums {
  std::array<const float*, kShardLevels> of_level{};
  int count = 0;
};

/// to = carried[count - 1] + (... + (carried[0] + gradients)), and gradients = 0 unless they are `to` itself. Arrays of
/// `gradients.size()` numbers, a multiple of 4, that start on 16 bytes.
void carry_gradients(std::span<float> gradients, const CarriedSums& carried, float* to);

/// Sums of subtrees by their first shard; null: none begins there.
struct TreeSums {
  std::array<const float*, kShards> node{};
  std::array<int, kShards> level{};
};

/// gradients = the sum of the whole tree, whose shards the nodes make up. Arrays as above.
void add_tree(const TreeSums& tree, std::span<float> gradients);

}  // namespace semfield::cuda
