// How the rays of a step are cut into shards, and in which order the gradients of shards are added.
#pragma once

#include <cstdint>
#include <vector>

namespace semfield::cuda {

/// Shards of a step whose bits depend on its batch alone, however many ranks make it. Their gradients are added as a
/// tree: ((0 + 1) + (2 + 3)) + ((4 + 5) + (6 + 7)).
inline constexpr int kShards = 8;
inline constexpr int kShardLevels = 3;
static_assert(1 << kShardLevels == kShards);

struct RayRange {
  std::int64_t begin = 0, count = 0;
};
/// Shard `number` of `shards`: ceil(rays / shards) rays; the last ones get fewer, or none.
RayRange shard_of(std::int64_t rays, int number, int shards);

/// A subtree of 2^level shards, the first of which is a multiple of their number.
struct ShardNode {
  int first = 0, level = 0;
  bool operator==(const ShardNode&) const = default;
};
/// The fewest that make up shards [begin, end) of kShards, in order.
std::vector<ShardNode> nodes_of(int begin, int end);

/// Of the shards of a node, in order: the sums that shard `number`, counted within the node, completes. They are those
/// of the levels below the returned one, lowest first.
int level_completed_by(int number);

}  // namespace semfield::cuda
