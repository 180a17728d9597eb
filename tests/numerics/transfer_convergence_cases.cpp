// Group A: convergence of the rules, and what they do with walls and slabs.
#include <fmt/format.h>

#include "ray_bench.h"

namespace semfield::numerics {

namespace {

// Composite Gauss-Legendre, 5 points a panel.
template <class Function>
long double integrate(const Function& f, long double a, long double b, int panels) {
  constexpr long double kNode[] = {0, 0.538469310105683091036L, 0.906179845938663992798L};
  constexpr long double kWeight[] = {0.568888888888888888889L, 0.478628670499366468041L, 0.236926885056189087514L};
  const long double half = (b - a) / (2 * panels);
  long double sum = 0;
  for (int p = 0; p < panels; ++p) {
    const long double middle = a + (2 * p + 1) * half;
    sum += kWeight[0] * f(middle);
    for (int i = 1; i < 3; ++i) sum += kWeight[i] * (f(middle - half * kNode[i]) + f(middle + half * kNode[i]));
  }
  return sum * half;
}

double order_of(double coarse, double fine, double ratio) { return std::log(coarse / fine) / std::log(ratio); }

template <class Real>
double opacity_of(RayBuffers<Real>&& rays, const std::function<double(double)>& sigma) {
  render(rays, [&](double t) { return std::pair(sigma(t), 1.0); });
  return static_cast<double>(rays.opacity[0]);
}

}  // namespace

void exp_sigma(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    constexpr bool kSingle = std::is_same_v<Real, float>;
    const int coarse = kSingle ? 32 : 64,
              fine = 4 * coarse;  // fp32: coarse enough for the error to stand out of rounding
    double least = 9, most = 0;
    for (int exponent = -3; exponent <= 3; ++exponent) {
      const double h = std::pow(10.0, exponent);
      const auto sigma = [&](double t) { return std::exp(-t / h) / h; };
      const auto want = static_cast<double>(-std::expm1(std::expm1(-8.0L)));
      double error[2];
      for (int i = 0; i < 2; ++i) {
        const int n = i == 0 ? coarse : fine;
        error[i] = std::abs(opacity_of(sampled_ray<Real>(run.registry(), "midpoint", n, 0, 8 * h), sigma) - want);
      }
      const double order = order_of(error[0], error[1], 4);
      run.measure(std::abs(order - 2), 0.05, "order at H = " + figure(h) + " m");
      least = std::min(least, order);
      most = std::max(most, order);
    }
    run.note(fmt::format("order {:.4f} to {:.4f}", least, most));
    const double blind = opacity_of(sampled_ray<Real>(run.registry(), "midpoint", 64, 0, 1),
                                    [](double t) { return 1000 * std::exp(-1000 * t); });
    run.expect(blind < 0.05, "H = 1 mm is not seen by 64 samples a metre");
    run.note("H = 1 mm with 64 samples a metre: opacity " + figure(blind) + " for 0.632, under-resolved");
  });
}

void gauss_bump(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const double far = 16, middle = 8.037, depth = 0.5, root = std::sqrt(2 * std::acos(-1.0));
    double unresolved = 0;
    for (const int n : {64, 256, 1024}) {
      const double h = far / n;
      for (int step = 0; step <= 12; ++step) {
        const double w = std::pow(10.0, -0.25 * step);
        const long double s = std::sqrt(2.0L) * static_cast<long double>(w);
        const double want = static_cast<double>(0.5L * depth * (std::erf((far - middle) / s) - std::erf(-middle / s)));
        RayBuffers<Real> rays = sampled_ray<Real>(run.registry(), "midpoint", n, 0, far);
        render(rays, [&](double t) {
          const double x = (t - middle) / w;
          return std::pair(depth / (w * root) * std::exp(-0.5 * x * x), 1.0);
        });
        // The midpoint sum of a Gaussian is off by the aliases of its spectrum (Poisson): 2 sum_k e^(-2 (pi k w /
        // h)^2).
        double aliases = 0;
        for (int k = 1; k < 100000; ++k) {
          const double x = std::acos(-1.0) * k * w / h, term = 2 * std::exp(-2 * x * x);
          aliases += term;
          if (term < 1e-20) break;
        }
        const double error = std::abs(-std::log(channel(rays, 0, kTransmittance)) - want) / want;
        // A rounded place moves the flank of a narrow bump: 4 u t / w of its density.
        const double rounding = (std::is_same_v<Real, float> ? 0x1p-24 : 0x1p-53) * 4 * far / w;
        run.measure(error, aliases + rounding + tolerance_of<Real>(4e-6),
                    "optical depth of a bump of " + figure(w) + " m, h = " + figure(h) + " m");
        if (aliases > 1e-3) unresolved = std::max(unresolved, w / h);
        if (w >= h) run.expect(error < 1e-3, "a bump as wide as the interval is resolved");
        if (w < 0.1 * h) run.expect(error > 0.1, "a bump of a tenth of the interval is missed, or hit and overrated");
      }
    }
    run.note("under-resolved below a width of " + figure(unresolved) + " h: an error above 1e-3");
  });
}

void linear_colour(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const double slope = 0.25, left = std::exp(-4.0), want = slope * (1 - 5 * left);  // sigma = 1, [0, 4]
    const auto field = [&](double t) { return std::pair(1.0, slope * t); };
    const auto check = [&](RayBuffers<Real>&& rays, double predicted, const std::string& rule) {
      render(rays, field);
      const double error = channel(rays, 0, kColour) - want;
      run.measure(std::abs(error / predicted - 1), 0.05, rule);
      run.note(rule + " " + figure(error) + ", predicted " + figure(predicted));
    };
    double h = 4.0 / 1024;
    check(lattice<Real>(1024, 0, 4, 0), -0.5 * slope * (1 - left) * h, "near end, N = 1,024:");
    // Without jitter the paper's rule is the near-end rule on a grid that begins half an interval late.
    check(sampled_ray<Real>(run.registry(), "paper", 1024, 0, 4), 0.5 * h * want - 0.5 * slope * (1 - left) * h,
          "paper, N = 1,024:");
    h = 4.0 / 64;
    check(sampled_ray<Real>(run.registry(), "midpoint", 64, 0, 4), slope * h * h * (1 - left) / 12,
          "midpoint, N = 64:");
  });
}

namespace {

std::pair<double, double> smooth(double t) { return {std::exp(-t), std::cos(t)}; }

struct SmoothTruth {
  long double colour = 0;    // integral of sigma T c over [0, 4]
  long double near_end = 0;  // error of the near-end rule over h: -1/2 integral of T ((c - R) sigma' + sigma c')
};

SmoothTruth smooth_truth() {
  const auto through = [](long double t) { return std::exp(std::expm1(-t)); };
  const auto emitted = [&](long double t) { return std::exp(-t) * through(t) * std::cos(t); };
  SmoothTruth truth;
  truth.colour = integrate(emitted, 0, 4, 200);
  truth.near_end = -0.5L * integrate(
                               [&](long double t) {
                                 const long double behind = integrate(emitted, t, 4, 20) / through(t);  // R(t)
                                 return through(t) * std::exp(-t) * (-(std::cos(t) - behind) - std::sin(t));
                               },
                               0, 4, 40);
  return truth;
}

struct JitterError {
  double mean = 0, rms = 0;
};

template <class Real>
JitterError jitter_error(CaseRun& run, const std::string& rule, int n, std::int64_t count, double want) {
  RayBench<Real> bench(run.registry(), "stratified", {{"samples", std::to_string(n)}, {"quadrature", rule}});
  bench.ctx.training = true;
  bench.set_rays(count, 0, 4);
  bench.draw();
  RayBuffers<Real> rays = bench.buffers();
  render(rays, smooth);
  JitterError error;
  for (std::size_t r = 0; r < static_cast<std::size_t>(count); ++r) {
    const double e = channel(rays, r, kColour) - want;
    error.mean += e / static_cast<double>(count);
    error.rms += e * e / static_cast<double>(count);
  }
  error.rms = std::sqrt(error.rms);
  return error;
}

}  // namespace

void order_smooth(CaseRun& run) {
  const SmoothTruth truth = smooth_truth();
  const auto want = static_cast<double>(truth.colour);
  in_both_precisions(run, [&]<class Real>(Real) {
    const auto error = [&](RayBuffers<Real>&& rays) {
      render(rays, smooth);
      return channel(rays, 0, kColour) - want;
    };
    const auto check_order = [&](const std::string& rule, double coarse, double fine, double ratio, double expected,
                                 double within) {
      const double order = order_of(std::abs(coarse), std::abs(fine), ratio);
      run.measure(std::abs(order - expected), within, "order of " + rule);
      run.note(rule + " " + fmt::format("{:.2f}", order));
    };
    const double left = error(lattice<Real>(1024, 0, 4, 0));
    check_order("near end", error(lattice<Real>(64, 0, 4, 0)), left, 16, 1, 0.05);
    run.measure(std::abs(left * 256 / static_cast<double>(truth.near_end) - 1), 0.05, "constant of the near-end rule");
    check_order("midpoint", error(sampled_ray<Real>(run.registry(), "midpoint", 32, 0, 4)),
                error(sampled_ray<Real>(run.registry(), "midpoint", 128, 0, 4)), 4, 2, 0.05);
    const JitterError coarse = jitter_error<Real>(run, "paper", 64, 400, want);
    const JitterError fine = jitter_error<Real>(run, "paper", 1024, 400, want);
    check_order("paper, jittered (rms)", coarse.rms, fine.rms, 16, 1, 0.1);
    // E[delta^2] = 7/6 h^2 between jittered points; before the first of them half an interval is skipped on average.
    const double h = 4.0 / 256;
    const double mean = jitter_error<Real>(run, "paper", 256, 4000, want).mean;
    const double factor = (mean + 0.5 * h * (1 - want)) / (h * static_cast<double>(truth.near_end));
    run.measure(std::abs(factor / (7.0 / 6) - 1), 0.05, "E[delta^2] / h^2 of the paper's rule");
    run.note("its mean error is that of E[delta^2] = " + fmt::format("{:.3f}", factor) + " h^2 (7/6)");
    check_order("stratified_bin (rms)", jitter_error<Real>(run, "stratified_bin", 32, 1000, want).rms,
                jitter_error<Real>(run, "stratified_bin", 512, 1000, want).rms, 16, 1.5, 0.2);
  });
}

void stiff_wall(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const double slope = 0.25, far = 4;
    const auto error_of = [&](RayBuffers<Real>&& rays, double sigma, double wall) {
      render(rays, [&](double t) { return std::pair(t >= wall ? sigma : 0.0, slope * t); });
      for (const Real w : rays.weight) run.expect(w >= 0 && w <= 1, "a weight lies in [0, 1]");
      const double passes = std::exp(-sigma * (far - wall));
      return channel(rays, 0, kColour) - slope * (wall + 1 / sigma - passes * (far + 1 / sigma));
    };
    const double h = far / 64, rounding = std::is_same_v<Real, float> ? 2e-6 : 1e-12;
    for (int exponent = 1; exponent <= 8; ++exponent) {
      const double sigma = std::pow(10.0, exponent), most = std::max(slope / sigma, slope * h / 2);
      run.measure(std::abs(error_of(lattice<Real>(64, 0, far, 0), sigma, 1.25)), 1.05 * most + rounding, "near end");
      run.measure(std::abs(error_of(sampled_ray<Real>(run.registry(), "midpoint", 64, 0, far), sigma, 1.25)),
                  1.05 * most + rounding, "midpoint");
      // A wall between grid points is found up to an interval late.
      run.measure(std::abs(error_of(sampled_ray<Real>(run.registry(), "midpoint", 64, 0, far), sigma, 1.234)),
                  1.05 * slope * h + rounding, "midpoint, wall off the grid");
    }
    const double coarse = error_of(sampled_ray<Real>(run.registry(), "midpoint", 64, 0, far), 1e4, 1.25);
    const double fine = error_of(sampled_ray<Real>(run.registry(), "midpoint", 1024, 0, far), 1e4, 1.25);
    const double order = order_of(std::abs(coarse), std::abs(fine), 16);
    run.measure(std::abs(order - 1), 0.1, "order at sigma h >> 1");
    run.note("sigma 1e4: the midpoint rule falls to order " + fmt::format("{:.2f}", order) + ", error " +
             figure(coarse) + " at N = 64, near end " + figure(error_of(lattice<Real>(64, 0, far, 0), 1e4, 1.25)));
  });
}

void onset_between(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const double far = 4, h = far / 64;
    double worst_depth = 0;
    RayBuffers<Real> rays = sampled_ray<Real>(run.registry(), "midpoint", 64, 0, far);
    for (const double sigma : {2.0, 20.0, 200.0, 2000.0}) {
      for (int i = 0; i < 1000; ++i) {
        const double wall = 1 + h * i / 1000;
        render(rays, [&](double t) { return std::pair(t >= wall ? sigma : 0.0, 1.0); });
        const double tau = sigma * (far - wall), want = wall + 1 / sigma - std::exp(-tau) * (far + 1 / sigma);
        const double error = std::abs(static_cast<double>(rays.depth[0]) - want);
        run.measure(error, h, "depth");
        worst_depth = std::max(worst_depth, error);
        if (tau > 80) continue;  // e^-tau leaves fp32
        run.measure(std::abs(-std::log(channel(rays, 0, kTransmittance)) - tau), sigma * h, "optical depth");
      }
    }
    run.note("depth off by at most " + figure(worst_depth / h) + " h");
  });
}

void thin_slab(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    constexpr std::int64_t kRays = 100000;
    RayBench<Real> bench(run.registry(), "stratified", {{"samples", "8"}, {"quadrature", "stratified_bin"}});
    bench.ctx.training = true;
    bench.set_rays(kRays, 0, 8);
    bench.draw();
    RayBuffers<Real> rays = bench.buffers();
    RayBuffers<Real> fixed = sampled_ray<Real>(run.registry(), "midpoint", 80, 0, 8);
    double seen = 1;
    for (int exponent = 0; exponent >= -5; --exponent) {
      const double w = std::pow(10.0, exponent), sigma = 10 / w;
      render(rays, [&](double t) { return std::pair(std::abs(t - 3.5) <= 0.5 * w ? sigma : 0.0, 1.0); });
      double mean = 0;
      for (std::int64_t r = 0; r < kRays; ++r) mean += static_cast<double>(rays.opacity[r]);
      mean /= static_cast<double>(kRays);
      const double hit = -std::expm1(-sigma), expected = w * hit;  // h = 1 m: a ray sees it with probability w / h
      const double standard_error = hit * std::sqrt(w * (1 - w) / static_cast<double>(kRays));
      run.measure(std::abs(mean - expected), 3 * standard_error + 1e-6,
                  "mean opacity of a slab of " + figure(w) + " m");
      if (exponent == -3) seen = mean;
      render(fixed, [&](double t) { return std::pair(std::abs(t - 3.5) <= 0.5 * w ? sigma : 0.0, 1.0); });
      if (w < 0.01) run.measure(static_cast<double>(fixed.opacity[0]), 0, "fixed points miss a slab between them");
    }
    run.note("under-resolved below w = h: a slab of 1 mm and opacity 1 shows as " + figure(seen) +
             " on average, and not at all to fixed points");
  });
}

}  // namespace semfield::numerics
