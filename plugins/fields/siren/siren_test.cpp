// Tests of the field of sines: an independent forward, and how it starts.

#include "testkit/laws.h"
#include "tests/linked_registry.h"
#include "tests/plain_network.h"

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
  const auto sines = [&](const std::string& name, const std::vector<double>& x) {
    std::vector<double> y = testkit::plain_layer(bench, name, x);
    for (double& value : y) value = std::sin(4 * value);
    return y;
  };
  for (std::int64_t m = 0; m < 9; ++m) {
    const double* x = bench.position.view().row(m);
    const std::vector<double> h = sines("sine_1", sines("sine_0", {x, x + 3}));
    for (std::int32_t j = 0; j < 6; ++j) EXPECT_NEAR(bench.feature(m, j), h[j], 1e-12);
    EXPECT_NEAR(bench.sigma(m, 0), testkit::plain_layer(bench, "density", h)[0], 1e-12);
  }
}

}  // namespace
}  // namespace semfield
