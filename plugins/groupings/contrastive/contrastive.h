// Contrastive: points of one segment are pulled together, segments of an image are pushed apart.
#pragma once

#include <vector>

#include "groupings/contrastive/contrastive_math.h"
#include "plugin/grouping.h"

namespace semfield {

class Contrastive final : public GroupingOf<Contrastive> {
 public:
  void describe(ParamVisitor& visit) override {
    SEMFIELD_PARAM(visit, *this, dims, "numbers of a point's embedding", {2, 64});
    SEMFIELD_PARAM(visit, *this, gather, "weight of the pull of a point to the middle of its segment", {0, 100});
    SEMFIELD_PARAM(visit, *this, slow,
                   "share of its values that the slow copy keeps in a step, against which points are compared; 0: they "
                   "are compared with the network itself",
                   {0, 0.9999});
    SEMFIELD_PARAM(visit, *this, radius, "distance of embeddings within which points are one object", {1e-3, 1e3});
  }
  std::int32_t width() const override { return static_cast<std::int32_t>(dims); }
  double slow_share() const override { return slow; }

  // Points at even places ask, those at odd ones are compared with.
  template <class Real>
  double sum(const SegmentedPoints<Real>& points, double scale, View<Real> gradients) const {
    const std::int64_t keys = points.rows.rows / 2;
    std::vector<std::int32_t> of_key(static_cast<std::size_t>(keys));
    std::vector<Real> scores(static_cast<std::size_t>(keys));
    for (std::int64_t j = 0; j < keys; ++j)
      of_key[static_cast<std::size_t>(j)] = points.segment[static_cast<std::size_t>(2 * j + 1)];
    const View<const Real> odd(points.slow.data + points.slow.row_stride, keys, points.slow.cols,
                               2 * points.slow.row_stride);
    double total = 0;
    for (std::int64_t i = 0; i < 2 * keys; i += 2)
      total += contrastive_point<Real>(points.rows.row(i), odd, of_key, points.segment[static_cast<std::size_t>(i)],
                                       {gather}, scale, gradients.row(i), scores);
    return total;
  }

  void place(View<float> rows) const override {
    for (std::int64_t r = 0; r < rows.rows; ++r)
      for (std::int32_t d = 0; d < rows.cols; ++d) rows(r, d) /= static_cast<float>(radius);
  }

  std::int64_t dims = 16;
  double gather = 0.5;
  double slow = 0.9;
  double radius = 1;
};

}  // namespace semfield
