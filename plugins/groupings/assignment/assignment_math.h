// The cheapest one-to-one assignment of rows to columns.
#pragma once

#include <cstdint>
#include <limits>
#include <vector>

#include "core/view.h"

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

}  // namespace semfield
