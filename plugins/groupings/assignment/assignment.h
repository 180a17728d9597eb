// Assignment: segments of an image are given to slots, each to one, and points learn the slot of their segment.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numeric>
#include <vector>

#include "core/view.h"
#include "plugin/grouping.h"

namespace semfield {

/// The column of each row, all different, for which the sum of cost [rows, columns] is least; rows <= columns. The
/// method of shortest augmenting paths with potentials [Kuhn55; Jonker87], O(rows^2 columns).
inline std::vector<std::int32_t> cheapest_assignment(View<const double> cost) {
  const auto rows = static_cast<std::size_t>(cost.rows), columns = static_cast<std::size_t>(cost.cols);
  constexpr double kFar = std::numeric_limits<double>::infinity();
  // Rows and columns are counted from 1; 0 stands for none.
  std::vector<double> of_row(rows + 1, 0), of_column(columns + 1, 0);
  std::vector<std::size_t> row_of(columns + 1, 0), before(columns + 1, 0);
  for (std::size_t row = 1; row <= rows; ++row) {
    row_of[0] = row;
    std::size_t at = 0;
    std::vector<double> least(columns + 1, kFar);
    std::vector<bool> done(columns + 1, false);
    while (row_of[at] != 0) {
      done[at] = true;
      const std::size_t r = row_of[at];
      std::size_t next = 0;
      double step = kFar;
      for (std::size_t c = 1; c <= columns; ++c) {
        if (done[c]) continue;
        const double reduced =
            cost(static_cast<std::int64_t>(r - 1), static_cast<std::int32_t>(c - 1)) - of_row[r] - of_column[c];
        if (reduced < least[c]) {
          least[c] = reduced;
          before[c] = at;
        }
        if (least[c] < step) {
          step = least[c];
          next = c;
        }
      }
      for (std::size_t c = 0; c <= columns; ++c) {
        if (done[c]) {
          of_row[row_of[c]] += step;
          of_column[c] -= step;
        } else {
          least[c] -= step;
        }
      }
      at = next;
    }
    for (; at != 0; at = before[at]) row_of[at] = row_of[before[at]];
  }
  std::vector<std::int32_t> column(rows, -1);
  for (std::size_t c = 1; c <= columns; ++c)
    if (row_of[c] != 0) column[row_of[c] - 1] = static_cast<std::int32_t>(c - 1);
  return column;
}

class Assignment final : public GroupingOf<Assignment> {
 public:
  void describe(ParamVisitor& visit) override {
    SEMFIELD_PARAM(visit, *this, slots, "the most objects that can be distinguished", {2, 1024});
  }
  std::int32_t width() const override { return static_cast<std::int32_t>(slots); }

  // p = softmax(row). Segment s costs slot k minus the mean of p_k over its points; of the cheapest assignment a
  // segment's points learn their slot by cross-entropy [Siddiqui23 Sec. 3.3]. Beyond `slots` the smallest segments of
  // an image teach nothing.
  template <class Real>
  double sum(const SegmentedPoints<Real>& points, double scale, View<Real> gradients) const {
    const std::int64_t count = points.rows.rows;
    const std::int32_t width = points.rows.cols;
    std::vector<double> p(static_cast<std::size_t>(count * width)), log_sum(static_cast<std::size_t>(count));
    for (std::int64_t i = 0; i < count; ++i) {
      const Real* const row = points.rows.row(i);
      const auto most = static_cast<double>(*std::max_element(row, row + width));
      double* const to = &p[static_cast<std::size_t>(i * width)];
      double all = 0;
      for (std::int32_t k = 0; k < width; ++k) all += to[k] = std::exp(static_cast<double>(row[k]) - most);
      for (std::int32_t k = 0; k < width; ++k) to[k] /= all;
      log_sum[static_cast<std::size_t>(i)] = most + std::log(all);
    }
    const std::vector<std::int32_t> slot = slots_of(points, p);
    double total = 0;
    for (std::int64_t i = 0; i < count; ++i) {
      const std::int32_t own = slot[static_cast<std::size_t>(points.segment[static_cast<std::size_t>(i)])];
      if (own < 0) continue;
      total += log_sum[static_cast<std::size_t>(i)] - static_cast<double>(points.rows(i, own));
      for (std::int32_t k = 0; k < width; ++k)
        gradients(i, k) += static_cast<Real>(scale * (p[static_cast<std::size_t>(i * width + k)] - (k == own ? 1 : 0)));
    }
    return total;
  }

  // Probabilities, so that points of two slots lie about sqrt(2) kSpread apart.
  void place(View<float> rows) const override {
    for (std::int64_t r = 0; r < rows.rows; ++r) {
      float* const row = rows.row(r);
      const float most = *std::max_element(row, row + rows.cols);
      float all = 0;
      for (std::int32_t k = 0; k < rows.cols; ++k) all += row[k] = std::exp(row[k] - most);
      for (std::int32_t k = 0; k < rows.cols; ++k) row[k] *= kSpread / all;
    }
  }

  std::int64_t slots = 96;

 private:
  static constexpr float kSpread = 1.5F;

  template <class Real>
  static std::vector<std::int32_t> slots_of(const SegmentedPoints<Real>& points, const std::vector<double>& p) {
    const auto segments = static_cast<std::size_t>(points.segments);
    const auto width = static_cast<std::size_t>(points.rows.cols);
    std::vector<double> size(segments, 0), cost(segments * width, 0);
    for (std::size_t i = 0; i < points.segment.size(); ++i) {
      const auto s = static_cast<std::size_t>(points.segment[i]);
      size[s] += 1;
      for (std::size_t k = 0; k < width; ++k) cost[s * width + k] -= p[i * width + k];
    }
    std::vector<std::size_t> order;
    for (std::size_t s = 0; s < segments; ++s)
      if (size[s] > 0) order.push_back(s);
    std::stable_sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) { return size[a] > size[b]; });
    order.resize(std::min(order.size(), width));
    std::vector<double> rows;
    for (const std::size_t s : order)
      for (std::size_t k = 0; k < width; ++k) rows.push_back(cost[s * width + k] / size[s]);
    const std::vector<std::int32_t> columns =
        cheapest_assignment({rows.data(), static_cast<std::int64_t>(order.size()), static_cast<std::int32_t>(width)});
    std::vector<std::int32_t> slot(segments, -1);
    for (std::size_t i = 0; i < order.size(); ++i) slot[order[i]] = columns[i];
    return slot;
  }
};

}  // namespace semfield
