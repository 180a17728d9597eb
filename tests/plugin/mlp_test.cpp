// Networks of layers as a field of every kind of layer: an independent forward, the laws of fields with every saving in
// every precision, gradients of every set of outputs, what is dropped, memory.

#include <map>

#include "plugin/mlp/field.h"
#include "testkit/compare.h"
#include "testkit/laws.h"
#include "tests/plain_network.h"

namespace semfield {
namespace {

using testkit::FieldBench;
using testkit::TensorBox;
using testkit::Wanted;

constexpr std::int32_t kPosition = 5, kDirection = 3, kWidth = 32;
constexpr std::int64_t kSamples = 37;

FieldBuild build_of(bool fold = true, bool once = true, Precision precision = Precision::fp32) {
  return {.position_dims = kPosition,
          .direction_dims = kDirection,
          .savings = {.fold_feature_layer = fold, .direction_once_per_ray = once},
          .precision = precision};
}

/// A chain with a skip, a sine of two inputs, columns that are read and an output, two linear layers with nothing
/// between them, a ray input, a sigmoid, an output that is read on, and a layer that nobody needs.
template <class Real>
class Everything final : public MlpField<Real> {
 public:
  explicit Everything(const FieldBuild& build) : MlpField<Real>(build, testkit::mlp_tables(), "test 'mlp'") {
    using enum LayerActivation;
    const Rows x = this->position();
    const Rows h = this->net().chain({"trunk", {x}, kWidth}, 3, 2);
    const Rows waves = this->layer({"waves", {h, x}, kWidth, sine, 3});
    const Rows geometry = this->layer({"geometry", {waves}, 4, none});
    this->layer({"unneeded", {waves}, 7});
    const Rows linear = this->layer({"linear", {geometry.columns(1, 3)}, 6, none});
    const Rows view = this->layer({"view", {linear, this->direction(), h}, kWidth});
    this->give(geometry.columns(0, 1), this->layer({"color", {view}, 3, sigmoid}), h);
  }
};

/// The field with its bench, forward and backward made.
template <class Real>
struct Made {
  explicit Made(const FieldBuild& build, std::int64_t samples = kSamples, const Wanted& wanted = {})
      : field(build), bench(field, build, samples, 0, {}) {
    bench.forward();
    bench.backward(wanted);
  }
  Everything<Real> field;
  FieldBench<Real> bench;
};

using Row = std::vector<double>;

Row joined(const Row& a, const Row& b) {
  Row all = a;
  all.insert(all.end(), b.begin(), b.end());
  return all;
}

TEST(Mlp, IsTheFormulas) {
  Made<double> made(build_of());
  FieldBench<double>& bench = made.bench;
  const auto layer = [&](const std::string& name, const Row& from, bool relu = false) {
    return testkit::plain_layer(bench, name, from, relu);
  };
  const auto each = [](Row row, auto f) {
    for (double& value : row) value = f(value);
    return row;
  };
  for (std::int64_t m = 0; m < kSamples; ++m) {
    const double* const at = bench.position.view().row(m);
    const double* const ray = bench.direction.view().row(bench.ray_of_sample(m, 0));
    const Row x(at, at + kPosition), d(ray, ray + kDirection);
    const Row h = layer("trunk_2", joined(x, layer("trunk_1", layer("trunk_0", x, true), true)), true);
    const Row waves = each(layer("waves", joined(h, x)), [](double z) { return std::sin(3 * z); });
    const Row geometry = layer("geometry", waves);
    const Row linear = layer("linear", {geometry[1], geometry[2], geometry[3]});
    const Row view = layer("view", joined(joined(linear, d), h), true);
    const Row color = each(layer("color", view), [](double z) { return 1 / (1 + std::exp(-z)); });
    EXPECT_NEAR(bench.sigma(m, 0), geometry[0], 1e-12);
    for (std::int32_t c = 0; c < 3; ++c) EXPECT_NEAR(bench.rgb(m, c), color[c], 1e-12);
    for (std::int32_t c = 0; c < kWidth; ++c) EXPECT_NEAR(bench.feature(m, c), h[c], 1e-12);
  }
}

// Central differences, accumulation, the oracle in double, the same bits whatever is wanted and kept, memory, products.
TEST(Mlp, KeepsTheLawsOfFieldsWithEverySavingAndPrecision) {
  for (const bool saves : {true, false}) {
    for (const Precision precision : {Precision::fp32, Precision::bf16}) {
      SCOPED_TRACE(testing::Message() << "savings " << saves << ", bf16 " << (precision == Precision::bf16));
      const testkit::LawOptions options{
          .float_tolerance = 1e-5, .bf16_tolerance = 0.12, .bf16_gradient_tolerance = 0.12, .gradient_elements = 8};
      const FieldBuild build = build_of(saves, saves, precision);
      const testkit::Failures failures =
          testkit::field_laws(Everything<float>(build), Everything<double>(build_of(saves, saves)), build, options);
      EXPECT_TRUE(failures.empty()) << testkit::to_text(failures);
    }
  }
}

TEST(Mlp, GradientsOfEverySetOfOutputsAddUp) {
  const Made<double> sigma(build_of(), kSamples, {true, false, false}), rgb(build_of(), kSamples, {false, true, false}),
      feature(build_of(), kSamples, {false, false, true});
  for (const Wanted wanted :
       {Wanted{}, {true, true, false}, {true, false, true}, {false, true, true}, {false, false, false}}) {
    const Made<double> made(build_of(), kSamples, wanted);
    const auto expect_sum = [&](const auto& of, const std::string& name) {
      const View<const double> got = of(made), a = of(sigma), b = of(rgb), c = of(feature);
      testkit::Guarded<double> sum(got.rows, got.cols);
      for (std::int64_t r = 0; r < got.rows; ++r)
        for (std::int32_t i = 0; i < got.cols; ++i)
          sum(r, i) = wanted.sigma * a(r, i) + wanted.rgb * b(r, i) + wanted.feature * c(r, i);
      EXPECT_EQ((testkit::compare<double, double>(got, sum.view(), 1e-12, 1e-3)), "") << name;
    };
    expect_sum([](const Made<double>& of) { return of.bench.d_position.view(); }, "d_position");
    for (std::size_t i = 0; i < made.bench.box.count(); ++i) {
      if (!made.bench.box.learned(i)) continue;
      expect_sum([i](const Made<double>& of) { return View<const double>(of.bench.box.grad(i)); },
                 made.bench.box.specs()[i].name);
    }
  }
}

TEST(Mlp, TheSavingsChangeNoNumber) {
  Made<double> plain(build_of(false, false));
  const auto view_of = [](const Made<double>& of, const std::string& name) {
    for (std::size_t i = 0; i < of.bench.box.count(); ++i)
      if (of.bench.box.specs()[i].name == name) return View<const double>(of.bench.box.grad(i));
    ADD_FAILURE() << "no tensor " << name;
    return View<const double>();
  };
  for (const auto& [fold, once] : {std::pair{true, false}, {false, true}, {true, true}}) {
    Made<double> saving(build_of(fold, once));
    const auto got = saving.bench.outputs(), want = plain.bench.outputs();
    for (std::size_t i = 0; i < want.size(); ++i)
      EXPECT_LE((testkit::difference<double, double>(got[i].rows->view(), want[i].rows->view()).max_abs), 1e-12)
          << want[i].name;
    for (std::size_t i = 0; i < plain.bench.box.count(); ++i) {
      if (!plain.bench.box.learned(i)) continue;
      const std::string& name = plain.bench.box.specs()[i].name;
      EXPECT_EQ((testkit::compare<double, double>(view_of(saving, name), plain.bench.box.grad(i), 1e-11, 1e-3)), "")
          << name;
    }
  }
}

TEST(Mlp, DropsWhatNobodyNeedsAndNamesTheRest) {
  const Everything<float> field(build_of());
  std::map<std::string, TensorSpec> specs;
  const TensorBox<float> box(field, 1);
  for (const TensorSpec& spec : box.specs()) specs[spec.name] = spec;
  EXPECT_EQ(specs.at("trunk_2/weight").rows, kPosition + kWidth);
  EXPECT_EQ(specs.at("view/weight").rows, 6 + kDirection + kWidth);
  EXPECT_EQ(specs.at("folded/weight").role, TensorRole::derived);
  EXPECT_EQ(specs.at("folded/weight").rows, 3);
  EXPECT_FALSE(specs.contains("unneeded/weight"));
  EXPECT_DOUBLE_EQ(specs.at("view/weight").init.high, 1 / std::sqrt(6.0 + kDirection + kWidth));
  EXPECT_DOUBLE_EQ(specs.at("waves/weight").init.high, 1.0 / (kWidth + kPosition)) << "it reads the samples";
}

// A chain's first sine reads the samples, the others are started for their frequency.
TEST(Mlp, SinesStartAsInTheirPaper) {
  Mlp<float> net({.sample_dims = kPosition}, testkit::mlp_tables(), "test 'mlp'");
  net.output(net.chain({"sine", {net.samples()}, 24, LayerActivation::sine, 30}, 2));
  net.seal();
  const TensorBox<float> box(net, 1);
  EXPECT_DOUBLE_EQ(box.specs()[0].init.high, 1.0 / kPosition);
  EXPECT_DOUBLE_EQ(box.specs()[2].init.high, std::sqrt(6.0 / 24) / 30);
  EXPECT_DOUBLE_EQ(box.specs()[3].init.high, 1 / std::sqrt(24.0));
}

}  // namespace
}  // namespace semfield
