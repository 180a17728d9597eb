#include "cuda/ranks/shards.h"

#include <algorithm>

namespace semfield::cuda {

RayRange shard_of(std::int64_t rays, int number, int shards) {
  const std::int64_t each = (rays + shards - 1) / shards;
  const std::int64_t begin = std::min(rays, number * each), end = std::min(rays, begin + each);
  return {begin, end - begin};
}

}  // namespace semfield::cuda
