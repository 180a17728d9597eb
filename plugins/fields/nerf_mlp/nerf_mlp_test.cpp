// Tests of the NeRF network: parameter count, an independent forward. Mlp of tests/plugin has the savings.
#include "fields/nerf_mlp/nerf_mlp.h"

#include "plugin/registry.h"
#include "testkit/compare.h"
#include "testkit/laws.h"
#include "tests/plain_network.h"
#include "tests/says.h"

namespace semfield {
namespace {

using namespace testkit;

const NerfMlpParams kSmall{4, 12, 2, 9};

FieldBuild build_of(std::int32_t position_dims, std::int32_t direction_dims, bool fold = true, bool once = true) {
  return FieldBuild{.position_dims = position_dims,
                    .direction_dims = direction_dims,
                    .savings = {.fold_feature_layer = fold, .direction_once_per_ray = once}};
}

std::int64_t learned_count(const NerfMlpParams& params, const FieldBuild& build) {
  std::int64_t learned = 0;
  const TensorBox<float> box(NerfMlp<float>(params, build, mlp_tables()), 1);
  for (const TensorSpec& spec : box.specs()) learned += spec.role == TensorRole::dense ? spec.rows * spec.cols : 0;
  return learned;
}

TEST(NerfMlp, HasThePapersParameterCount) {
  EXPECT_EQ(learned_count({}, build_of(63, 27)), 595844);
  EXPECT_EQ(learned_count({}, build_of(63, 27, false, false)), 595844);
  // Without direction the feature layer and 27 x 128 view weights are gone.
  EXPECT_EQ(learned_count({}, build_of(63, 0)), 595844 - (256 * 256 + 256) - 27 * 128);
}

TEST(NerfMlp, StartsWithinTheFanIn) {
  int seen = 0;
  const TensorBox<float> box(NerfMlp<float>({}, build_of(63, 27), mlp_tables()), 1);
  for (const TensorSpec& spec : box.specs()) {
    if (!spec.name.starts_with("trunk_5/") || spec.role != TensorRole::dense) continue;
    EXPECT_DOUBLE_EQ(spec.init.high, 1 / std::sqrt(319.0)) << spec.name;
    ++seen;
  }
  EXPECT_EQ(seen, 2) << "weight and bias of the layer with the skip";
}

TEST(NerfMlp, ForwardIsThePapersNetwork) {
  const FieldBuild build = build_of(7, 5);
  const NerfMlp<double> field(kSmall, build, mlp_tables());
  FieldBench<double> bench(field, build, 33, 0, {});
  bench.forward();
  const FieldIn<double> in = bench.in();
  for (std::int64_t m = 0; m < 33; ++m) {
    const std::vector<double> x(in.position.row(m), in.position.row(m) + 7);
    const double* d = in.direction.row(in.ray_of_sample(m, 0));
    std::vector<double> h = x;
    for (int i = 0; i < 4; ++i) {
      if (i == 2) h.insert(h.begin(), x.begin(), x.end());
      h = plain_layer(bench, "trunk_" + std::to_string(i), h, true);
    }
    EXPECT_NEAR(bench.sigma(m, 0), plain_layer(bench, "density", h)[0], 1e-12);
    for (int c = 0; c < 12; ++c) EXPECT_NEAR(bench.feature(m, c), h[c], 1e-12);
    std::vector<double> f = plain_layer(bench, "feature", h);
    f.insert(f.end(), d, d + 5);
    const auto v = plain_layer(bench, "view", f, true);
    const auto logit = plain_layer(bench, "color", v);
    for (int c = 0; c < 3; ++c) EXPECT_NEAR(bench.rgb(m, c), 1 / (1 + std::exp(-logit[c])), 1e-12);
  }
}

TEST(NerfMlp, BackwardWithoutPositionGradientGivesTheSameParameterGradients) {
  const FieldBuild build = build_of(7, 5);
  const NerfMlp<float> field(kSmall, build, mlp_tables());
  FieldBench<float> with(field, build, 33, 0, {}), without(field, build, 33, 0, {});
  with.forward();
  with.backward();
  without.forward();
  without.backward({}, false);
  for (std::size_t i = 0; i < with.box.count(); ++i)
    EXPECT_EQ(testkit::compare_bits<float>(with.box.grad(i), without.box.grad(i)), "") << with.box.specs()[i].name;
}

TEST(NerfMlp, RefusesASkipBeyondTheTrunk) {
  Diagnostics diagnostics;
  validate(NerfMlpParams{4, 8, 4, 8}, diagnostics);
  ASSERT_EQ(diagnostics.error_count(), 1);
  EXPECT_EQ(diagnostics.all()[0].where, "skip_at");
  EXPECT_THROW(NerfMlp<float>({4, 8, 4, 8}, build_of(7, 5), mlp_tables()), Error);
  EXPECT_THROW(NerfMlp<float>({}, build_of(0, 5), mlp_tables()), Error);
}

TEST(NerfMlp, SaysWhereAGpuComputesItLayerByLayer) {
  const auto said = [](const NerfMlpParams& params, bool hopper = true, bool fold = true, bool branch = false) {
    const MlpKernels<float> layers;
    NerfMlpFused<float> table;
    table.serve = fused_takes;
    if (!hopper) table.serve = [](const NerfMlpShape&) { return false; };
    FieldBuild build = build_of(63, 27, fold);
    build.device = Device::cuda;
    build.feature_only = branch;
    build.precision = Precision::bf16;
    KernelTables t;
    t.add(Device::cuda, kMlpOwner, &layers, build.precision);
    t.add(Device::cuda, "field 'nerf_mlp'", &table, build.precision);
    return NerfMlp<float>(params, build, t).slow_path();
  };
  EXPECT_EQ(said({}), "");
  EXPECT_HAS(said(kSmall), "field 'nerf_mlp' runs layer by layer", "width: 256");
  EXPECT_EQ(said({}, true, false), said(kSmall));
  EXPECT_HAS(said({}, true, true, true), "semantic branch");
  EXPECT_HAS(said({}, false), "compute capability 9.0");
  EXPECT_EQ((NerfMlp<float>(kSmall, build_of(63, 27), mlp_tables()).slow_path()), "") << "on a CPU";
}

}  // namespace
}  // namespace semfield
