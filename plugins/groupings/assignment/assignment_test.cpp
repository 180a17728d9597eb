// The assignment against every way of assigning.
#include "groupings/assignment/assignment.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <numeric>

#include "core/rng.h"

namespace semfield {
namespace {

double cost_of(View<const double> cost, const std::vector<std::int32_t>& column) {
  double sum = 0;
  for (std::int64_t r = 0; r < cost.rows; ++r) sum += cost(r, column[static_cast<std::size_t>(r)]);
  return sum;
}

double least_of_all(View<const double> cost) {
  std::vector<std::int32_t> order(static_cast<std::size_t>(cost.cols));
  std::iota(order.begin(), order.end(), 0);
  double least = INFINITY;
  do {
    least = std::min(least, cost_of(cost, order));
  } while (std::next_permutation(order.begin(), order.end()));
  return least;
}

TEST(CheapestAssignment, IsTheLeastOfAll) {
  for (std::int32_t columns = 1; columns <= 6; ++columns) {
    for (std::int32_t rows = 1; rows <= columns; ++rows) {
      for (std::uint64_t seed = 0; seed < 20; ++seed) {
        std::vector<double> numbers;
        for (std::int32_t i = 0; i < rows * columns; ++i)  // whole numbers: some costs are equal, some negative
          numbers.push_back(static_cast<double>(uniform_below({seed, 1, 2}, static_cast<std::uint64_t>(i), 9)) - 4);
        const View<const double> cost(numbers.data(), rows, columns);
        std::vector<std::int32_t> column = cheapest_assignment(cost);
        ASSERT_EQ(std::ssize(column), rows);
        EXPECT_EQ(cost_of(cost, column), least_of_all(cost)) << rows << " x " << columns << ", seed " << seed;
        std::sort(column.begin(), column.end());
        EXPECT_EQ(std::adjacent_find(column.begin(), column.end()), column.end()) << "all different";
        EXPECT_GE(column.front(), 0);
        EXPECT_LT(column.back(), columns);
      }
    }
  }
}

}  // namespace
}  // namespace semfield
