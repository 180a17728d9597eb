// Several tensors cut into ranges that are the units of one parallel loop: a loop for each tensor would end with a
// wait.
#pragma once

#include <algorithm>
#include <cstdint>

#include "compute/parallel.h"

namespace semfield {

/// Of value, gradient and moments together 256 KB in float, some ten microseconds of work.
inline constexpr std::int64_t kRangeElements = std::int64_t{1} << 14;

/// Rows of a range; from the shape alone.
inline std::int64_t rows_per_range(std::int32_t cols) {
  return std::max<std::int64_t>(1, kRangeElements / std::max<std::int32_t>(1, cols));
}

/// body(i, first row, rows) for the ranges of tensors 0 to tensors - 1, of which tensor i has rows(i) rows (0: none of
/// it) of cols(i) numbers.
template <class Rows, class Cols, class Body>
void for_ranges(int tensors, const Rows& rows, const Cols& cols, const Body& body) {
  const auto ranges = [&](int i) { return (rows(i) + rows_per_range(cols(i)) - 1) / rows_per_range(cols(i)); };
  std::int64_t units = 0;
  for (int i = 0; i < tensors; ++i) units += ranges(i);
  parallel_for(units, [&](std::int64_t unit) {
    int i = 0;
    for (; unit >= ranges(i); ++i) unit -= ranges(i);
    const std::int64_t range = rows_per_range(cols(i)), begin = unit * range;
    body(i, begin, std::min(range, rows(i) - begin));
  });
}

}  // namespace semfield
