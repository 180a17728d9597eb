// Proposals for the importance sampler.

#include <cstring>

#include "compute/isa.h"
#include "core/non_copyable.h"
#include "execution/lane_executor.h"
#include "model/losses/semantic_cross_entropy.h"
#include "plugins/samplers/importance/importance_kernels.h"
#include "ray_bench.h"
#include "scene/loading/frame_source.h"
#include "tests/analytic_scene.h"

namespace semfield::numerics {

/// What an earlier pass left on one ray: places and weights.
template <class Real>
struct Earlier : NonCopyable {
  Earlier(std::vector<Real> places, std::vector<Real> weights) : t(std::move(places)), weight(std::move(weights)) {
    const auto n = static_cast<std::int64_t>(t.size());
    first = {0, static_cast<std::int32_t>(n)};
    samples = {View<Real>(t.data(), n, 1), View<Real>(t.data(), n, 1), {}, View<std::int32_t>(first.data(), 2, 1), n};
    proposal = {&samples, View<const Real>(weight.data(), n, 1)};
  }
  std::int64_t count() const { return static_cast<std::int64_t>(t.size()); }
  std::vector<Real> t, weight;
  std::vector<std::int32_t> first;
  Samples<Real> samples;
  Proposal<Real> proposal;
};

/// Places in the middle of as many equal bins as there are weights.
template <class Real>
std::vector<Real> bin_middles(double near_m, double far_m, std::size_t bins) {
  std::vector<Real> t;
  for (std::size_t k = 0; k < bins; ++k)
    t.push_back(
        static_cast<Real>(near_m + (far_m - near_m) * (static_cast<double>(k) + 0.5) / static_cast<double>(bins)));
  return t;
}

// Group B: sampling. Here: the inverse CDF, ties and strata.

namespace {

testkit::Settings fresh_only(std::int64_t samples, const std::string& floor = "0.001") {
  return {{"samples", std::to_string(samples)}, {"keep_previous", "false"}, {"floor", floor}};
}

// Draws on one ray from what an earlier pass left there; with jitter from training_step 0 on.
template <class Real>
std::unique_ptr<RayBench<Real>> importance(CaseRun& run, const testkit::Settings& settings, double near_m, double far_m,
                                           const Earlier<Real>& earlier, std::int64_t training_step = -1) {
  auto bench = std::make_unique<RayBench<Real>>(run.registry(), "importance", settings);
  bench->ctx.training = training_step >= 0;
  bench->ctx.step = std::max<std::int64_t>(training_step, 0);
  bench->set_rays(1, near_m, far_m);
  bench->draw(&earlier.proposal, earlier.count());
  return bench;
}

// The inverse CDF in long double: piecewise constant on the cells of the earlier samples, borders midway.
template <class Real>
struct InverseCdf {
  InverseCdf(const Earlier<Real>& earlier, double near_m, double far_m, double floor) {
    const std::size_t n = earlier.t.size();
    long double total = long_double(floor);
    for (const Real w : earlier.weight) total += long_double(w);
    const long double length = long_double(far_m) - long_double(near_m);
    border.push_back(long_double(near_m));
    cdf.push_back(0);
    for (std::size_t k = 0; k < n; ++k) {
      border.push_back(k + 1 == n ? long_double(far_m)
                                  : (long_double(earlier.t[k]) + long_double(earlier.t[k + 1])) / 2);
      const long double mass =
          long_double(earlier.weight[k]) + long_double(floor) * (border[k + 1] - border[k]) / length;
      cdf.push_back(cdf.back() + mass / total);
    }
  }
  std::size_t cell(long double u) const {
    return static_cast<std::size_t>(std::upper_bound(cdf.begin() + 1, cdf.end() - 1, u) - cdf.begin() - 1);
  }
  long double at(long double u) const {
    const std::size_t k = cell(u);
    return border[k] + (u - cdf[k]) / (cdf[k + 1] - cdf[k]) * (border[k + 1] - border[k]);
  }
  // Metres that a rounding of u moves the place.
  double slope(long double u) const {
    const std::size_t k = cell(u);
    return static_cast<double>((border[k + 1] - border[k]) / (cdf[k + 1] - cdf[k]));
  }
  std::vector<long double> border, cdf;
};

// u of sample j, as the sampler documents it: strata of [0, 1), jittered at the address of the sample.
double u_of(const StepContext& ctx, std::int64_t j, std::int64_t n) {
  const double jitter =
      ctx.training ? static_cast<double>(uniform01(ctx.random("sampler/importance"), static_cast<std::uint64_t>(j)))
                   : 0.5;
  return (static_cast<double>(j) + jitter) / static_cast<double>(n);
}

template <class Real>
void measure_inverse(CaseRun& run, const RayBench<Real>& bench, const InverseCdf<Real>& truth, double near_m,
                     double far_m) {
  const auto n = static_cast<std::int64_t>(bench.t.size());
  for (std::int64_t j = 0; j < n; ++j) {
    const double u = u_of(bench.ctx, j, n), got = static_cast<double>(bench.t[j]);
    // The CDF is a sum of doubles: in a cell of little mass its rounding is many metres.
    const double rounding = 64 * 0x1p-53 * truth.slope(long_double(u));
    run.near(got, truth.at(long_double(u)), tolerance_of<Real>(1e-6) * (far_m - near_m) + rounding, "place");
    run.expect(got >= near_m && got <= far_m, "a sample lies between near and far");
  }
}

}  // namespace

IN_BOTH_PRECISIONS(zero_weights) {
  const Earlier<Real> zeros(bin_middles<Real>(1, 5, 13), std::vector<Real>(13, 0)), nothing({}, {});
  for (const Earlier<Real>* earlier : {&zeros, &nothing}) {
    const auto even = importance<Real>(run, fresh_only(64), 1, 5, *earlier);
    run.expect(even->t.size() == 64, "64 samples");
    for (std::size_t j = 0; j < even->t.size(); ++j)
      run.near(even->t[j], 1 + 4 * (static_cast<double>(j) + 0.5) / 64, tolerance_of<Real>(1e-6), "place");
    const auto random = importance<Real>(run, fresh_only(1000), 1, 5, *earlier, 3);
    double distance = 0;  // Kolmogorov-Smirnov
    for (std::size_t j = 0; j < random->t.size(); ++j) {
      const double below = (static_cast<double>(random->t[j]) - 1) / 4;
      distance = std::max({distance, std::abs(below - static_cast<double>(j) / 1000),
                           std::abs(below - static_cast<double>(j + 1) / 1000)});
    }
    run.measure(distance, 1.628 / std::sqrt(1000.0), "Kolmogorov-Smirnov distance, p = 0.01");
    run.measure(distance, 1.0 / 1000 + tolerance_of<Real>(1e-6), "strata are closer than chance");
  }
}

IN_BOTH_PRECISIONS(spike) {
  std::vector<Real> weights(62, 0);
  weights[30] = 1;
  const Earlier<Real> earlier(bin_middles<Real>(0, 62, 62), weights);
  const int n = 20000;
  for (const std::string floor : {"0.01", "0.000000001"}) {
    const double share = std::stod(floor) / (1 + std::stod(floor));
    for (const std::int64_t step : {-1, 0, 1}) {
      const auto bench = importance<Real>(run, fresh_only(n, floor), 0, 62, earlier, step);
      measure_inverse(run, *bench, InverseCdf<Real>(earlier, 0, 62, std::stod(floor)), 0, 62);
      int outside = 0, at_edge = 0;
      for (const Real t : bench->t) {
        outside += t < 30 || t > 31 ? 1 : 0;
        at_edge += std::abs(static_cast<double>(t) - 30) < 1e-3 || std::abs(static_cast<double>(t) - 31) < 1e-3 ? 1 : 0;
      }
      run.measure(outside / double{n}, share + 2.0 / n, "share of samples outside the spike");
      run.measure(at_edge / double{n}, 0.002 + 3.0 / n, "share within 0.2 % of the spike from its edges");
    }
  }
}

IN_BOTH_PRECISIONS(end_spikes) {
  std::vector<Real> weights(16, 0);
  weights.front() = weights.back() = Real(0.5);
  const Earlier<Real> earlier(bin_middles<Real>(0.1, 0.3, 16), weights);
  const InverseCdf<Real> truth(earlier, 0.1, 0.3, 1e-3);
  for (std::int64_t step = -1; step < 100; ++step) {
    const auto bench = importance<Real>(run, fresh_only(128), 0.1, 0.3, earlier, step);
    measure_inverse(run, *bench, truth, 0.1, 0.3);
    int front = 0;
    for (const Real t : bench->t) front += static_cast<double>(t) < 0.2 ? 1 : 0;
    run.near(front, 64, 1, "samples in the first half");
  }
}

IN_BOTH_PRECISIONS(nan_weight) {
  const double infinity = std::numeric_limits<double>::infinity();
  for (const double bad : {std::numeric_limits<double>::quiet_NaN(), -1.0, infinity, -infinity}) {
    const Earlier<Real> earlier(bin_middles<Real>(0, 1, 4), {Real(0.1), Real(0.2), static_cast<Real>(bad), 0});
    const std::vector<Real> places = earlier.t, weights = earlier.weight;
    for (const bool training : {false, true}) {
      run.expect_error(ErrorKind::failure, {"importance", "ray 41", "sample 2", "weight"}, [&] {
        RayBench<Real> bench(run.registry(), "importance", fresh_only(8));
        bench.ctx.training = training;
        bench.ctx.first_ray = 41;
        bench.set_rays(1, 0, 1);
        bench.draw(&earlier.proposal, earlier.count());
      });
    }
    run.expect(places == earlier.t && std::memcmp(weights.data(), earlier.weight.data(), 4 * sizeof(Real)) == 0,
               "what the earlier pass left is as before");
  }
}

void u_edges(CaseRun& run) {
  run.row("float64");  // the walk is in double whatever the samples are
  for (const double below : {0.0, 0.25, 1 - 0x1p-24}) {
    for (const double mass : {0.0, 1e-300, 0x1p-53, 1e-7, 0.5, 1 - 1e-7}) {
      for (const double begin : {0.0, 2.0, 1e6}) {
        for (const double width : {0.0, 1e-12, 1.0}) {
          CdfWalk cell{.below = below, .mass = mass, .begin = begin, .end = begin + width};
          for (const double u : {0.0, 0x1p-24, 0.25, 0.5, 1 - 0x1p-24, 1 - 0x1p-53, 1.0}) {
            cell.is_last = false;
            run.expect(cell.holds(u) == (u < below + mass), "the border of a cell belongs to the next one");
            cell.is_last = true;
            run.expect(cell.holds(u), "the last cell holds every u");
            const double t = cell.point(u);
            run.expect(t >= cell.begin && t <= cell.end, "a place lies inside its cell");
          }
          if (mass > 0) run.near(cell.point(below), begin, 0, "u at the lower border");
        }
      }
    }
  }
  CdfWalk cell{.below = 0.5, .mass = 0.25, .begin = 2, .end = 3};
  for (int i = 0; i <= 100; ++i) {
    const double u = 0.5 + 0.25 * i / 100;
    run.near(cell.point(u), 2 + static_cast<double>(i) / 100, 1e-15, "place in a cell");
  }
}

IN_BOTH_PRECISIONS(cdf_end) {
  constexpr std::size_t kBins = 4096;
  TestNumbers random{6};
  for (const int kind : {0, 1, 2}) {
    std::vector<Real> weights(kBins);
    // Weights whose sums round: 0.1, random, and some that add up to next to nothing.
    for (auto& w : weights) w = static_cast<Real>(kind == 0 ? 0.1 : kind == 1 ? random.uniform() : 1e-30);
    const Earlier<Real> earlier(bin_middles<Real>(0, 1, kBins), weights);
    const InverseCdf<Real> truth(earlier, 0, 1, 1e-3);
    run.near(truth.cdf.back(), 1, 1e-15, "the reference ends at 1");
    for (const std::int64_t step : {-1, 0, 1, 2}) {
      const auto bench = importance<Real>(run, fresh_only(2 * kBins), 0, 1, earlier, step);
      measure_inverse(run, *bench, truth, 0, 1);
      run.expect(bench->t.back() > Real(1 - 2.0 / kBins), "the last sample is in the last cells");
      run.expect(std::is_sorted(bench->t.begin(), bench->t.end()), "places ascend");
      if (kind != 0) continue;
      std::vector<int> in_bin(kBins);
      for (const Real t : bench->t)
        ++in_bin[std::min(kBins - 1, static_cast<std::size_t>(static_cast<double>(t) * kBins))];
      const auto [least, most] = std::minmax_element(in_bin.begin(), in_bin.end());
      run.expect(*least >= 1 && *most <= 3, "two samples per bin, one more or less at its borders");
    }
  }
}

IN_BOTH_PRECISIONS(ties) {
  // Three samples at 2 m: the cell of the middle one has no width, and most of the weight.
  const Earlier<Real> earlier({1, 2, 2, 2, 3, Real(3.5)}, {Real(0.01), Real(0.2), Real(0.5), Real(0.2), 0, 0});
  for (const std::string rule : {"paper", "midpoint", "stratified_bin"}) {
    for (const std::int64_t step : {-1, 0, 1}) {
      testkit::Settings settings{{"samples", "40"}, {"quadrature", rule}};
      const auto both = importance<Real>(run, settings, 0.5, 4, earlier, step);
      settings["keep_previous"] = "false";
      const auto fresh = importance<Real>(run, settings, 0.5, 4, earlier, step);
      std::vector<Real> merged(earlier.t.size() + fresh->t.size());
      std::merge(earlier.t.begin(), earlier.t.end(), fresh->t.begin(), fresh->t.end(), merged.begin());
      run.expect(both->t == merged, "the union is the stable merge, bit by bit");
      const auto at_two = std::count(merged.begin(), merged.end(), Real(2));
      run.expect(at_two > 10, "many samples lie at 2 m");
      double covered = 0;
      for (const Real d : both->delta) {
        run.expect(d >= 0 && std::isfinite(d), "intervals are not negative");
        covered += static_cast<double>(d);
      }
      const double from = rule == "paper" ? static_cast<double>(both->t[0]) : 0.5;
      run.near(covered, 4 - from, tolerance_of<Real>(1e-6), "intervals cover the ray");
      RayBuffers<Real> rays = both->buffers();
      render(rays, [](double) { return std::pair(3.0, 1.0); });
      rays.g_color = {1, 1, 1};
      rays.g_depth = rays.g_opacity = {1};
      rays.backward();
      std::int64_t none = 0;
      for (std::size_t k = 0; k < rays.t.size(); ++k) {
        run.expect(std::isfinite(rays.d_sigma[k]), "gradients are finite");
        if (rays.delta[k] != 0) continue;
        ++none;
        run.measure(std::abs(rays.weight[k]), 0, "weight of an interval without length");
        run.measure(std::abs(rays.d_sigma[k]), 0, "its gradient");
      }
      run.expect(none >= at_two - 2, "ties have intervals without length");
      run.relative(rays.opacity[0], -std::expm1(-3 * long_double(covered)), tolerance_of<Real>(2e-6),
                   "opacity of the union");
    }
  }
  run.note("instruction set " + std::string(isa_name(isa())) + "; the tests run each in turn");
}

IN_BOTH_PRECISIONS(dynamic_range) {
  std::vector<Real> weights;
  for (int k = 0; k < 40; ++k) weights.push_back(static_cast<Real>(std::pow(10.0, -8 + 8.0 * ((k * 17) % 40) / 39)));
  const Earlier<Real> earlier(bin_middles<Real>(2, 10, 40), weights);
  for (const std::string floor : {"0.001", "0.000000001"}) {
    const InverseCdf<Real> truth(earlier, 2, 10, std::stod(floor));
    for (std::int64_t step = -1; step < 20; ++step)
      measure_inverse(run, *importance<Real>(run, fresh_only(500, floor), 2, 10, earlier, step), truth, 2, 10);
  }
}

namespace {

// Known answers of Philox4x32-10: counter and key of zeros, of ones, and of the digits of pi [Salmon11].
void measure_philox(CaseRun& run) {
  struct Known {
    PhiloxBlock counter;
    std::uint32_t key0, key1;
    PhiloxBlock answer;
  };
  constexpr std::uint32_t kOnes = 0xFFFFFFFFU;
  const Known known[] = {
      {{{0, 0, 0, 0}}, 0, 0, {{0x6627e8d5U, 0xe169c58dU, 0xbc57ac4cU, 0x9b00dbd8U}}},
      {{{kOnes, kOnes, kOnes, kOnes}}, kOnes, kOnes, {{0x408f276dU, 0x41c83b0eU, 0xa20bc7c6U, 0x6d5451fdU}}},
      {{{0x243f6a88U, 0x85a308d3U, 0x13198a2eU, 0x03707344U}},
       0xa4093822U,
       0x299f31d0U,
       {{0xd16cfe09U, 0x94fdccebU, 0x5001e420U, 0x24126ea1U}}},
  };
  for (const Known& one : known) {
    const PhiloxBlock got = philox4x32(one.counter, one.key0, one.key1);
    run.expect(std::memcmp(got.v, one.answer.v, sizeof got.v) == 0, "Philox4x32-10 gives its known answer");
  }
}

}  // namespace

IN_BOTH_PRECISIONS(strata) {
  measure_philox(run);
  constexpr std::int64_t kBins = 64;
  for (const std::string rule : {"paper", "stratified_bin"}) {
    RayBench<Real> bench(run.registry(), "stratified", {{"samples", "64"}, {"quadrature", rule}});
    bench.ctx.training = true;
    bench.set_rays({0.1, 6, 2, 3, 1e-3, 1e3});
    for (std::int64_t step = 0; step < 50; ++step) {
      bench.ctx.step = step;
      bench.ctx.first_ray = 1000 * step;
      bench.draw();
      run.expect(bench.out.count == 3 * kBins, "one sample per bin");
      for (std::int64_t i = 0; i < 3 * kBins; ++i) {
        const std::int64_t r = i / kBins, k = i % kBins;
        const double near_m = bench.near_far[2 * r];
        const double length = bench.near_far[2 * r + 1] - near_m;
        const auto address = static_cast<std::uint64_t>((bench.ctx.first_ray + r) * kBins + k);
        const auto u = static_cast<double>(uniform01(bench.ctx.random("sampler/stratified"), address));
        // This file is compiled for the weakest instruction set: whatever the kernel runs on, the bits are these.
        const double place = near_m + length * ((static_cast<double>(k) + u) / kBins);
        const Real got = bench.t[i];
        run.expect(got == static_cast<Real>(place), "the place has the bits of near + (far - near) (k + u) / N");
        const auto low = static_cast<Real>(near_m + length * (static_cast<double>(k) / kBins));
        const auto high = static_cast<Real>(near_m + length * (static_cast<double>(k + 1) / kBins));
        run.expect(got >= low && got <= high, "it lies in its bin");
      }
    }
  }
  run.note("instruction set " + std::string(isa_name(isa())) + "; the tests run each in turn");
}

// Group B: limits of rays, very long ways, and nothing at all.

namespace {

constexpr const char* kSamplers[] = {"stratified", "importance", "occupancy_grid"};

testkit::Settings settings_of(const std::string& sampler) {
  if (sampler == "occupancy_grid") return {{"resolution", "32"}, {"max_samples", "64"}};
  return {{"samples", "8"}};
}

// Samples of rays with these limits; a sampler that wants an earlier pass gets one that left nothing.
template <class Real>
std::unique_ptr<RayBench<Real>> drawn(CaseRun& run, const std::string& sampler, const std::vector<double>& limits,
                                      std::int64_t first_ray = 0) {
  auto bench = std::make_unique<RayBench<Real>>(run.registry(), sampler, settings_of(sampler));
  bench->ctx.first_ray = first_ray;
  bench->set_rays(limits);
  std::vector<std::int32_t> first(static_cast<std::size_t>(bench->count + 1), 0);
  Real none = 0;
  Samples<Real> samples{
      View<Real>(&none, 0, 1), View<Real>(&none, 0, 1), {}, View<std::int32_t>(first.data(), bench->count + 1, 1), 0};
  const Proposal<Real> proposal{&samples, View<const Real>(&none, 0, 1)};
  bench->draw(sampler == "importance" ? &proposal : nullptr, 0);
  return bench;
}

std::string errors_of(const SceneLoadOptions& options) {
  Diagnostics diagnostics;
  const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene({4, 16, 12});
  load_scene(*scene, options, diagnostics);
  std::string text;
  for (const Diagnostic& found : diagnostics.all()) text += found.text() + "\n";
  return diagnostics.has_errors() ? text : "";
}

}  // namespace

void bounds(CaseRun& run) {
  const double infinity = std::numeric_limits<double>::infinity(), nan = std::numeric_limits<double>::quiet_NaN();
  in_both_precisions(run, [&]<class Real>(Real) {
    for (const std::string sampler : kSamplers) {
      const auto bench = drawn<Real>(run, sampler, {1, 1, 3, 2, 0, 1, 0, 0, 0, 1e-300});
      run.expect(bench->first[1] == 0 && bench->first[2] == 0, "near = far and near > far are empty rays: " + sampler);
      run.expect(bench->first[3] > 0, "near = 0 has samples: " + sampler);
      run.expect(bench->first[4] == bench->first[3], "near = far = 0 is an empty ray: " + sampler);
      for (std::int32_t k = 0; k < bench->first[3]; ++k) {
        const auto t = static_cast<double>(bench->t[k]);
        run.expect(t >= 0 && t <= 1, "samples from near = 0 lie inside: " + sampler);
      }
      for (const Real d : bench->delta) run.expect(d >= 0 && std::isfinite(d), "intervals are finite: " + sampler);
      for (const std::pair<double, double>& limits :
           {std::pair(0.0, infinity), {-infinity, 1.0}, {0.0, nan}, {nan, 1.0}, {infinity, infinity}}) {
        run.expect_error(ErrorKind::data, {"ray 41", "finite"}, [&] {
          drawn<Real>(run, sampler, {0, 1, limits.first, limits.second}, 40);
        });
      }
    }
  });
  run.row("-");
  const auto expect_refused = [&](double near_m, double far_m, const std::string& word) {
    SceneLoadOptions options{.near_m = near_m, .far_m = far_m};
    const std::string text = errors_of(options);
    run.expect(text.find(word) != std::string::npos,
               "near " + figure(near_m) + ", far " + figure(far_m) + " is refused with '" + word + "': " + text);
  };
  SceneLoadOptions derived;
  run.expect(errors_of(derived).empty(), "near and far of the scene are good");
  expect_refused(3, 2, "near_m must be below far_m");
  expect_refused(2, 2, "near_m must be below far_m");
  expect_refused(1000, 0, "scene.load.near_m");  // far comes from the depth of the scene and is nearer
  expect_refused(0.5, 1e-3, "near_m must be below far_m");
  run.note("no sampler divides by a distance: near = 0 is an ordinary limit");
}

IN_BOTH_PRECISIONS(stall) {
  constexpr double kUlp = std::is_same_v<Real, float> ? 0x1p-23 : 0x1p-52;
  struct Way {
    double from, to, step_m;  // the grid's box along x
  };
  // Steps below the spacing of fp32 at 1e5 m; 2e10 steps; a box of 1e7 m that starts at the origin.
  for (const Way& way :
       {Way{1e5 - 1, 1e5 + 1, 1e-3}, Way{-1e7, 1e7, 1e-3}, Way{0, 1e7, 1e-3}, Way{1e7 - 1, 1e7, 1e-6}}) {
    constexpr std::int64_t kMost = 4096;
    SamplerBuild build = unit_build();
    build.bounds = {{way.from, -1, -1}, {way.to, 1, 1}};
    RayBench<Real> bench(run.registry(), "occupancy_grid",
                         {{"resolution", "32"}, {"max_samples", std::to_string(kMost)}, {"step_m", figure(way.step_m)}},
                         build);
    for (const bool training : {false, true}) {
      bench.ctx.training = training;
      bench.set_rays(1, 0, 1e7);
      bench.draw();
      const std::int64_t n = bench.out.count;
      run.expect(n > 0 && n <= kMost, "the march ends with at most max_samples samples");
      // What the ray has of the box, whose sides are padded by 1 % of the longest.
      const double pad = 0.01 * std::max(2.0, way.to - way.from), begin = std::max(0.0, way.from - pad),
                   end = std::min(1e7, way.to + pad);
      const double wanted = std::ceil((end - begin) / way.step_m);
      run.expect(static_cast<double>(n) >= std::min(wanted, kMost / 2.0) - 1,
                 "no fewer than it needs, or half the most");
      double covered = 0;
      for (const Real d : bench.delta) covered += static_cast<double>(d);
      run.near(covered / (end - begin), 1, 1e-9 + 4 * kUlp * end / (end - begin), "intervals cover the ray");
      const long double step = (long_double(end) - long_double(begin)) / long_double(n);
      const double jitter =
          training ? static_cast<double>(uniform01(bench.ctx.random("sampler/occupancy_grid"), 0)) : 0.5;
      for (std::int64_t i = 0; i < n; ++i) {
        const long double place = long_double(begin) + (long_double(i) + long_double(jitter)) * step;
        const auto t = long_double(bench.t[i]);
        run.near(t, place, 4 * kUlp * end, "place");
        run.expect(i == 0 || bench.t[i] >= bench.t[i - 1], "places ascend");
      }
      if (static_cast<double>(n) < wanted)
        run.expect(static_cast<double>(bench.delta[0]) > 1.5 * way.step_m, "longer steps stand in their intervals");
    }
  }
  RayBench<Real> even(run.registry(), "stratified", {{"samples", "1024"}});
  even.set_rays({1e5, 1e5 + 1e-3, 0, 1e7, 1e7 - 1, 1e7});
  even.draw();
  for (std::size_t i = 0; i < even.t.size(); ++i) {
    const std::size_t r = i / 1024;
    const double near_m = even.near_far[2 * r], length = even.near_far[2 * r + 1] - near_m;
    const double place = near_m + length * (static_cast<double>(i % 1024) + 0.5) / 1024;
    run.near(even.t[i], place, kUlp * (near_m + length), "place on a long ray");
    run.expect(even.delta[i] > 0 || std::is_same_v<Real, float>, "intervals have length");
  }
  run.note("a ray that needs more than max_samples takes longer steps over its whole length: its intervals say so");
}

namespace {

template <class Real>
std::unique_ptr<Pipeline<Real>> pipeline(const Registry& registry, bool learned_encoding) {
  PipelineOptions options{.rules = {.rendering = {.background = {0.5, 0.5, 0.5}, .early_stop = 0}}, .lanes = 2};
  std::vector<PassParts<Real>> passes;
  passes.push_back(learned_encoding
                       ? small_pass<Real>(registry, "8", "hash_grid",
                                          {{"levels", "2"}, {"log2_entries", "10"}, {"finest_resolution", "32"}},
                                          {{0, 0, 0}, 0.05, 0.5})
                       : small_pass<Real>(registry, "8"));
  return std::make_unique<Pipeline<Real>>(std::move(passes), options, true);
}

// A batch of `rays` rays with these limits and no label.
struct Batch {
  Batch(std::int64_t rays, double near_m, double far_m)
      : count(rays),
        direction(3 * static_cast<std::size_t>(rays), 0.0),
        target(direction.size(), 0.25F),
        label(static_cast<std::size_t>(rays), kVoid) {
    for (std::size_t r = 0; r < label.size(); ++r) {
      direction[3 * r] = 1;
      near_far.insert(near_far.end(), {near_m, far_m});
    }
    origin.assign(direction.size(), 0.0);
    if (rays == 0) origin = near_far = direction = {0}, target = {0}, label = {kVoid};  // an address without rows
  }
  RayBatch view() const {
    return RayBatch{.origin = {origin.data(), count, 3},
                    .direction = {direction.data(), count, 3},
                    .near_far = {near_far.data(), count, 2},
                    .targets = {.color = {target.data(), count, 3}, .label = {label.data(), count, 1}}};
  }
  std::int64_t count;
  std::vector<double> origin, direction, near_far;
  std::vector<float> target;
  std::vector<std::int16_t> label;
};

}  // namespace

IN_BOTH_PRECISIONS(empty_batch) {
  for (const std::string sampler : kSamplers) {
    const auto none = drawn<Real>(run, sampler, {});
    run.expect(none->out.count == 0 && none->first[0] == 0, "no rays, no samples: " + sampler);
  }
  RayBuffers<Real> no_rays({}, 2), no_samples({0, 0}, 2);
  no_samples.background = {0.25, 0.5, 1};
  for (auto* rays : {&no_rays, &no_samples}) {
    rays->forward();
    rays->backward();
  }
  run.near(no_samples.color[2], 1, 0, "a ray without samples shows the background");
  run.measure(std::abs(no_samples.opacity[1]), 0, "its opacity");
  Real nothing = 0;
  const float no_target = 0;
  const std::int16_t no_label = kVoid;
  run.measure(photometric_loss<Real>(View<const Real>(&nothing, 0, 3), View<const float>(&no_target, 0, 3), 1, 1, {}),
              0, "colour loss");
  SemanticTargets targets{.hard = {&no_label, 0, 1}};
  run.measure(semantic_cross_entropy<Real>(View<const Real>(&nothing, 0, 5), targets, {}, 0, 1, {}).sum, 0,
              "semantic loss");
  for (const bool learned_encoding : {false, true}) {
    const auto model = pipeline<Real>(run.registry(), learned_encoding);
    const auto largest_gradient = [&] {
      double largest = 0;
      for (const Tensor<Real>& tensor : model->store().all()) {
        for (std::size_t i = 0; i < tensor.grad.size(); ++i)
          largest = std::max<double>(largest, std::abs(tensor.grad.data()[i]));
      }
      return largest;
    };
    const StepLosses none = model->lanes().gradients(0, Batch(0, 0, 0).view());
    for (const double loss : {none.total, none.color, none.semantic, none.mse}) run.measure(loss, 0, "loss of no rays");
    run.measure(largest_gradient(), 0, "its gradient");
    const StepLosses dark = model->lanes().gradients(1, Batch(20, 1, 1).view());
    run.near(dark.color, 0.0625, 1e-15, "loss of rays that see the background alone");
    run.measure(std::abs(dark.semantic), 0, "semantic loss without labels");
    run.measure(largest_gradient(), 0, "gradient of rays without samples");
    run.expect(dark.samples == 0, "rays without samples have none");
    RenderJob<Real> job;
    const Batch empty(0, 0, 0), rays(3, 2, 2);
    job.origin = empty.view().origin;
    job.direction = empty.view().direction;
    job.near_far = empty.view().near_far;
    model->executor().render(job);
    std::vector<Real> color(9, -1), opacity(3, -1);
    job.origin = rays.view().origin;
    job.direction = rays.view().direction;
    job.near_far = rays.view().near_far;
    job.color = {color.data(), 3, 3};
    job.opacity = {opacity.data(), 3, 1};
    model->executor().render(job);
    for (const Real c : color) run.near(c, 0.5, 0, "rendered background");
    for (const Real o : opacity) run.measure(std::abs(o), 0, "rendered opacity");
  }
}

}  // namespace semfield::numerics
