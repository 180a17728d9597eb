// Networks of layers: an independent forward, central differences, the savings, every precision, costs, memory.
#include <gtest/gtest.h>

#include <algorithm>
#include <utility>

#include "core/rng.h"
#include "testkit/compare.h"
#include "tests/plain_network.h"

namespace semfield {
namespace {

using testkit::TensorBox;

constexpr std::int32_t kIn = 5, kRay = 3, kWidth = 32;
constexpr std::int64_t kRays = 4;

MlpBuild build_of(bool fold = true, bool rays_once = true, Precision precision = Precision::fp32,
                  Device device = Device::cpu) {
  return {device, precision, kIn, kRay, fold, rays_once};
}

/// Every kind of layer: a chain with a skip, a sine of two inputs, columns that are read and an output, two linear
/// layers with nothing between them, a ray input, a sigmoid, an output that is read on, and a layer that nobody needs.
template <class Real>
Mlp<Real> everything(const MlpBuild& build, const KernelTables& tables) {
  using enum LayerActivation;
  Mlp<Real> net(build, tables, "test 'mlp'");
  const Rows h = net.chain({"trunk", {net.samples()}, kWidth}, 3, 2);
  const Rows waves = net.layer({"waves", {h, net.samples()}, kWidth, sine, 3});
  const Rows geometry = net.layer({"geometry", {waves}, 4, none});
  net.layer({"unneeded", {waves}, 7});
  const Rows linear = net.layer({"linear", {geometry.columns(1, 3)}, 6, none});
  const Rows view = net.layer({"view", {linear, net.rays(), h}, kWidth});
  net.output(geometry.columns(0, 1));
  net.output(net.layer({"color", {view}, 3, sigmoid}));
  net.output(h);
  net.seal();
  return net;
}
constexpr std::int32_t kOut[] = {1, 3, kWidth};

template <class Real>
struct Bench {
  explicit Bench(const MlpBuild& build, std::int64_t samples = 37)
      : net(everything<Real>(build, testkit::mlp_tables())), box(net, 1), count(samples) {
    const RandomAddress address{7, 0, 0};
    std::uint64_t index = 0;
    const auto fill = [&](std::vector<Real>& to, std::int64_t size) {
      for (std::int64_t i = 0; i < size; ++i)
        to.push_back(static_cast<Real>(static_cast<float>(2 * uniform01(address, index++) - 1)));
    };
    fill(x, samples * kIn);
    fill(rays, kRays * kRay);
    for (std::int64_t m = 0; m < samples; ++m) ray_of.push_back(static_cast<std::int32_t>(m * kRays / samples));
    for (int k = 0; k < 3; ++k) {
      fill(weight[k], samples * kOut[k]);
      out[k].resize(static_cast<std::size_t>(samples * kOut[k]));
    }
    dx.resize(x.size());
    saved.resize(net.saved_bytes(samples) + 64);
  }
  MlpIn<Real> in() const { return {{x.data(), count, kIn}, {rays.data(), kRays, kRay}, {ray_of.data(), count, 1}}; }
  std::vector<MlpOut<Real>> outs(unsigned wanted = 7) {
    std::vector<MlpOut<Real>> list(3);
    for (unsigned k = 0; k < 3; ++k) {
      if ((wanted >> k & 1) != 0) list[k].rows = {out[k].data(), count, kOut[k]};
    }
    return list;
  }
  Saved memory() {
    const auto at = reinterpret_cast<std::uintptr_t>(saved.data());
    return Saved(saved.data() + (64 - at % 64) % 64, net.saved_bytes(count));
  }
  void forward(unsigned wanted = 7, bool keeps = true) {
    net.derive({}, box.tensors());
    net.forward(arena, box.tensors(), in(), outs(wanted), keeps ? memory() : Saved());
  }
  void backward(unsigned wanted = 7) {
    std::vector<MlpGrad<Real>> grad(3);
    for (unsigned k = 0; k < 3; ++k) {
      if ((wanted >> k & 1) != 0) grad[k].rows = {weight[k].data(), count, kOut[k]};
    }
    net.backward(arena, box.tensors(), in(), outs(), grad, memory(), {dx.data(), count, kIn});
    net.derive_backward({}, box.tensors());
  }
  double loss(unsigned wanted = 7) {
    forward();
    double sum = 0;
    for (unsigned k = 0; k < 3; ++k) {
      for (std::size_t i = 0; i < out[k].size() && (wanted >> k & 1) != 0; ++i)
        sum += static_cast<double>(out[k][i]) * static_cast<double>(weight[k][i]);
    }
    return sum;
  }
  View<Real> learned(const std::string& name, bool grad = false) const {
    for (std::size_t i = 0; i < box.count(); ++i) {
      if (box.specs()[i].name == name) return grad ? box.grad(i) : box.value(i);
    }
    ADD_FAILURE() << "no tensor " << name;
    return {};
  }

  Mlp<Real> net;
  TensorBox<Real> box;
  std::int64_t count;
  Workspace arena;
  std::vector<Real> x, rays, dx, out[3], weight[3];
  std::vector<std::int32_t> ray_of;
  std::vector<std::byte> saved;
};

using Row = std::vector<double>;

Row joined(const Row& a, const Row& b) {
  Row all = a;
  all.insert(all.end(), b.begin(), b.end());
  return all;
}

TEST(Mlp, IsTheFormulas) {
  Bench<double> bench(build_of());
  bench.forward();
  const auto layer = [&](const std::string& name, const Row& from, bool relu = false) {
    const View<const double> w = bench.learned(name + "/weight"), b = bench.learned(name + "/bias");
    EXPECT_EQ(w.rows, std::ssize(from)) << name;
    return testkit::plain_layer(from, w, b, relu);
  };
  const auto each = [](Row row, auto f) {
    for (double& value : row) value = f(value);
    return row;
  };
  for (std::int64_t m = 0; m < bench.count; ++m) {
    const double* at = bench.x.data() + m * kIn;
    const Row x(at, at + kIn);
    const double* ray = bench.rays.data() + bench.ray_of[m] * kRay;
    const Row h = layer("trunk_2", joined(x, layer("trunk_1", layer("trunk_0", x, true), true)), true);
    const Row waves = each(layer("waves", joined(h, x)), [](double z) { return std::sin(3 * z); });
    const Row geometry = layer("geometry", waves);
    const Row linear = layer("linear", {geometry[1], geometry[2], geometry[3]});
    const Row view = layer("view", joined(joined(linear, Row(ray, ray + kRay)), h), true);
    const Row color = each(layer("color", view), [](double z) { return 1 / (1 + std::exp(-z)); });
    EXPECT_NEAR(bench.out[0][m], geometry[0], 1e-12);
    for (std::size_t c = 0; c < 3; ++c) EXPECT_NEAR(bench.out[1][static_cast<std::size_t>(m) * 3 + c], color[c], 1e-12);
    for (std::size_t c = 0; c < h.size(); ++c)
      EXPECT_NEAR(bench.out[2][static_cast<std::size_t>(m) * h.size() + c], h[c], 1e-12);
  }
}

// Of every tensor and of the samples, for every set of outputs that have a gradient.
TEST(Mlp, GradientsAreCentralDifferences) {
  for (const bool fold : {true, false}) {
    for (const unsigned wanted : {7u, 1u, 2u, 4u, 5u, 6u}) {
      SCOPED_TRACE("fold " + std::to_string(fold) + ", outputs " + std::to_string(wanted));
      Bench<double> bench(build_of(fold, fold), 19);
      bench.forward();
      bench.backward(wanted);
      const auto loss = [&] { return bench.loss(wanted); };
      const testkit::GradientCheck check{.max_elements = 8};
      EXPECT_EQ(check_gradient(loss, {bench.x.data(), bench.count, kIn}, {bench.dx.data(), bench.count, kIn}, check),
                "");
      for (std::size_t i = 0; i < bench.box.count(); ++i) {
        if (!bench.box.learned(i)) continue;
        EXPECT_EQ(check_gradient(loss, bench.box.value(i), bench.box.grad(i), check), "") << bench.box.specs()[i].name;
      }
    }
  }
}

TEST(Mlp, NoGradientIsZeroAndTensorsAreAddedTo) {
  Bench<double> bench(build_of());
  bench.forward();
  bench.dx.assign(bench.dx.size(), 3.0);
  bench.backward(0);
  for (const double d : bench.dx) EXPECT_EQ(d, 0.0);
  EXPECT_EQ(bench.learned("waves/weight", true)(0, 0), 0.0);
  bench.backward();
  const double once = bench.learned("waves/weight", true)(0, 0), dx = bench.dx[0];
  EXPECT_NE(once, 0.0);
  bench.backward();
  EXPECT_DOUBLE_EQ(bench.learned("waves/weight", true)(0, 0), 2 * once);
  EXPECT_EQ(bench.dx[0], dx);
}

TEST(Mlp, TheSavingsChangeNoNumber) {
  Bench<double> plain(build_of(false, false));
  plain.forward();
  plain.backward();
  for (const auto& [fold, once] : {std::pair{true, false}, {false, true}, {true, true}}) {
    Bench<double> saving(build_of(fold, once));
    saving.forward();
    saving.backward();
    for (int k = 0; k < 3; ++k) {
      for (std::size_t i = 0; i < plain.out[k].size(); ++i) EXPECT_NEAR(saving.out[k][i], plain.out[k][i], 1e-12);
    }
    for (std::size_t i = 0; i < plain.box.count(); ++i) {
      if (!plain.box.learned(i)) continue;
      const std::string& name = plain.box.specs()[i].name;
      EXPECT_EQ((testkit::compare<double, double>(saving.learned(name, true), plain.box.grad(i), 1e-11, 1e-3)), "")
          << name;
    }
  }
}

template <class Real>
void expect_near_double(const MlpBuild& build, double tolerance) {
  MlpBuild oracle = build;
  oracle.precision = Precision::fp32;
  Bench<Real> bench(build);
  Bench<double> exact(oracle);
  bench.forward();
  bench.backward();
  exact.forward();
  exact.backward();
  const auto near = [&](const std::string& what, View<const Real> got, View<const double> want) {
    EXPECT_EQ((testkit::compare_norms<Real, double>(got, want, tolerance)), "") << what;
  };
  for (int k = 0; k < 3; ++k)
    near("output " + std::to_string(k), {bench.out[k].data(), bench.count, kOut[k]},
         {exact.out[k].data(), exact.count, kOut[k]});
  near("d_samples", {bench.dx.data(), bench.count, kIn}, {exact.dx.data(), exact.count, kIn});
  for (std::size_t i = 0; i < exact.box.count(); ++i) {
    const std::string& name = exact.box.specs()[i].name;
    if (exact.box.learned(i)) near(name, bench.learned(name, true), exact.learned(name, true));
  }
}

TEST(Mlp, FloatIsNearDouble) {
  expect_near_double<float>(build_of(), 1e-5);
  expect_near_double<float>(build_of(false, false), 1e-5);
}
TEST(Mlp, Bf16IsNearDouble) {
  expect_near_double<float>(build_of(true, true, Precision::bf16), 0.12);
  expect_near_double<float>(build_of(false, false, Precision::bf16), 0.12);
}

// What is not wanted changes nothing else, and neither does memory that nobody keeps.
TEST(Mlp, TheSameBitsWhateverIsWantedAndKept) {
  for (const Precision precision : {Precision::fp32, Precision::bf16}) {
    Bench<float> whole(build_of(true, true, precision));
    whole.forward();
    for (const unsigned wanted : {1u, 2u, 3u, 4u, 5u, 6u, 7u}) {
      for (const bool keeps : {true, false}) {
        Bench<float> part(build_of(true, true, precision));
        part.forward(wanted, keeps);
        for (unsigned k = 0; k < 3; ++k) {
          if ((wanted >> k & 1) == 0) continue;
          EXPECT_EQ(part.out[k], whole.out[k]) << "output " << k << " of " << wanted << ", kept " << keeps;
        }
      }
    }
  }
}

TEST(Mlp, TakesWhatItSays) {
  for (const Precision precision : {Precision::fp32, Precision::bf16}) {
    for (const std::int64_t samples : {1, 37, 300}) {
      Bench<float> bench(build_of(false, false, precision), samples);
      bench.forward();
      bench.backward();
      EXPECT_EQ(bench.arena.high_water_bytes(), bench.net.scratch_bytes(samples, kRays));
      Bench<float> unsaved(build_of(false, false, precision), samples);
      unsaved.forward(7, false);
      EXPECT_LE(unsaved.arena.high_water_bytes(),
                bench.net.scratch_bytes(samples, kRays) + bench.net.saved_bytes(samples));
    }
  }
}

TEST(Mlp, DropsWhatNobodyNeedsAndNamesTheRest) {
  const Mlp<float> net = everything<float>(build_of(), testkit::mlp_tables());
  EXPECT_EQ(net.find("unneeded"), nullptr);
  std::map<std::string, TensorSpec> specs;
  const TensorBox<float> box(net, 1);
  for (const TensorSpec& spec : box.specs()) specs[spec.name] = spec;
  EXPECT_EQ(specs.at("trunk_2/weight").rows, kIn + kWidth);
  EXPECT_EQ(specs.at("view/weight").rows, 6 + kRay + kWidth);
  EXPECT_EQ(specs.at("folded/weight").role, TensorRole::derived);
  EXPECT_EQ(specs.at("folded/weight").rows, 3);
  EXPECT_FALSE(specs.contains("unneeded/weight"));
  EXPECT_DOUBLE_EQ(specs.at("view/weight").init.high, 1 / std::sqrt(6.0 + kRay + kWidth));
  EXPECT_DOUBLE_EQ(specs.at("waves/weight").init.high, 1.0 / (kWidth + kIn)) << "it reads the samples";
}

// A chain's first sine reads the samples, the others are started for their frequency.
TEST(Mlp, SinesStartAsInTheirPaper) {
  Mlp<float> net(build_of(), testkit::mlp_tables(), "test 'mlp'");
  net.output(net.chain({"sine", {net.samples()}, 24, LayerActivation::sine, 30}, 2));
  net.seal();
  const TensorBox<float> box(net, 1);
  EXPECT_DOUBLE_EQ(box.specs()[0].init.high, 1.0 / kIn);
  EXPECT_DOUBLE_EQ(box.specs()[2].init.high, std::sqrt(6.0 / 24) / 30);
  EXPECT_DOUBLE_EQ(box.specs()[3].init.high, 1 / std::sqrt(24.0));
}

}  // namespace
}  // namespace semfield
