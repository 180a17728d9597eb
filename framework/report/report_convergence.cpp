#include "report/report_convergence.h"

#include <cmath>

#include "core/check.h"

namespace semfield {

std::optional<double> time_to_share(const std::vector<PlotPoint>& curve, int better, double share) {
  SEMFIELD_CHECK(better == 1 || better == -1, "a curve has a better direction");
  SEMFIELD_CHECK(share >= 0 && share <= 1, "a share lies between 0 and 1");
  std::vector<PlotPoint> finite;
  for (const PlotPoint& p : curve) {
    if (std::isfinite(p.x) && std::isfinite(p.y)) finite.push_back(p);
  }
  if (finite.size() < 2 || better * (finite.back().y - finite.front().y) <= 0) return std::nullopt;
  const double level = finite.front().y + share * (finite.back().y - finite.front().y);
  for (std::size_t i = 1; i < finite.size(); ++i) {
    const PlotPoint &before = finite[i - 1], &after = finite[i];
    if (better * (after.y - level) < 0) continue;
    // The point before lies below the level, or this is the first segment and the level its start.
    const double way = after.y - before.y;
    return way == 0 ? before.x : before.x + (level - before.y) / way * (after.x - before.x);
  }
  return finite.back().x;  // rounding kept the last value a hair from its own level
}

}  // namespace semfield
