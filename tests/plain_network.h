// Networks by plain loops, and two benches of one field side by side.
#pragma once

#include <gtest/gtest.h>

#include <algorithm>

#include "testkit/compare.h"
#include "testkit/field_bench.h"

namespace semfield::testkit {

/// x W + b; rectified when wanted.
inline std::vector<double> plain_layer(const std::vector<double>& x, View<const double> w, View<const double> b,
                                       bool relu) {
  std::vector<double> y(static_cast<std::size_t>(w.cols));
  for (std::int32_t n = 0; n < w.cols; ++n) {
    double sum = b(0, n);
    for (std::size_t k = 0; k < x.size(); ++k) sum += x[k] * w(static_cast<std::int64_t>(k), n);
    y[n] = relu ? std::max(0.0, sum) : sum;
  }
  return y;
}

/// The same with the tensors NAME/weight and NAME/bias of a bench.
inline std::vector<double> plain_layer(FieldBench<double>& bench, const std::string& name, const std::vector<double>& x,
                                       bool relu = false) {
  View<const double> weight, bias;
  for (std::size_t i = 0; i < bench.box.count(); ++i) {
    if (bench.box.specs()[i].name == name + "/weight") weight = bench.box.value(i);
    if (bench.box.specs()[i].name == name + "/bias") bias = bench.box.value(i);
  }
  if (weight.empty() || bias.empty()) ADD_FAILURE() << "no tensors of " << name;
  return plain_layer(x, weight, bias, relu);
}

/// Outputs and gradients of two ways to compute one network agree to 1e-12; the benches have gone both ways.
inline void expect_same_network(FieldBench<double>& got, FieldBench<double>& want) {
  const auto same = [](View<const double> a, View<const double> b) { return compare<double, double>(a, b, 1e-12); };
  EXPECT_EQ(same(got.sigma.view(), want.sigma.view()), "");
  EXPECT_EQ(same(got.rgb.view(), want.rgb.view()), "");
  EXPECT_EQ(same(got.feature.view(), want.feature.view()), "");
  EXPECT_EQ(same(got.d_position.view(), want.d_position.view()), "");
  int compared = 0;
  for (std::size_t i = 0; i < want.box.count(); ++i) {
    if (!want.box.learned(i)) continue;
    const std::string& name = want.box.specs()[i].name;
    ASSERT_EQ(got.box.specs()[i].name, name);
    ASSERT_EQ(same(got.box.value(i), want.box.value(i)), "") << name;
    EXPECT_EQ(same(got.box.grad(i), want.box.grad(i)), "") << name;
    ++compared;
  }
  EXPECT_GT(compared, 5);
}

}  // namespace semfield::testkit
