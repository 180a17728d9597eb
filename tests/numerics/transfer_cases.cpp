// Group A: the transfer equation and compositing. Here: closed forms.

#include <fmt/format.h>

#include <cstring>

#include "compute/parallel.h"
#include "eval/evaluator.h"
#include "ray_bench.h"
#include "rooms.h"

namespace semfield::numerics {

std::string figure(double value) { return fmt::format("{:.3g}", value); }

namespace {

// Transmittance inherits the rounding of the optical depth in its exponent: u tau relative, whatever the arithmetic.
template <class Real>
double tau_rounding(double tau) {
  return std::is_same_v<Real, float> ? 0x1p-23 * tau : 0x1p-52 * tau;
}

}  // namespace

IN_BOTH_PRECISIONS(vacuum) {
  for (const int count : {1, 2, 7, 64, 1024}) {
    for (const FarMode far : {FarMode::open, FarMode::closed}) {
      RayBuffers<Real> rays = lattice<Real>(count, 0, count, 0.5);
      std::fill(rays.rgb.begin(), rays.rgb.end(), Real(1));
      rays.far = far;
      rays.background = {1, 0.5, 0.25};
      rays.forward();
      run.measure(std::abs(rays.opacity[0]), 0, "opacity");
      run.measure(std::abs(rays.depth[0]), 0, "depth");
      for (const Real weight : rays.weight) run.measure(std::abs(weight), 0, "weight");
      const double seen = far == FarMode::open ? 1 : 0;  // T = 1: the background as it is
      run.near(rays.color[0], seen, 0, "background");
      rays.g_color = {1, 1, 1};
      rays.g_depth = rays.g_opacity = {1};
      rays.backward();
      for (const Real d : rays.d_sigma) run.expect(std::isfinite(d), "the gradient of an empty ray is finite");
    }
  }
}

IN_BOTH_PRECISIONS(constant_sweep) {
  for (int exponent = -12; exponent <= 8; ++exponent) {
    for (const int n : {1, 7, 64, 1024}) {
      const double sigma = std::pow(10.0, exponent);
      RayBuffers<Real> rays = sampled_ray<Real>(run.registry(), "midpoint", n, 0, 1);
      render(rays, [&](double) { return std::pair(sigma, 1.0); });
      const long double want = -std::expm1(-long_double(sigma));
      run.relative(rays.opacity[0], want, tolerance_of<Real>(4e-6),
                   "opacity at sigma 1e" + std::to_string(exponent) + ", N " + std::to_string(n));
      run.relative(rays.color[kOpacity], want, tolerance_of<Real>(4e-6));
    }
  }
}

IN_BOTH_PRECISIONS(linear_sigma) {
  for (int exponent = -3; exponent <= 6; ++exponent) {
    for (const int n : {16, 64, 1024}) {
      const double a = std::pow(10.0, exponent), tau = 0.5 * a;
      RayBuffers<Real> rays = sampled_ray<Real>(run.registry(), "midpoint", n, 0, 1);
      render(rays, [&](double t) { return std::pair(a * t, 1.0); });
      const long double want = -std::expm1(-long_double(tau));
      run.relative(rays.opacity[0], want, tolerance_of<Real>(2e-6), "opacity");
      if (tau > 80) continue;  // e^-tau leaves fp32
      run.relative(channel(rays, 0, kTransmittance), std::exp(-long_double(tau)),
                   tolerance_of<Real>(2e-6) + tau_rounding<Real>(tau), "transmittance");
    }
  }
}

namespace {

// T_k (1 - e^-tau_k) of every sample against long double from the same inputs.
template <class Real>
void measure_weights(CaseRun& run, const RayBuffers<Real>& rays, double tolerance) {
  long double tau = 0;
  for (std::size_t k = 0; k < rays.weight.size(); ++k) {
    const long double step = long_double(rays.sigma[k]) * long_double(rays.delta[k]);
    const long double want = std::exp(-tau) * -std::expm1(-step);
    tau += step;
    const auto got = long_double(rays.weight[k]);
    if (want > 1e-37L) {
      run.relative(got, want, tolerance, "weight");
    } else {
      run.expect(got >= 0 && got <= 1.2e-37L, "a weight behind everything is as good as 0");
    }
  }
}

}  // namespace

IN_BOTH_PRECISIONS(slab_stack) {
  for (const double dense_m : {0.0625, 1e-5}) {  // optical depth 625: a wall; 0.1: a stack of panes
    RayBuffers<Real> rays({64}, 0);
    double t = 0;
    for (std::size_t k = 0; k < 64; ++k) {
      const bool dense = k % 2 == 1;
      const double length = dense ? dense_m : 0.0625;
      rays.t[k] = static_cast<Real>(t + 0.5 * length);
      rays.delta[k] = static_cast<Real>(length);
      rays.sigma[k] = static_cast<Real>(dense ? 1e4 : 1e-2);
      t += length;
    }
    rays.background = {1, 0, 0};
    rays.forward();
    measure_weights(run, rays, tolerance_of<Real>(1e-5));
    if (dense_m < 1e-4) {
      const long double tau = 32 * (0.0625L * 1e-2L + long_double(dense_m) * 1e4L);
      run.relative(channel(rays, 0, kColour), std::exp(-tau), tolerance_of<Real>(1e-5), "T");
    }
  }
}

IN_BOTH_PRECISIONS(two_semantics) {
  RayBuffers<Real> rays({2, 2, 2}, 2);
  rays.space_evenly(2);
  const double front[3] = {0.7, std::log(2.0) - 1e-4, std::log(2.0) + 1e-4};
  for (std::size_t r = 0; r < 3; ++r) {
    rays.sigma[2 * r] = static_cast<Real>(front[r]);
    rays.sigma[2 * r + 1] = 20;
    rays.hidden[4 * r] = 1;      // class A in front
    rays.hidden[4 * r + 3] = 1;  // class B behind
  }
  rays.forward();
  for (std::size_t r = 0; r < 3; ++r) {
    const auto tau = long_double(rays.sigma[2 * r]);
    const long double a = -std::expm1(-tau), b = std::exp(-tau) * -std::expm1(-20.0L);
    run.relative(rays.out_hidden[2 * r], a, tolerance_of<Real>(2e-6), "logit in front");
    run.relative(rays.out_hidden[2 * r + 1], b, tolerance_of<Real>(2e-6), "logit behind");
  }
  run.expect(rays.out_hidden[2] < rays.out_hidden[3], "just below tau = ln 2 the class behind wins");
  run.expect(rays.out_hidden[4] > rays.out_hidden[5], "just above it the class in front wins");
}

// Slabs 1 | 5 over [0, 1], colour t, 32 intervals. With the density of the sample itself inside the sum, as the paper
// prints it, the result would be 0.13964 (0.1323 from near ends); the continuous integral is 0.455031.
IN_BOTH_PRECISIONS(literal_eq_trap) {
  const auto slabs = [](double t) { return std::pair(t < 0.5 ? 1.0 : 5.0, t); };
  long double tau = 0, want = 0;
  for (int k = 0; k < 32; ++k) {
    const long double t = (long_double(k) + 0.5L) / 32, step = (k < 16 ? 1.0L : 5.0L) / 32;
    want += std::exp(-tau) * -std::expm1(-step) * t;
    tau += step;
  }
  RayBuffers<Real> rays = sampled_ray<Real>(run.registry(), "midpoint", 32, 0, 1);
  render(rays, slabs);
  const double got = channel(rays, 0, kColour);
  run.relative(got, want, tolerance_of<Real>(1e-6), "against the sum in long double");
  run.near(got, 0.455285, 1e-5, "against the printed value");
  run.relative(rays.weight[16], std::exp(-0.5L) * -std::expm1(-5.0L / 32), tolerance_of<Real>(1e-6),
               "first weight of the second slab");
  run.note("colour " + figure(got) + ", the misprint gives 0.140");
}

IN_BOTH_PRECISIONS(last_interval) {
  const double delta = 0.5, tau = 1e-6 * delta;
  for (const FarMode far : {FarMode::open, FarMode::closed, FarMode::background}) {
    RayBuffers<Real> rays({1, 0}, 0);
    rays.far = far;
    rays.background = {0.5, 0.5, 0.5};
    rays.t = {2};
    rays.delta = {static_cast<Real>(delta)};
    rays.sigma = {static_cast<Real>(1e-6)};
    rays.rgb = {1, 1, 1};
    rays.forward();
    rays.g_color = {1, 0, 0, 1, 0, 0};
    rays.backward();
    const auto opacity = static_cast<double>(rays.opacity[0]), slope = static_cast<double>(rays.d_sigma[0]);
    if (far == FarMode::background) {
      run.near(opacity, 1, 0, "the last sample takes the rest");
      run.near(channel(rays, 0, kColour), 1, 0, "nothing shines through");
      run.near(rays.depth[0], 2, 0, "its depth");
      run.measure(std::abs(slope), 0, "its density has no gradient");
    } else {
      const double behind = far == FarMode::open ? 0.5 : 0;  // seen behind it
      run.relative(opacity, -std::expm1(-long_double(tau)), tolerance_of<Real>(2e-7), "opacity sigma delta");
      run.near(channel(rays, 0, kColour), tau + behind * (1 - tau), tolerance_of<Real>(1e-7));
      run.relative(slope, delta * std::exp(-tau) * (1 - behind), tolerance_of<Real>(1e-6), "gradient");
    }
    run.measure(std::abs(rays.opacity[1]), 0, "a ray without samples");
    run.near(channel(rays, 1, kColour), far == FarMode::closed ? 0 : 0.5, 0, "what it shows");
  }
}

IN_BOTH_PRECISIONS(unity) {
  TestNumbers random{15};
  double worst[2] = {0, 0};
  const auto batch = [&](int rays_at_once, int n) {
    RayBuffers<Real> rays(std::vector<int>(static_cast<std::size_t>(rays_at_once), n), 0);
    rays.space_evenly(1);
    for (std::size_t r = 0; r < static_cast<std::size_t>(rays_at_once); ++r) {
      const double tau = std::pow(10.0, random.in(-8, 8));
      for (int k = 0; k < n; ++k)
        rays.sigma[r * static_cast<std::size_t>(n) + static_cast<std::size_t>(k)] =
            static_cast<Real>(2 * tau * random.uniform());
    }
    rays.background = {1, 1, 1};
    rays.forward();  // black medium: the colour is T
    for (std::size_t r = 0; r < static_cast<std::size_t>(rays_at_once); ++r) {
      double sum = static_cast<double>(rays.color[3 * r]);
      for (int k = 0; k < n; ++k) {
        const Real weight = rays.weight[r * static_cast<std::size_t>(n) + static_cast<std::size_t>(k)];
        sum += static_cast<double>(weight);
        if (!(weight >= 0 && weight <= 1)) run.expect(false, "a weight lies in [0, 1]");
      }
      double& most = worst[n == 1024 ? 1 : 0];
      most = std::max(most, std::abs(sum - 1));
    }
  };
  for (int i = 0; i < 98; ++i) batch(1000, 1 + i % 24);
  for (int i = 0; i < 20; ++i) batch(100, 1024);
  for (const double error : worst) run.measure(error, tolerance_of<Real>(2e-6), "|sum w + T - 1|");
  run.note("100,000 rays; worst " + figure(worst[0]) + " up to N = 24, " + figure(worst[1]) + " at N = 1024");
}

IN_BOTH_PRECISIONS(many) {
  for (const bool random : {false, true}) {
    RayBuffers<Real> rays = lattice<Real>(65536, 0, 1, 0.5);
    TestNumbers numbers{16};
    for (auto& sigma : rays.sigma) sigma = static_cast<Real>(random ? 2 * numbers.uniform() : 1);
    rays.background = {1, 0, 0};
    rays.forward();
    long double tau = 0;
    for (std::size_t k = 0; k < rays.sigma.size(); ++k) tau += long_double(rays.sigma[k]) * long_double(rays.delta[k]);
    run.relative(rays.opacity[0], -std::expm1(-tau), tolerance_of<Real>(1e-5), "opacity");
    run.relative(channel(rays, 0, kColour), std::exp(-tau), tolerance_of<Real>(1e-5), "T");
    measure_weights(run, rays, tolerance_of<Real>(1e-5));
  }
}

// alpha = sigma delta, the explicit rule, gives T = (1 - 2.016)^64 = 2.8 here.
IN_BOTH_PRECISIONS(euler_trap) {
  RayBuffers<Real> rays = sampled_ray<Real>(run.registry(), "midpoint", 64, 0, 64);
  render(rays, [](double) { return std::pair(2.016, 1.0); });
  const double behind = channel(rays, 0, kTransmittance);
  run.expect(behind >= 0, "transmittance is not negative");
  run.measure(behind, 1e-30, "transmittance");
  run.near(rays.opacity[0], 1, tolerance_of<Real>(2e-6), "opacity");
  if constexpr (std::is_same_v<Real, double>) {
    run.relative(behind, std::exp(-64 * long_double(2.016)), 1e-12 + tau_rounding<Real>(129), "9.5e-57");
  }
  run.note("T = " + figure(behind));
}

// Group A: convergence of the rules, and what they do with walls and slabs.

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

IN_BOTH_PRECISIONS(exp_sigma) {
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
    run.near(order, 2, 0.05, "order at H = " + figure(h) + " m");
    least = std::min(least, order);
    most = std::max(most, order);
  }
  run.note(fmt::format("order {:.4f} to {:.4f}", least, most));
  const double blind = opacity_of(sampled_ray<Real>(run.registry(), "midpoint", 64, 0, 1),
                                  [](double t) { return 1000 * std::exp(-1000 * t); });
  run.expect(blind < 0.05, "H = 1 mm is not seen by 64 samples a metre");
  run.note("H = 1 mm with 64 samples a metre: opacity " + figure(blind) + " for 0.632, under-resolved");
}

IN_BOTH_PRECISIONS(gauss_bump) {
  const double far = 16, middle = 8.037, depth = 0.5, root = std::sqrt(2 * std::acos(-1.0));
  double unresolved = 0;
  for (const int n : {64, 256, 1024}) {
    const double h = far / n;
    for (int step = 0; step <= 12; ++step) {
      const double w = std::pow(10.0, -0.25 * step);
      const long double s = std::sqrt(2.0L) * long_double(w);
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
}

IN_BOTH_PRECISIONS(linear_colour) {
  const double slope = 0.25, left = std::exp(-4.0), want = slope * (1 - 5 * left);  // sigma = 1, [0, 4]
  const auto field = [&](double t) { return std::pair(1.0, slope * t); };
  const auto check = [&](RayBuffers<Real>&& rays, double predicted, const std::string& rule) {
    render(rays, field);
    const double error = channel(rays, 0, kColour) - want;
    run.near(error / predicted, 1, 0.05, rule);
    run.note(rule + " " + figure(error) + ", predicted " + figure(predicted));
  };
  double h = 4.0 / 1024;
  check(lattice<Real>(1024, 0, 4, 0), -0.5 * slope * (1 - left) * h, "near end, N = 1,024:");
  // Without jitter the paper's rule is the near-end rule on a grid that begins half an interval late.
  check(sampled_ray<Real>(run.registry(), "paper", 1024, 0, 4), 0.5 * h * want - 0.5 * slope * (1 - left) * h,
        "paper, N = 1,024:");
  h = 4.0 / 64;
  check(sampled_ray<Real>(run.registry(), "midpoint", 64, 0, 4), slope * h * h * (1 - left) / 12, "midpoint, N = 64:");
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
      run.near(order, expected, within, "order of " + rule);
      run.note(rule + " " + fmt::format("{:.2f}", order));
    };
    const double left = error(lattice<Real>(1024, 0, 4, 0));
    check_order("near end", error(lattice<Real>(64, 0, 4, 0)), left, 16, 1, 0.05);
    run.near(left * 256 / static_cast<double>(truth.near_end), 1, 0.05, "constant of the near-end rule");
    check_order("midpoint", error(sampled_ray<Real>(run.registry(), "midpoint", 32, 0, 4)),
                error(sampled_ray<Real>(run.registry(), "midpoint", 128, 0, 4)), 4, 2, 0.05);
    const JitterError coarse = jitter_error<Real>(run, "paper", 64, 400, want);
    const JitterError fine = jitter_error<Real>(run, "paper", 1024, 400, want);
    check_order("paper, jittered (rms)", coarse.rms, fine.rms, 16, 1, 0.1);
    // E[delta^2] = 7/6 h^2 between jittered points; before the first of them half an interval is skipped on average.
    const double h = 4.0 / 256;
    const double mean = jitter_error<Real>(run, "paper", 256, 4000, want).mean;
    const double factor = (mean + 0.5 * h * (1 - want)) / (h * static_cast<double>(truth.near_end));
    run.near(factor / (7.0 / 6), 1, 0.05, "E[delta^2] / h^2 of the paper's rule");
    run.note("its mean error is that of E[delta^2] = " + fmt::format("{:.3f}", factor) + " h^2 (7/6)");
    check_order("stratified_bin (rms)", jitter_error<Real>(run, "stratified_bin", 32, 1000, want).rms,
                jitter_error<Real>(run, "stratified_bin", 512, 1000, want).rms, 16, 1.5, 0.2);
  });
}

IN_BOTH_PRECISIONS(stiff_wall) {
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
  run.near(order, 1, 0.1, "order at sigma h >> 1");
  run.note("sigma 1e4: the midpoint rule falls to order " + fmt::format("{:.2f}", order) + ", error " + figure(coarse) +
           " at N = 64, near end " + figure(error_of(lattice<Real>(64, 0, far, 0), 1e4, 1.25)));
}

IN_BOTH_PRECISIONS(onset_between) {
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
      run.near(-std::log(channel(rays, 0, kTransmittance)), tau, sigma * h, "optical depth");
    }
  }
  run.note("depth off by at most " + figure(worst_depth / h) + " h");
}

IN_BOTH_PRECISIONS(thin_slab) {
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
    run.near(mean, expected, 3 * standard_error + 1e-6, "mean opacity of a slab of " + figure(w) + " m");
    if (exponent == -3) seen = mean;
    render(fixed, [&](double t) { return std::pair(std::abs(t - 3.5) <= 0.5 * w ? sigma : 0.0, 1.0); });
    if (w < 0.01) run.measure(static_cast<double>(fixed.opacity[0]), 0, "fixed points miss a slab between them");
  }
  run.note("under-resolved below w = h: a slab of 1 mm and opacity 1 shows as " + figure(seen) +
           " on average, and not at all to fixed points");
}

// Group A: gradients of compositing.

namespace {

// dL/dsigma of a single ray of which colour alone has a gradient: from back to front in long double.
template <class Real>
std::vector<long double> reference_gradient(const RayBuffers<Real>& rays) {
  const auto exact = [](Real x) { return long_double(x); };
  const std::size_t n = rays.sigma.size();
  std::vector<long double> result(n), after(n);
  long double tau = 0;
  for (std::size_t k = 0; k < n; ++k) {
    tau += exact(rays.sigma[k]) * exact(rays.delta[k]);
    after[k] = std::exp(-tau);
  }
  long double behind = 0;
  for (std::size_t k = n; k-- > 0;) {
    long double value = 0;
    for (std::size_t c = 0; c < 3; ++c) value += exact(rays.g_color[c]) * exact(rays.rgb[3 * k + c]);
    result[k] = exact(rays.delta[k]) * after[k] * (value - behind);
    behind -= std::expm1(-exact(rays.sigma[k]) * exact(rays.delta[k])) * (value - behind);
  }
  return result;
}

template <class Real>
RayBuffers<Real> colour_alone(int samples, std::uint64_t seed, double tau) {
  RayBuffers<Real> rays({samples}, 0);
  rays.space_evenly(1);
  rays.fill_random(seed, tau);
  rays.g_depth = {0};
  rays.g_opacity = {0};
  return rays;
}

}  // namespace

IN_BOTH_PRECISIONS(grad_depth_of_fog) {
  int wrong = 0, total = 0;
  for (const double tau : {0.1, 1.0, 5.0, 20.0, 80.0}) {
    for (std::uint64_t seed = 0; seed < 5; ++seed) {
      RayBuffers<Real> rays = colour_alone<Real>(192, seed, tau);
      rays.forward();
      rays.backward();
      const std::vector<long double> want = reference_gradient(rays);
      long double error2 = 0, norm2 = 0;
      for (std::size_t k = 0; k < want.size(); ++k) {
        const auto got = long_double(rays.d_sigma[k]);
        error2 += (got - want[k]) * (got - want[k]);
        norm2 += want[k] * want[k];
        if (std::abs(want[k]) < 1e-37L) continue;
        ++total;
        wrong += (got > 0) == (want[k] > 0) ? 0 : 1;
        // Where a colour is nearly that of everything behind it, their difference keeps few digits.
        run.relative(got, want[k], tolerance_of<Real>(1e-3, 1e-11), "an element");
      }
      run.measure(static_cast<double>(std::sqrt(error2 / norm2)), tolerance_of<Real>(1e-5), "norm");
    }
  }
  run.measure(wrong, 0, "wrong signs");
  run.note(std::to_string(wrong) + " wrong signs of " + std::to_string(total));
}

IN_BOTH_PRECISIONS(grad_opaque) {
  for (const double wall : {200.0, 1e4, 1e30}) {  // optical depth of sample 10; float64 ends at e^-745
    RayBuffers<Real> rays = colour_alone<Real>(64, 21, 2);
    rays.sigma[10] = static_cast<Real>(wall * 64);
    rays.forward();
    rays.backward();
    const std::vector<long double> want = reference_gradient(rays);
    for (std::size_t k = 0; k < want.size(); ++k) {
      const Real got = rays.d_sigma[k];
      run.expect(std::isfinite(got), "a gradient is finite");
      if (k < 10) {
        run.relative(got, want[k], tolerance_of<Real>(1e-5), "before the wall");
      } else if (std::is_same_v<Real, float> || wall > 745) {
        run.measure(std::abs(got), 0, "at and behind the wall");
      } else {
        run.relative(got, want[k], 1e-11, "e^-200 behind the wall");
      }
      if (k > 10 && (std::is_same_v<Real, float> || wall > 745))
        run.measure(std::abs(rays.d_rgb[3 * k]), 0, "colour behind the wall");
    }
  }
}

namespace {

// dL/dx by central differences, extrapolated to step 0 (Ridders): the estimate with the smallest change.
double ridders(RayBuffers<double>& rays, double& x) {
  constexpr int kSteps = 8;
  constexpr double kShrink = 1.6;
  double table[kSteps][kSteps], best = 0, change = 1e300, step = 0.1;
  const double at = x;
  for (int i = 0; i < kSteps; ++i, step /= kShrink) {
    x = at + step;
    const double above = rays.loss(), up = x;
    x = at - step;
    const double below = rays.loss(), down = x;
    table[i][0] = (above - below) / (up - down);
    double factor = 1;
    for (int j = 1; j <= i; ++j) {
      factor *= kShrink * kShrink;
      table[i][j] = (factor * table[i][j - 1] - table[i - 1][j - 1]) / (factor - 1);
      const double moved =
          std::max(std::abs(table[i][j] - table[i][j - 1]), std::abs(table[i][j] - table[i - 1][j - 1]));
      if (moved < change) {
        change = moved;
        best = table[i][j];
      }
    }
  }
  x = at;
  return best;
}

// A gradient against another, in units of the largest element.
void measure_gradient(CaseRun& run, const std::vector<double>& got, const std::vector<double>& want, double tolerance,
                      const std::string& what) {
  double largest = 0, error = 0;
  for (std::size_t i = 0; i < want.size(); ++i) {
    largest = std::max(largest, std::abs(want[i]));
    error = std::max(error, std::abs(got[i] - want[i]));
  }
  run.expect(largest > 0, "there is a gradient of " + what);
  run.measure(error / largest, tolerance, what);
}

const std::vector<int> kCounts{5, 0, 1, 9};
constexpr std::int32_t kChannels = 19;

template <class Real>
RayBuffers<Real> all_outputs(FarMode far) {
  RayBuffers<Real> rays(kCounts, kChannels);
  rays.space_evenly(3);
  rays.fill_random(22, 1.0);
  for (auto& s : rays.sigma) s += Real(0.25);  // room for the first step of the differences
  rays.far = far;
  rays.background = {0.3, -0.2, 0.9};
  return rays;
}

std::vector<double> widened(const std::vector<float>& v) { return {v.begin(), v.end()}; }

}  // namespace

void grad_all_outputs(CaseRun& run) {
  const FarMode modes[] = {FarMode::open, FarMode::closed, FarMode::background};
  run.row("fp32");
  for (const FarMode far : modes) {
    RayBuffers<float> rays = all_outputs<float>(far);
    RayBuffers<double> same = all_outputs<double>(far);
    same.take_inputs(rays);
    rays.forward();
    rays.backward();
    same.forward();
    same.backward();
    measure_gradient(run, widened(rays.d_sigma), same.d_sigma, 1e-5, "density, against float64");
    measure_gradient(run, widened(rays.d_rgb), same.d_rgb, 1e-5, "colour, against float64");
    measure_gradient(run, widened(rays.d_hidden), same.d_hidden, 1e-5, "hidden, against float64");
  }
  run.row("float64");
  for (const FarMode far : modes) {
    RayBuffers<double> rays = all_outputs<double>(far);
    rays.forward();
    rays.backward();
    const auto check = [&](std::vector<double>& x, const std::vector<double>& analytic, const std::string& what) {
      std::vector<double> differences(x.size());
      for (std::size_t i = 0; i < x.size(); ++i) differences[i] = ridders(rays, x[i]);
      measure_gradient(run, analytic, differences, 1e-8, what);
    };
    check(rays.sigma, std::vector<double>(rays.d_sigma), "density");
    check(rays.rgb, std::vector<double>(rays.d_rgb), "colour");
    check(rays.hidden, std::vector<double>(rays.d_hidden), "hidden");
  }
}

// Group A: early stop, bad and extreme values, units.

namespace {

template <class T>
bool same_bits(View<T> a, View<T> b) {
  bool same = a.rows == b.rows && a.cols == b.cols;
  for (std::int64_t r = 0; same && r < a.rows; ++r)
    same = std::memcmp(a.row(r), b.row(r), sizeof(T) * static_cast<std::size_t>(a.cols)) == 0;
  return same;
}

// What is not looked at behind T < 1e-4 may change a value by at most 1e-4 of the largest one there. Where the last
// sample takes the rest, it takes it with the class layer's bias, which counts as a value.
template <class Real>
void measure_early_stop(CaseRun& run, FarMode far) {
  constexpr double kCut = 1e-4;
  const double rounding = tolerance_of<Real>(2e-6);
  RenderRules rules{.rendering = {.density_activation = DensityActivation::softplus,
                                  .density_bias = 3,
                                  .far = far,
                                  .background = {1, 1, 1},
                                  .early_stop = 0}};
  RenderRules cutting = rules, every_logit = rules;
  cutting.rendering.early_stop = kCut;
  every_logit.deferred_class_layer = false;
  ModelBench<Real> whole(run.registry(), rules), cut(run.registry(), cutting),
      sample_by_sample(run.registry(), every_logit);
  const PassTrace<Real> full = whole.forward(false), part = cut.forward(false),
                        single = sample_by_sample.forward(false);
  const Tensor<Real>* bias = cut.store.find("main/semantic/class/bias");
  run.expect(bias != nullptr && bias->size() == full.semantic.rows.cols, "the class layer has a bias per class");
  if (bias == nullptr) return;
  std::int64_t skipped = 0;
  for (std::int64_t m = 0; m < full.samples.count; ++m)
    skipped += part.sigma(m, 0) == 0 && full.sigma(m, 0) > 0 ? 1 : 0;
  run.expect(skipped > full.samples.count / 10, "a tenth of the samples and more is not evaluated");
  double worst_colour = 0, worst_logit = 0;
  for (std::int64_t r = 0; r < ModelBench<Real>::kRays; ++r) {
    for (int c = 0; c < 3; ++c) {
      const double error = std::abs(static_cast<double>(full.color(r, c)) - static_cast<double>(part.color(r, c)));
      run.measure(error, kCut + rounding, "colour");  // no colour exceeds 1
      worst_colour = std::max(worst_colour, error);
    }
    for (std::int32_t c = 0; c < full.semantic.rows.cols; ++c) {
      double largest = 0;
      for (std::int32_t m = single.samples.first(r, 0); m < single.samples.first(r + 1, 0); ++m)
        largest = std::max<double>(largest, std::abs(single.semantic.sample_rows(m, c)));
      const double error =
          std::abs(static_cast<double>(full.semantic.rows(r, c)) - static_cast<double>(part.semantic.rows(r, c)));
      const double rest = far == FarMode::background ? std::abs(bias->value.data()[c]) : 0.0;
      run.measure(error, (kCut + rounding) * (largest + rest), "logit");
      worst_logit = std::max(worst_logit, error / largest);
    }
    run.measure(std::max(0.0, static_cast<double>(part.opacity(r, 0)) - static_cast<double>(full.opacity(r, 0))),
                rounding, "what is cut is not made up for: opacity only falls");
    double sum = 0;
    for (std::int32_t m = part.samples.first(r, 0); m < part.samples.first(r + 1, 0); ++m)
      sum += static_cast<double>(part.weight(m, 0));
    run.near(sum, part.opacity(r, 0), rounding, "opacity is the sum of weights");
  }
  if (far == FarMode::open)
    run.note(
        "not evaluated: " + figure(100.0 * static_cast<double>(skipped) / static_cast<double>(full.samples.count)) +
        " % of the samples; colour off by " + figure(worst_colour) + ", logits by " + figure(worst_logit) +
        " of the largest");
  const PassTrace<Real> trained = whole.forward(true), also = cut.forward(true);
  run.expect(same_bits(trained.color, also.color) && same_bits(trained.opacity, also.opacity) &&
                 same_bits(trained.semantic.rows, also.semantic.rows) && same_bits(trained.weight, also.weight),
             "training knows no early stop");
}

}  // namespace

IN_BOTH_PRECISIONS(early_stop) {
  measure_early_stop<Real>(run, FarMode::background);
  measure_early_stop<Real>(run, FarMode::open);
}

IN_BOTH_PRECISIONS(bad_density) {
  const double infinity = std::numeric_limits<double>::infinity();
  for (const double bad : {-1.0, -1e-30, std::numeric_limits<double>::quiet_NaN(), infinity, -infinity}) {
    RayBuffers<Real> rays({3, 4}, 0);
    rays.space_evenly(1);
    std::fill(rays.sigma.begin(), rays.sigma.end(), Real(0.5));
    run.expect((check_density<Real>(rays.samples, rays.col(rays.sigma), 100), true), "good densities pass");
    rays.sigma[5] = static_cast<Real>(bad);
    rays.forward();  // what a guard is there to see
    const auto before = rays;
    run.expect_error(ErrorKind::failure, {"ray 101", "sample 2", "m is"},
                     [&] { check_density<Real>(rays.samples, rays.col(rays.sigma), 100); });
    const auto same = [](const std::vector<Real>& a, const std::vector<Real>& b) {
      return a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * sizeof(Real)) == 0;
    };
    run.expect(same(rays.sigma, before.sigma) && same(rays.t, before.t) && same(rays.delta, before.delta) &&
                   same(rays.color, before.color) && same(rays.weight, before.weight),
               "densities, samples and results are as before the error");
    RayBuffers<Real> beside({3, 4}, 0);
    beside.space_evenly(1);
    std::fill(beside.sigma.begin(), beside.sigma.end(), Real(0.5));
    beside.forward();
    run.near(rays.opacity[0], beside.opacity[0], 0, "the ray beside it");
  }
  const Real largest = std::numeric_limits<Real>::max();
  RayBuffers<Real> edge({1}, 0);
  edge.sigma = {largest};
  check_density<Real>(edge.samples, edge.col(edge.sigma), 0);
  edge.sigma = {Real(-0.0)};
  check_density<Real>(edge.samples, edge.col(edge.sigma), 0);
  run.expect(true, "the largest number and -0 are densities");
  // The same of a whole pass, whose raw densities become infinite.
  RenderRules rules{.rendering = {.density_bias = infinity}};
  ModelBench<Real> model(run.registry(), rules);
  const auto values = [&] {
    std::vector<Real> all;
    for (const Tensor<Real>& tensor : model.store.all())
      all.insert(all.end(), tensor.value.data(), tensor.value.data() + tensor.value.size());
    return all;
  };
  const std::vector<Real> before = values();
  for (const bool training : {false, true}) {
    run.expect_error(ErrorKind::failure, {"density", "ray 100", "sample 0"}, [&] {
      model.ctx.first_ray = 100;
      model.forward(training);
    });
  }
  run.expect(before == values(), "parameters are as before the error");
}

namespace {

#if defined(__SSE2__) || defined(__aarch64__)
constexpr bool kFlushes = true;
#else
constexpr bool kFlushes = false;
#endif

// Values, gradients and moments of dense tensors that are subnormal.
int subnormal_count(TrainingBox& box) {
  int found = 0;
  for (const Tensor<float>& tensor : box.pipeline().store().all()) {
    if (tensor.spec.role != TensorRole::dense) continue;
    for (const AlignedBuffer<float>* buffer : {&tensor.value, &tensor.grad, &tensor.moment1, &tensor.moment2}) {
      for (std::size_t i = 0; i < buffer->size(); ++i)
        found += std::fpclassify(buffer->data()[i]) == FP_SUBNORMAL ? 1 : 0;
    }
  }
  return found;
}

// Some CPUs take 25 times as long over subnormal numbers. Compute threads meet none: whatever a step begins with,
// it leaves none behind.
void count_subnormals_of_a_step(CaseRun& run) {
  TrainingBox box(run.registry(), small_config());
  for (Tensor<float>& tensor : box.pipeline().store().all()) {
    if (tensor.spec.role != TensorRole::dense) continue;
    for (const AlignedBuffer<float>* buffer : {&tensor.value, &tensor.moment1, &tensor.moment2}) {
      for (std::size_t i = 0; i < buffer->size(); i += 2) buffer->data()[i] = 1e-40F;
    }
  }
  const int before = subnormal_count(box);
  box.trainer().advance();
  run.expect(before > 1000, "the step began with subnormal numbers");
  const int left = subnormal_count(box);
  run.measure(left, 0, "subnormal numbers that a step leaves");
  run.note("a training step began with " + std::to_string(before) + " subnormal numbers and left " +
           std::to_string(left));
}

}  // namespace

IN_BOTH_PRECISIONS(denormal) {
  const double small = std::is_same_v<Real, float> ? 1e-20 : 1e-155;
  const double least_normal = static_cast<double>(std::numeric_limits<Real>::min());
  for (const bool flush : {false, true}) {
    RayBuffers<Real> rays({4096}, 0);
    rays.space_evenly(1);
    std::fill(rays.delta.begin(), rays.delta.end(), static_cast<Real>(small));
    std::fill(rays.sigma.begin(), rays.sigma.end(), static_cast<Real>(small));
    if (flush) {
      parallel_for(1, [&](std::int64_t) { rays.forward(); });
    } else {
      rays.forward();
    }
    const long double tau = long_double(rays.sigma[0]) * long_double(rays.delta[0]);
    for (const Real weight : rays.weight) {
      const long double off = long_double(weight) - tau;
      run.measure(static_cast<double>(off < 0 ? -off : off) / least_normal, 1.03, "weight, in least normal numbers");
      if (flush && kFlushes) run.expect(weight == 0, "a compute thread has no subnormal weight");
    }
    if (!flush) run.expect(rays.weight[0] > 0, "a subnormal weight is kept");
    run.expect(
        static_cast<double>(rays.opacity[0]) >= 0 && static_cast<double>(rays.opacity[0]) <= 2 * least_normal * 4096,
        "and so is its sum");
  }
  if constexpr (kFlushes && std::is_same_v<Real, float>) count_subnormals_of_a_step(run);
}

IN_BOTH_PRECISIONS(split_invariance) {
  for (const int m : {2, 4, 8, 64}) {
    RayBuffers<Real> whole({16}, 2), parts({16 * m}, 2);
    whole.space_evenly(2);
    parts.space_evenly(2);
    TestNumbers random{23};
    for (std::size_t k = 0; k < 16; ++k) {
      whole.sigma[k] = static_cast<Real>(random.in(0, 4));
      for (std::size_t c = 0; c < 2; ++c) whole.hidden[2 * k + c] = static_cast<Real>(random.in(-1, 1));
      for (std::size_t j = k * static_cast<std::size_t>(m); j < (k + 1) * static_cast<std::size_t>(m); ++j) {
        parts.sigma[j] = whole.sigma[k];
        parts.t[j] = whole.t[k];
        for (std::size_t c = 0; c < 2; ++c) parts.hidden[2 * j + c] = whole.hidden[2 * k + c];
      }
    }
    whole.forward();
    parts.forward();
    const double tolerance = tolerance_of<Real>(1e-6) * std::sqrt(m);
    const auto off = [](Real a, Real b) { return std::abs(static_cast<double>(a) - static_cast<double>(b)); };
    run.measure(off(whole.opacity[0], parts.opacity[0]), tolerance, "opacity");
    run.measure(off(whole.depth[0], parts.depth[0]), 2 * tolerance, "depth, up to 2 m");
    for (std::size_t c = 0; c < 2; ++c) run.measure(off(whole.out_hidden[c], parts.out_hidden[c]), tolerance, "hidden");
    whole.g_hidden = parts.g_hidden = {1, -0.5};
    whole.backward();
    parts.backward();
    for (std::size_t k = 0; k < 16; ++k) {
      double sum = 0;
      for (std::size_t j = k * static_cast<std::size_t>(m); j < (k + 1) * static_cast<std::size_t>(m); ++j)
        sum += static_cast<double>(parts.d_sigma[j]);
      run.near(sum, whole.d_sigma[k], tolerance, "gradient of an interval");
    }
  }
}

IN_BOTH_PRECISIONS(inf_delta) {
  const Real infinity = std::numeric_limits<Real>::infinity();
  RayBuffers<Real> rays({2, 2, 2}, 0);
  rays.delta = {infinity, 1, 10, 1, infinity, 1};
  rays.sigma = {0, 1, static_cast<Real>(3e38), 1, static_cast<Real>(1e-30), 1};
  rays.t = {1, 2, 1, 2, 1, 2};
  rays.forward();
  run.measure(std::abs(rays.weight[0]), 0, "0 over an infinite interval");
  run.relative(rays.weight[1], -std::expm1(-1.0L), tolerance_of<Real>(1e-6), "what is behind it is seen");
  run.near(rays.weight[2], 1, 0, "3e38 over 10 m");
  run.measure(std::abs(rays.weight[3]), 0, "behind it");
  run.near(rays.weight[4], 1, 0, "1e-30 over an infinite interval");
  run.near(rays.depth[2], 1, 0, "its depth");
  rays.g_opacity = rays.g_depth = {1, 1, 1};
  rays.backward();
  for (const Real d : rays.d_sigma) run.expect(std::isfinite(d), "gradients are finite");
  run.measure(std::abs(rays.d_sigma[3]), 0, "the gradient behind an opaque sample");
}

// Fog between two planes across the camera's axis, 1 m and 2 m away: a pixel whose direction (x, y, 1) has length s
// looks through s metres of it. And a scene in other units, with densities in theirs, is the same scene.
IN_BOTH_PRECISIONS(nonunit_dirs) {
  const auto measure_opacity = [&](double near_m, double far_m, double sigma, long double tau) {
    RayBuffers<Real> rays = sampled_ray<Real>(run.registry(), "midpoint", 64, near_m, far_m);
    render(rays, [&](double) { return std::pair(sigma, 1.0); });
    run.relative(rays.opacity[0], -std::expm1(-tau), tolerance_of<Real>(2e-6), "opacity");
    return static_cast<double>(rays.depth[0]);
  };
  for (const double across : {0.0, 0.75, 10.0, 100.0, 1000.0}) {
    RayCamera camera{.camera = {.width_px = 1, .height_px = 1, .fx = 0.5, .fy = 0.5}};
    camera.camera.cx = 0.5 - 0.5 * across;  // the pixel's centre is seen at x / z = across
    camera.camera.cy = 0.5;
    RayLimits limits{.near_m = 1, .far_m = 2, .z_depth = true};
    double origin[3], direction[3], near_far[2];
    cast_ray(camera, limits, 0, 0, origin, direction, near_far);
    const long double length = std::sqrt(1 + long_double(across) * long_double(across));
    const double norm =
        std::sqrt(direction[0] * direction[0] + direction[1] * direction[1] + direction[2] * direction[2]);
    run.near(norm, 1, 1e-15, "length of the ray's direction");
    run.relative(near_far[1] - near_far[0], length, 1e-12, "metres through the fog");
    const double sigma = 0.7 / static_cast<double>(length);
    measure_opacity(near_far[0], near_far[1], sigma, 0.7L);
    measure_opacity(near_far[0], near_far[1], 0.01, 0.01L * length);
  }
  const double depth = measure_opacity(1, 3, 0.35, 0.7L);
  for (int exponent = -3; exponent <= 3; ++exponent) {
    const double unit = std::pow(10.0, exponent);
    const double scaled = measure_opacity(1 * unit, 3 * unit, 0.35 / unit, 0.7L);
    run.near(scaled / (depth * unit), 1, tolerance_of<Real>(2e-6), "depth in the scene's unit");
  }
}

}  // namespace semfield::numerics
