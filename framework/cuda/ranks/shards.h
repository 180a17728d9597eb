// How the rays of a step are cut into shards, and which rank walks which.
#pragma once

#include <cstdint>

namespace semfield::cuda {

/// Shards of a step whose bits depend on its batch alone, however many ranks make it. Their gradients are added as a
/// tree: ((0 + 1) + (2 + 3)) + ((4 + 5) + (6 + 7)).
inline constexpr int kShards = 8;

struct RayRange {
  std::int64_t begin = 0, count = 0;
};
/// Shard `number` of `shards`: ceil(rays / shards) rays; the last ones get fewer, or none.
RayRange shard_of(std::int64_t rays, int number, int shards);

/// Most of kShards that a rank of `ranks` walks.
constexpr int most_shards_of(int ranks) { return (kShards + ranks - 1) / ranks; }

}  // namespace semfield::cuda
