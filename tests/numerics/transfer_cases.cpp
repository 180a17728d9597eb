// Group A: the transfer equation and compositing. Here: closed forms.
#include <fmt/format.h>

#include "ray_bench.h"

namespace semfield::numerics {

std::string figure(double value) { return fmt::format("{:.3g}", value); }

namespace {

// Transmittance inherits the rounding of the optical depth in its exponent: u tau relative, whatever the arithmetic.
template <class Real>
double tau_rounding(double tau) {
  return std::is_same_v<Real, float> ? 0x1p-23 * tau : 0x1p-52 * tau;
}

}  // namespace

void vacuum(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
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
        run.measure(std::abs(static_cast<double>(rays.color[0]) - seen), 0, "background");
        rays.g_color = {1, 1, 1};
        rays.g_depth = rays.g_opacity = {1};
        rays.backward();
        for (const Real d : rays.d_sigma) run.expect(std::isfinite(d), "the gradient of an empty ray is finite");
      }
    }
  });
}

void constant_sweep(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    for (int exponent = -12; exponent <= 8; ++exponent) {
      for (const int n : {1, 7, 64, 1024}) {
        const double sigma = std::pow(10.0, exponent);
        RayBuffers<Real> rays = sampled_ray<Real>(run.registry(), "midpoint", n, 0, 1);
        render(rays, [&](double) { return std::pair(sigma, 1.0); });
        const long double want = -std::expm1(-static_cast<long double>(sigma));
        run.measure(relative_error(rays.opacity[0], want), tolerance_of<Real>(4e-6),
                    "opacity at sigma 1e" + std::to_string(exponent) + ", N " + std::to_string(n));
        run.measure(relative_error(rays.color[kOpacity], want), tolerance_of<Real>(4e-6));
      }
    }
  });
}

void linear_sigma(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    for (int exponent = -3; exponent <= 6; ++exponent) {
      for (const int n : {16, 64, 1024}) {
        const double a = std::pow(10.0, exponent), tau = 0.5 * a;
        RayBuffers<Real> rays = sampled_ray<Real>(run.registry(), "midpoint", n, 0, 1);
        render(rays, [&](double t) { return std::pair(a * t, 1.0); });
        const long double want = -std::expm1(-static_cast<long double>(tau));
        run.measure(relative_error(rays.opacity[0], want), tolerance_of<Real>(2e-6), "opacity");
        if (tau > 80) continue;  // e^-tau leaves fp32
        run.measure(relative_error(channel(rays, 0, kTransmittance), std::exp(-static_cast<long double>(tau))),
                    tolerance_of<Real>(2e-6) + tau_rounding<Real>(tau), "transmittance");
      }
    }
  });
}

namespace {

// T_k (1 - e^-tau_k) of every sample against long double from the same inputs.
template <class Real>
void measure_weights(CaseRun& run, const RayBuffers<Real>& rays, double tolerance) {
  long double tau = 0;
  for (std::size_t k = 0; k < rays.weight.size(); ++k) {
    const long double step = static_cast<long double>(rays.sigma[k]) * static_cast<long double>(rays.delta[k]);
    const long double want = std::exp(-tau) * -std::expm1(-step);
    tau += step;
    const auto got = static_cast<long double>(rays.weight[k]);
    if (want > 1e-37L) {
      run.measure(relative_error(got, want), tolerance, "weight");
    } else {
      run.expect(got >= 0 && got <= 1.2e-37L, "a weight behind everything is as good as 0");
    }
  }
}

}  // namespace

void slab_stack(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
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
        const long double tau = 32 * (0.0625L * 1e-2L + static_cast<long double>(dense_m) * 1e4L);
        run.measure(relative_error(channel(rays, 0, kColour), std::exp(-tau)), tolerance_of<Real>(1e-5), "T");
      }
    }
  });
}

void two_semantics(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
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
      const auto tau = static_cast<long double>(rays.sigma[2 * r]);
      const long double a = -std::expm1(-tau), b = std::exp(-tau) * -std::expm1(-20.0L);
      run.measure(relative_error(rays.out_hidden[2 * r], a), tolerance_of<Real>(2e-6), "logit in front");
      run.measure(relative_error(rays.out_hidden[2 * r + 1], b), tolerance_of<Real>(2e-6), "logit behind");
    }
    run.expect(rays.out_hidden[2] < rays.out_hidden[3], "just below tau = ln 2 the class behind wins");
    run.expect(rays.out_hidden[4] > rays.out_hidden[5], "just above it the class in front wins");
  });
}

// Slabs 1 | 5 over [0, 1], colour t, 32 intervals. With the density of the sample itself inside the sum, as the paper
// prints it, the result would be 0.13964 (0.1323 from near ends); the continuous integral is 0.455031.
void literal_eq_trap(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const auto slabs = [](double t) { return std::pair(t < 0.5 ? 1.0 : 5.0, t); };
    long double tau = 0, want = 0;
    for (int k = 0; k < 32; ++k) {
      const long double t = (static_cast<long double>(k) + 0.5L) / 32, step = (k < 16 ? 1.0L : 5.0L) / 32;
      want += std::exp(-tau) * -std::expm1(-step) * t;
      tau += step;
    }
    RayBuffers<Real> rays = sampled_ray<Real>(run.registry(), "midpoint", 32, 0, 1);
    render(rays, slabs);
    const double got = channel(rays, 0, kColour);
    run.measure(relative_error(got, want), tolerance_of<Real>(1e-6), "against the sum in long double");
    run.measure(std::abs(got - 0.455285), 1e-5, "against the printed value");
    run.measure(relative_error(rays.weight[16], std::exp(-0.5L) * -std::expm1(-5.0L / 32)), tolerance_of<Real>(1e-6),
                "first weight of the second slab");
    run.note("colour " + figure(got) + ", the misprint gives 0.140");
  });
}

void last_interval(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
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
        run.measure(std::abs(opacity - 1), 0, "the last sample takes the rest");
        run.measure(std::abs(channel(rays, 0, kColour) - 1), 0, "nothing shines through");
        run.measure(std::abs(static_cast<double>(rays.depth[0]) - 2), 0, "its depth");
        run.measure(std::abs(slope), 0, "its density has no gradient");
      } else {
        const double behind = far == FarMode::open ? 0.5 : 0;  // seen behind it
        run.measure(relative_error(opacity, -std::expm1(-static_cast<long double>(tau))), tolerance_of<Real>(2e-7),
                    "opacity sigma delta");
        run.measure(std::abs(channel(rays, 0, kColour) - (tau + behind * (1 - tau))), tolerance_of<Real>(1e-7));
        run.measure(relative_error(slope, delta * std::exp(-tau) * (1 - behind)), tolerance_of<Real>(1e-6), "gradient");
      }
      run.measure(std::abs(rays.opacity[1]), 0, "a ray without samples");
      run.measure(std::abs(channel(rays, 1, kColour) - (far == FarMode::closed ? 0 : 0.5)), 0, "what it shows");
    }
  });
}

void unity(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
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
  });
}

void many(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    for (const bool random : {false, true}) {
      RayBuffers<Real> rays = lattice<Real>(65536, 0, 1, 0.5);
      TestNumbers numbers{16};
      for (auto& sigma : rays.sigma) sigma = static_cast<Real>(random ? 2 * numbers.uniform() : 1);
      rays.background = {1, 0, 0};
      rays.forward();
      long double tau = 0;
      for (std::size_t k = 0; k < rays.sigma.size(); ++k)
        tau += static_cast<long double>(rays.sigma[k]) * static_cast<long double>(rays.delta[k]);
      run.measure(relative_error(rays.opacity[0], -std::expm1(-tau)), tolerance_of<Real>(1e-5), "opacity");
      run.measure(relative_error(channel(rays, 0, kColour), std::exp(-tau)), tolerance_of<Real>(1e-5), "T");
      measure_weights(run, rays, tolerance_of<Real>(1e-5));
    }
  });
}

// alpha = sigma delta, the explicit rule, gives T = (1 - 2.016)^64 = 2.8 here.
void euler_trap(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    RayBuffers<Real> rays = sampled_ray<Real>(run.registry(), "midpoint", 64, 0, 64);
    render(rays, [](double) { return std::pair(2.016, 1.0); });
    const double behind = channel(rays, 0, kTransmittance);
    run.expect(behind >= 0, "transmittance is not negative");
    run.measure(behind, 1e-30, "transmittance");
    run.measure(std::abs(static_cast<double>(rays.opacity[0]) - 1), tolerance_of<Real>(2e-6), "opacity");
    if constexpr (std::is_same_v<Real, double>) {
      run.measure(relative_error(behind, std::exp(-64 * static_cast<long double>(2.016))),
                  1e-12 + tau_rounding<Real>(129), "9.5e-57");
    }
    run.note("T = " + figure(behind));
  });
}

}  // namespace semfield::numerics
