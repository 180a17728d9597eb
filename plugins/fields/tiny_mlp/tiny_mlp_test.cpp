// Tests of the small network: an independent forward, its feature alone. Mlp of tests/plugin has the saving.
#include "fields/tiny_mlp/tiny_mlp.h"

#include "plugin/registry.h"
#include "testkit/compare.h"
#include "testkit/laws.h"
#include "tests/plain_network.h"
#include "tests/says.h"

namespace semfield {
namespace {

using namespace testkit;

// What a field says whose device has these kernels, as far as they say which networks they take.
std::string slow_path_of(const TinyMlpParams& params, FieldBuild build, bool shared_memory = true) {
  const MlpKernels<float> layers;
  TinyMlpFused<float> fused;
  fused.serve = [](const TinyMlpShape& s) { return fused_takes(s) || fused_takes_feature(s); };
  if (!shared_memory) fused.serve = [](const TinyMlpShape&) { return false; };
  build.device = Device::cuda;
  KernelTables t;
  t.add(Device::cuda, kMlpOwner, &layers, build.precision);
  if (build.precision == Precision::bf16) t.add(Device::cuda, "field 'tiny_mlp'", &fused, Precision::bf16);
  return TinyMlp<float>(params, build, t).slow_path();
}

TinyMlpParams small(TinyFeature feature = TinyFeature::hidden) { return {12, 2, 5, 10, 2, feature}; }

FieldBuild build_of(std::int32_t position_dims, std::int32_t direction_dims) {
  return FieldBuild{.position_dims = position_dims, .direction_dims = direction_dims};
}

TEST(TinyMlp, ForwardIsTheNetwork) {
  for (const TinyFeature feature : {TinyFeature::hidden, TinyFeature::geometry}) {
    const FieldBuild build = build_of(7, 4);
    const TinyMlp<double> field(small(feature), build, mlp_tables());
    FieldBench<double> bench(field, build, 33, 0, {});
    bench.forward();
    const FieldIn<double> in = bench.in();
    for (std::int64_t m = 0; m < 33; ++m) {
      const std::vector<double> x(in.position.row(m), in.position.row(m) + 7);
      const double* d = in.direction.row(in.ray_of_sample(m, 0));
      const auto h = plain_layer(bench, "hidden_1", plain_layer(bench, "hidden_0", x, true), true);
      const auto out = plain_layer(bench, "geometry", h);
      EXPECT_NEAR(bench.sigma(m, 0), out[0], 1e-12);
      std::vector<double> g(out.begin() + 1, out.end());
      const std::vector<double>& wanted = feature == TinyFeature::hidden ? h : g;
      ASSERT_EQ(field.traits().feature_dims, static_cast<std::int32_t>(wanted.size()));
      for (std::size_t c = 0; c < wanted.size(); ++c)
        EXPECT_NEAR(bench.feature(m, static_cast<std::int32_t>(c)), wanted[c], 1e-12);
      g.insert(g.end(), d, d + 4);
      const auto c0 = plain_layer(bench, "color_0", g, true), c1 = plain_layer(bench, "color_1", c0, true);
      const auto logit = plain_layer(bench, "rgb", c1);
      for (int c = 0; c < 3; ++c) EXPECT_NEAR(bench.rgb(m, c), 1 / (1 + std::exp(-logit[c])), 1e-12);
    }
  }
}

// Built for its feature alone, the network has that feature and its gradients, and no tensor of anything else.
TEST(TinyMlp, FeatureAloneIsThatOfTheWholeNetwork) {
  for (const TinyFeature feature : {TinyFeature::hidden, TinyFeature::geometry}) {
    FieldBuild build = build_of(7, 0);
    const TinyMlp<double> whole(small(feature), build, mlp_tables());
    build.feature_only = true;
    const TinyMlp<double> alone(small(feature), build, mlp_tables());
    FieldBench<double> of_whole(whole, build_of(7, 0), 33, 0, {}), of_alone(alone, build, 33, 0, {.seed = 2});
    EXPECT_LT(of_alone.box.count(), of_whole.box.count());
    const auto twin_of = [&](std::size_t i) {
      std::size_t other = 0;
      while (other < of_whole.box.count() && of_whole.box.specs()[other].name != of_alone.box.specs()[i].name) ++other;
      EXPECT_LT(other, of_whole.box.count()) << of_alone.box.specs()[i].name;
      return other;
    };
    for (std::size_t i = 0; i < of_alone.box.count(); ++i) {
      EXPECT_LACKS(of_alone.box.specs()[i].name, "color");
      std::copy_n(of_whole.box.value(twin_of(i)).data, of_alone.box.value(i).size(), of_alone.box.value(i).data);
    }
    of_alone.derive();
    of_alone.position = of_whole.position;
    of_alone.w_feature = of_whole.w_feature;
    const Wanted feature_alone{false, false, true};
    for (FieldBench<double>* const bench : {&of_whole, &of_alone}) {
      bench->forward(feature_alone);
      bench->backward(feature_alone);
    }
    EXPECT_GT(whole.saved_bytes(33, 1), alone.saved_bytes(33, 1));
    EXPECT_EQ(compare_bits<double>(of_alone.feature.view(), of_whole.feature.view()), "");
    EXPECT_EQ(compare_bits<double>(of_alone.d_position.view(), of_whole.d_position.view()), "");
    for (std::size_t i = 0; i < of_alone.box.count(); ++i) {
      if (!of_alone.box.learned(i)) continue;
      const View<double> want = of_whole.box.grad(twin_of(i)), got = of_alone.box.grad(i);
      EXPECT_EQ(compare_bits<double>(got, want), "") << of_alone.box.specs()[i].name;
      EXPECT_TRUE(std::any_of(got.data, got.data + got.size(), [](double g) { return g != 0; }));
    }
  }
}

TEST(TinyMlp, SaysWhatItCannotBuild) {
  EXPECT_THROW(TinyMlp<float>({}, build_of(0, 4), mlp_tables()), Error);
  FieldBuild build = build_of(7, 4);
  build.device = Device::cuda;
  EXPECT_HAS(error_of([&] { const TinyMlp<float> field({}, build, mlp_tables()); }),
             "field 'tiny_mlp' has no cuda kernels");
}

TEST(TinyMlp, SaysWhereAGpuComputesItLayerByLayer) {
  FieldBuild build = build_of(32, 16);
  build.precision = Precision::bf16;
  EXPECT_EQ(slow_path_of({}, build), "");
  for (const TinyMlpParams& params : {TinyMlpParams{65}, TinyMlpParams{64, 2}, TinyMlpParams{64, 1, 16},
                                      TinyMlpParams{64, 1, 15, 128}, TinyMlpParams{64, 1, 15, 64, 3}})
    EXPECT_HAS(slow_path_of(params, build), "field 'tiny_mlp' runs layer by layer", "one hidden layer");
  EXPECT_HAS(slow_path_of({}, build, false), "shared memory");
  FieldBuild branch = build_of(115, 0);
  branch.precision = Precision::bf16;
  branch.feature_only = true;
  EXPECT_EQ(slow_path_of({128, 2}, branch), "");
  EXPECT_HAS(slow_path_of({129, 2}, branch), "as a semantic branch");
  build.precision = Precision::fp32;
  EXPECT_EQ(slow_path_of({128}, build), "") << "then it is the precision that is slow";
  EXPECT_EQ((TinyMlp<float>({128}, build_of(32, 16), mlp_tables()).slow_path()), "") << "on a CPU";
}

}  // namespace
}  // namespace semfield
