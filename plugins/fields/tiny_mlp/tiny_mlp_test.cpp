// Tests of the small network: an independent forward, its feature alone. Mlp of tests/plugin has the saving.
#include "fields/tiny_mlp/tiny_mlp.h"

#include <algorithm>

#include "plugin/registry.h"
#include "testkit/compare.h"
#include "testkit/benches.h"
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
    testkit::TensorBox<double> of_whole(whole, 1), of_alone(alone, 2);
    EXPECT_LT(of_alone.count(), of_whole.count());
    const auto twin_of = [&](std::size_t i) {
      std::size_t other = 0;
      while (other < of_whole.count() && of_whole.specs()[other].name != of_alone.specs()[i].name) ++other;
      EXPECT_LT(other, of_whole.count()) << of_alone.specs()[i].name;
      return other;
    };
    for (std::size_t i = 0; i < of_alone.count(); ++i) {
      EXPECT_LACKS(of_alone.specs()[i].name, "color");
      std::copy_n(of_whole.value(twin_of(i)).data, of_alone.value(i).size(), of_alone.value(i).data);
    }
    constexpr std::int64_t kRows = 33;
    std::vector<double> x(kRows * 7), d(static_cast<std::size_t>(kRows * alone.traits().feature_dims));
    for (std::size_t i = 0; i < x.size(); ++i) x[i] = std::sin(1.7 * static_cast<double>(i));
    for (std::size_t i = 0; i < d.size(); ++i) d[i] = std::cos(0.9 * static_cast<double>(i));
    const std::vector<std::int32_t> ray(kRows, 0);
    const auto run = [&](const TinyMlp<double>& field, testkit::TensorBox<double>& box,
                         std::vector<double>& out_feature, std::vector<double>& d_x) {
      Workspace arena;
      StepContext ctx{.workspace = &arena};
      FieldIn<double> in{.position = {x.data(), kRows, 7}, .ray_of_sample = {ray.data(), kRows, 1}};
      FieldOut<double> out;
      out_feature.resize(d.size());
      d_x.resize(x.size());
      out.feature = {out_feature.data(), kRows, field.traits().feature_dims};
      const std::size_t bytes = field.saved_bytes(kRows, 1);
      const Saved saved(arena.take_bytes(bytes), bytes);
      field.derive(ctx, box.tensors());
      field.forward(ctx, box.tensors(), in, out, saved);
      FieldGrad<double> grad{.feature = {d.data(), kRows, field.traits().feature_dims}};
      box.fill_grads(0);
      field.backward(ctx, box.tensors(), in, out, grad, saved, {d_x.data(), kRows, 7});
      return bytes;
    };
    std::vector<double> a, b, dx_a, dx_b;
    EXPECT_GT(run(whole, of_whole, a, dx_a), run(alone, of_alone, b, dx_b));
    EXPECT_EQ(a, b);
    EXPECT_EQ(dx_a, dx_b);
    for (std::size_t i = 0; i < of_alone.count(); ++i) {
      if (!of_alone.learned(i)) continue;
      const View<double> want = of_whole.grad(twin_of(i)), got = of_alone.grad(i);
      EXPECT_TRUE(std::equal(got.data, got.data + got.size(), want.data)) << of_alone.specs()[i].name;
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
