// Formulas of the importance sampler, for host and device.
#pragma once

#include <cstdint>

#include "core/host_device.h"

namespace semfield {

/// Walks the inverse CDF of a piecewise constant density for ascending u. Cell k spans [begin, end] and holds `mass` of
/// `total`. The last cell ends at 1 by decree, not by what the sum came to.
struct CdfWalk {
  double below = 0;  ///< CDF at the cell's begin
  double mass = 0;   ///< of the cell, normalised
  double begin = 0, end = 0;
  bool is_last = false;

  SEMFIELD_HD bool holds(double u) const { return is_last || u < below + mass; }
  /// t = begin + (u - CDF(begin)) / mass * (end - begin), kept inside the cell.
  SEMFIELD_HD double point(double u) const {
    double share = mass > 0 ? (u - below) / mass : 0.5;
    share = share < 0 ? 0 : share > 1 ? 1 : share;
    const double t = begin + share * (end - begin);
    return t < end ? t : end;
  }
};

}  // namespace semfield
