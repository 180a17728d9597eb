// Group A: gradients of compositing.

#include "ray_bench.h"

namespace semfield::numerics {

namespace {

// dL/dsigma of a single ray of which colour alone has a gradient: from back to front in long double.
template <class Real>
std::vector<long double> reference_gradient(const RayBuffers<Real>& rays) {
  const auto exact = [](Real x) { return static_cast<long double>(x); };
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

void grad_depth_of_fog(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    int wrong = 0, total = 0;
    for (const double tau : {0.1, 1.0, 5.0, 20.0, 80.0}) {
      for (std::uint64_t seed = 0; seed < 5; ++seed) {
        RayBuffers<Real> rays = colour_alone<Real>(192, seed, tau);
        rays.forward();
        rays.backward();
        const std::vector<long double> want = reference_gradient(rays);
        long double error2 = 0, norm2 = 0;
        for (std::size_t k = 0; k < want.size(); ++k) {
          const auto got = static_cast<long double>(rays.d_sigma[k]);
          error2 += (got - want[k]) * (got - want[k]);
          norm2 += want[k] * want[k];
          if (std::abs(want[k]) < 1e-37L) continue;
          ++total;
          wrong += (got > 0) == (want[k] > 0) ? 0 : 1;
          // Where a colour is nearly that of everything behind it, their difference keeps few digits.
          run.measure(relative_error(got, want[k]), tolerance_of<Real>(1e-3, 1e-11), "an element");
        }
        run.measure(static_cast<double>(std::sqrt(error2 / norm2)), tolerance_of<Real>(1e-5), "norm");
      }
    }
    run.measure(wrong, 0, "wrong signs");
    run.note(std::to_string(wrong) + " wrong signs of " + std::to_string(total));
  });
}

void grad_opaque(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
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
          run.measure(relative_error(got, want[k]), tolerance_of<Real>(1e-5), "before the wall");
        } else if (std::is_same_v<Real, float> || wall > 745) {
          run.measure(std::abs(got), 0, "at and behind the wall");
        } else {
          run.measure(relative_error(got, want[k]), 1e-11, "e^-200 behind the wall");
        }
        if (k > 10 && (std::is_same_v<Real, float> || wall > 745))
          run.measure(std::abs(rays.d_rgb[3 * k]), 0, "colour behind the wall");
      }
    }
  });
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

}  // namespace semfield::numerics
