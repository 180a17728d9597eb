// Networks by plain loops, and the kernels of those that are compared with them.
#pragma once

#include <gtest/gtest.h>

#include <algorithm>

#include "plugin/mlp/mlp.h"
#include "testkit/benches.h"

namespace semfield::testkit {

/// The CPU's kernels of networks of layers.
inline const KernelTables& mlp_tables() {
  static const KernelTables tables = [] {
    KernelTables all;
    mlp_kernels(all);
    return all;
  }();
  return tables;
}

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
  EXPECT_EQ(weight.rows, std::ssize(x)) << name;
  return plain_layer(x, weight, bias, relu);
}

}  // namespace semfield::testkit
