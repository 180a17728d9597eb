// Rows of a tensor with their gradient and moments, as Adam updates them.
#pragma once

#include <vector>

#include "core/view.h"
#include "model/optim/adam.h"

namespace semfield::testing {

template <class Real>
struct AdamRows {
  explicit AdamRows(std::int64_t row_count, std::int32_t width = 1)
      : value(static_cast<std::size_t>(row_count * width)),
        grad(value),
        m(value),
        v(value),
        rows(row_count),
        cols(width) {}
  View<Real> view(std::vector<Real>& x) { return {x.data(), rows, cols}; }
  void dense(const AdamStep& step) { dense(step, 0, rows); }
  void dense(const AdamStep& step, std::int64_t begin, std::int64_t count) {
    adam_dense<Real>(step, view(value), view(grad), view(m), view(v), begin, count);
  }
  std::int64_t touched(const AdamStep& step) { return touched(step, 0, rows); }
  std::int64_t touched(const AdamStep& step, std::int64_t begin, std::int64_t count) {
    return adam_touched<Real>(step, view(value), view(grad), view(m), view(v), begin, count);
  }
  std::vector<Real> value, grad, m, v;
  std::int64_t rows;
  std::int32_t cols;
};

}  // namespace semfield::testing
