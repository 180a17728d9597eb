// How soon a curve came near the value it ended at.
#pragma once

#include <optional>
#include <vector>

#include "report/report_svg.h"

namespace semfield {

/// Abscissa at which `curve` (ascending in x) first covers `share` (0 to 1) of the way from its first to its last
/// finite value, f + share (l - f), read as straight lines between its points; a later dip does not count. `better` is
/// +1 for values that rise and -1 for those that fall. None with fewer than two finite values, and when the last is not
/// better than the first.
std::optional<double> time_to_share(const std::vector<PlotPoint>& curve, int better, double share);

}  // namespace semfield
