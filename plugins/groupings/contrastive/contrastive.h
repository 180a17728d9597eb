// Contrastive: points of one segment are pulled together, segments of an image are pushed apart.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <span>
#include <vector>

#include "core/view.h"
#include "plugin/grouping.h"

namespace semfield {

struct ContrastiveRule {
  double gather = 1;  ///< weight of the pull to the middle of the segment
};

/// q [1, D], keys [K, D], s_j = -|q - k_j|^2, S the keys of the point's segment, m their mean:
/// loss = ln sum_j exp s_j - ln sum_{j in S} exp s_j + gather |q - m|^2 [Bhalgat23 Eq. 3-5]; the similarity there is a
/// Gaussian of the distance too. 0 without a key of the segment. `scale` times the gradient is added to dq.
/// scores [K] is scratch.
template <class Real>
double contrastive_point(const Real* q, View<const Real> keys, std::span<const std::int32_t> of_key,
                         std::int32_t segment, const ContrastiveRule& rule, double scale, Real* dq,
                         std::span<Real> scores) {
  const auto count = static_cast<std::size_t>(keys.rows);
  const std::int32_t width = keys.cols;
  Real most = -INFINITY, most_same = -INFINITY;
  std::int64_t same = 0;
  for (std::size_t j = 0; j < count; ++j) {
    const Real* const k = keys.row(static_cast<std::int64_t>(j));
    Real sum = 0;
    for (std::int32_t d = 0; d < width; ++d) sum += (q[d] - k[d]) * (q[d] - k[d]);
    scores[j] = -sum;
    most = std::max(most, scores[j]);
    if (of_key[j] != segment) continue;
    ++same;
    most_same = std::max(most_same, scores[j]);
  }
  if (same == 0) return 0;
  double all = 0, own = 0;
  for (std::size_t j = 0; j < count; ++j) {
    all += static_cast<double>(std::exp(scores[j] - most));
    if (of_key[j] == segment) own += static_cast<double>(std::exp(scores[j] - most_same));
  }
  const double log_all = static_cast<double>(most) + std::log(all),
               log_own = static_cast<double>(most_same) + std::log(own);
  double pull = 0;
  const auto share = 1 / static_cast<double>(same);
  for (std::size_t j = 0; j < count; ++j) {
    const Real* const k = keys.row(static_cast<std::int64_t>(j));
    const auto s = static_cast<double>(scores[j]);
    const bool is_own = of_key[j] == segment;
    // dloss/ds_j of the two logarithms, and ds_j/dq = -2 (q - k_j).
    const double slope = std::exp(s - log_all) - (is_own ? std::exp(s - log_own) : 0);
    const auto factor = static_cast<Real>(scale * (-2 * slope + (is_own ? 2 * rule.gather * share : 0)));
    for (std::int32_t d = 0; d < width; ++d) dq[d] += factor * (q[d] - k[d]);
  }
  if (rule.gather > 0) {  // |q - m|^2
    for (std::int32_t d = 0; d < width; ++d) {
      double mean = 0;
      for (std::size_t j = 0; j < count; ++j)
        if (of_key[j] == segment) mean += static_cast<double>(keys(static_cast<std::int64_t>(j), d));
      const double way = static_cast<double>(q[d]) - mean * share;
      pull += way * way;
    }
  }
  return log_all - log_own + rule.gather * pull;
}

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
