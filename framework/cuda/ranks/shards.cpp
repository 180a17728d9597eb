#include "cuda/ranks/shards.h"

#include <algorithm>
#include <bit>

namespace semfield::cuda {

RayRange shard_of(std::int64_t rays, int number, int shards) {
  const std::int64_t each = (rays + shards - 1) / shards;
  const std::int64_t begin = std::min(rays, number * each), end = std::min(rays, begin + each);
  return {begin, end - begin};
}

std::vector<ShardNode> nodes_of(int begin, int end) {
  std::vector<ShardNode> nodes;
  while (begin < end) {
    int level = 0;
    while (level < kShardLevels && begin % (2 << level) == 0 && begin + (2 << level) <= end) ++level;
    nodes.push_back({begin, level});
    begin += 1 << level;
  }
  return nodes;
}

int level_completed_by(int number) { return std::countr_one(static_cast<unsigned>(number)); }

}  // namespace semfield::cuda
