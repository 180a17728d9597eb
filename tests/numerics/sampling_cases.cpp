// Group B: sampling. Here: the inverse CDF, ties and strata.
#include "sampling_cases.h"

#include <cstring>

#include "compute/isa.h"
#include "plugins/samplers/importance/importance_kernels.h"

namespace semfield::numerics {

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
    long double total = static_cast<long double>(floor);
    for (const Real w : earlier.weight) total += static_cast<long double>(w);
    const long double length = static_cast<long double>(far_m) - static_cast<long double>(near_m);
    border.push_back(static_cast<long double>(near_m));
    cdf.push_back(0);
    for (std::size_t k = 0; k < n; ++k) {
      border.push_back(k + 1 == n
                           ? static_cast<long double>(far_m)
                           : (static_cast<long double>(earlier.t[k]) + static_cast<long double>(earlier.t[k + 1])) / 2);
      const long double mass = static_cast<long double>(earlier.weight[k]) +
                               static_cast<long double>(floor) * (border[k + 1] - border[k]) / length;
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
    const double rounding = 64 * 0x1p-53 * truth.slope(static_cast<long double>(u));
    run.measure(std::abs(got - static_cast<double>(truth.at(static_cast<long double>(u)))),
                tolerance_of<Real>(1e-6) * (far_m - near_m) + rounding, "place");
    run.expect(got >= near_m && got <= far_m, "a sample lies between near and far");
  }
}

}  // namespace

void zero_weights(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const Earlier<Real> zeros(bin_middles<Real>(1, 5, 13), std::vector<Real>(13, 0)), nothing({}, {});
    for (const Earlier<Real>* earlier : {&zeros, &nothing}) {
      const auto even = importance<Real>(run, fresh_only(64), 1, 5, *earlier);
      run.expect(even->t.size() == 64, "64 samples");
      for (std::size_t j = 0; j < even->t.size(); ++j)
        run.measure(std::abs(static_cast<double>(even->t[j]) - (1 + 4 * (static_cast<double>(j) + 0.5) / 64)),
                    tolerance_of<Real>(1e-6), "place");
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
  });
}

void spike(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
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
          at_edge +=
              std::abs(static_cast<double>(t) - 30) < 1e-3 || std::abs(static_cast<double>(t) - 31) < 1e-3 ? 1 : 0;
        }
        run.measure(outside / double{n}, share + 2.0 / n, "share of samples outside the spike");
        run.measure(at_edge / double{n}, 0.002 + 3.0 / n, "share within 0.2 % of the spike from its edges");
      }
    }
  });
}

void end_spikes(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    std::vector<Real> weights(16, 0);
    weights.front() = weights.back() = Real(0.5);
    const Earlier<Real> earlier(bin_middles<Real>(0.1, 0.3, 16), weights);
    const InverseCdf<Real> truth(earlier, 0.1, 0.3, 1e-3);
    for (std::int64_t step = -1; step < 100; ++step) {
      const auto bench = importance<Real>(run, fresh_only(128), 0.1, 0.3, earlier, step);
      measure_inverse(run, *bench, truth, 0.1, 0.3);
      int front = 0;
      for (const Real t : bench->t) front += static_cast<double>(t) < 0.2 ? 1 : 0;
      run.measure(std::abs(front - 64), 1, "samples in the first half");
    }
  });
}

void nan_weight(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
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
  });
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
          if (mass > 0) run.measure(std::abs(cell.point(below) - begin), 0, "u at the lower border");
        }
      }
    }
  }
  CdfWalk cell{.below = 0.5, .mass = 0.25, .begin = 2, .end = 3};
  for (int i = 0; i <= 100; ++i) {
    const double u = 0.5 + 0.25 * i / 100;
    run.measure(std::abs(cell.point(u) - (2 + static_cast<double>(i) / 100)), 1e-15, "place in a cell");
  }
}

void cdf_end(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    constexpr std::size_t kBins = 4096;
    TestNumbers random{6};
    for (const int kind : {0, 1, 2}) {
      std::vector<Real> weights(kBins);
      // Weights whose sums round: 0.1, random, and some that add up to next to nothing.
      for (auto& w : weights) w = static_cast<Real>(kind == 0 ? 0.1 : kind == 1 ? random.uniform() : 1e-30);
      const Earlier<Real> earlier(bin_middles<Real>(0, 1, kBins), weights);
      const InverseCdf<Real> truth(earlier, 0, 1, 1e-3);
      run.measure(std::abs(truth.cdf.back() - 1), 1e-15, "the reference ends at 1");
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
  });
}

void ties(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
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
        run.measure(std::abs(covered - (4 - from)), tolerance_of<Real>(1e-6), "intervals cover the ray");
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
        run.measure(relative_error(rays.opacity[0], -std::expm1(-3 * static_cast<long double>(covered))),
                    tolerance_of<Real>(2e-6), "opacity of the union");
      }
    }
    run.note("instruction set " + std::string(isa_name(isa())) + "; the tests run each in turn");
  });
}

void dynamic_range(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    std::vector<Real> weights;
    for (int k = 0; k < 40; ++k) weights.push_back(static_cast<Real>(std::pow(10.0, -8 + 8.0 * ((k * 17) % 40) / 39)));
    const Earlier<Real> earlier(bin_middles<Real>(2, 10, 40), weights);
    for (const std::string floor : {"0.001", "0.000000001"}) {
      const InverseCdf<Real> truth(earlier, 2, 10, std::stod(floor));
      for (std::int64_t step = -1; step < 20; ++step)
        measure_inverse(run, *importance<Real>(run, fresh_only(500, floor), 2, 10, earlier, step), truth, 2, 10);
    }
  });
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

void strata(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
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
  });
}

}  // namespace semfield::numerics
