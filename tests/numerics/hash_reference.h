// One level of the hash grid by other means: addresses in 128-bit integers, interpolation in long double.
#pragma once

#include <algorithm>

#include "core/view.h"
#include "encoder_box.h"

namespace semfield::numerics {

__extension__ using Wide128 = unsigned __int128;

inline Wide128 vertices_of(std::uint64_t resolution) {
  const Wide128 n = static_cast<Wide128>(resolution) + 1;
  return n * n * n;
}

/// Row of the level's table that holds vertex (x, y, z) of N cells per axis [Mueller22 Eq. 4].
inline std::int64_t reference_entry(std::uint64_t resolution, std::int64_t entries, const std::uint64_t* v) {
  if (vertices_of(resolution) <= static_cast<Wide128>(entries)) {
    const Wide128 n = static_cast<Wide128>(resolution) + 1;
    return static_cast<std::int64_t>(v[0] + n * (v[1] + n * v[2]));
  }
  const Wide128 low = (Wide128{1} << 32) - 1;
  const Wide128 mixed = v[0] ^ (Wide128{v[1]} * 2654435761u & low) ^ (Wide128{v[2]} * 805459861u & low);
  return static_cast<std::int64_t>(mixed % static_cast<Wide128>(entries));
}

/// Feature f at x, clamped to the cube: three nested linear interpolations.
template <class Real>
long double reference_feature(std::uint64_t resolution, View<const Real> table, std::int32_t f, const double* x) {
  std::uint64_t cell[3];
  long double w[3];
  for (int d = 0; d < 3; ++d) {
    const long double p = std::clamp(static_cast<long double>(x[d]), 0.0L, 1.0L) * static_cast<long double>(resolution);
    cell[d] = std::min(static_cast<std::uint64_t>(p), resolution - 1);
    w[d] = p - static_cast<long double>(cell[d]);
  }
  long double sum = 0;
  for (unsigned c = 0; c < 8; ++c) {
    std::uint64_t v[3];
    long double weight = 1;
    for (unsigned d = 0; d < 3; ++d) {
      const unsigned far = c >> d & 1;
      v[d] = cell[d] + far;
      weight *= far != 0 ? w[d] : 1 - w[d];
    }
    sum += weight * static_cast<long double>(table(reference_entry(resolution, table.rows, v), f));
  }
  return sum;
}

/// Settings of a grid with one level of N cells per axis.
inline testkit::Settings one_level(std::int64_t resolution, int log2_entries, int features = 2,
                                   const std::string& interpolation = "linear") {
  return {{"levels", "1"},
          {"features", std::to_string(features)},
          {"log2_entries", std::to_string(log2_entries)},
          {"base_resolution", std::to_string(resolution)},
          {"finest_resolution", std::to_string(resolution)},
          {"interpolation", interpolation}};
}

}  // namespace semfield::numerics
