// Tests of the field of sines: an independent forward, and how it starts.
#include <gtest/gtest.h>

#include "testkit/benches.h"
#include "testkit/laws.h"
#include "tests/linked_registry.h"

namespace semfield {
namespace {

TEST(Siren, FeatureAndDensityAreSinesOfSines) {
  const Registry& registry = testkit::linked_registry();
  const PluginEntry& entry = registry.get(PluginKind::field, "siren");
  const testkit::Settings settings{{"layers", "2"}, {"width", "6"}, {"frequency", "4"}};
  const FieldBuild build{.position_dims = 3, .direction_dims = 2};
  const auto field = entry.field64(*testkit::make_params(entry, settings), build, registry.kernels());
  testkit::FieldBench<double> bench(*field, build, 9, 0, {});
  bench.forward();
  std::map<std::string, View<const double>> tensor;
  for (std::size_t i = 0; i < bench.box.count(); ++i) tensor[bench.box.specs()[i].name] = bench.box.value(i);
  const auto sines = [&](const std::string& name, const std::vector<double>& x) {
    const View<const double> w = tensor.at(name + "/weight"), b = tensor.at(name + "/bias");
    std::vector<double> y;
    for (std::int32_t j = 0; j < w.cols; ++j) {
      double sum = b(0, j);
      for (std::size_t i = 0; i < x.size(); ++i) sum += x[i] * w(static_cast<std::int64_t>(i), j);
      y.push_back(std::sin(4 * sum));
    }
    return y;
  };
  for (std::int64_t m = 0; m < 9; ++m) {
    const double* x = bench.position.view().row(m);
    const std::vector<double> h = sines("sine_1", sines("sine_0", {x, x + 3}));
    double sigma = tensor.at("density/bias")(0, 0);
    for (std::int32_t j = 0; j < 6; ++j) {
      EXPECT_NEAR(bench.feature(m, j), h[j], 1e-12);
      sigma += h[j] * tensor.at("density/weight")(j, 0);
    }
    EXPECT_NEAR(bench.sigma(m, 0), sigma, 1e-12);
  }
}

}  // namespace
}  // namespace semfield
