// Cases E01 to E04 and E07: Adam and the learning-rate schedule against long double.
#include <fmt/format.h>

#include <algorithm>
#include <cstring>

#include "encoder_box.h"
#include "model/optim/adam.h"
#include "named_case.h"

namespace semfield::numerics {

namespace {

/// Bias corrections of one step.
struct Corrections {
  Corrections(const AdamParams& p, std::int64_t step)
      : mean(1 - std::pow(static_cast<long double>(p.beta1), static_cast<long double>(step) + 1)),
        square(1 - std::pow(static_cast<long double>(p.beta2), static_cast<long double>(step) + 1)) {}
  long double mean, square;
};

/// [Kingma15 Alg. 1] of one parameter in long double; `path` is the way it went.
struct Reference {
  long double x = 0, m = 0, v = 0, path = 0;
  void update(const AdamParams& p, long double g, const Corrections& correction) {
    const auto b1 = static_cast<long double>(p.beta1), b2 = static_cast<long double>(p.beta2);
    m = b1 * m + (1 - b1) * g;
    v = b2 * v + (1 - b2) * g * g;
    const long double step = static_cast<long double>(p.learning_rate) * m / correction.mean /
                             (std::sqrt(v / correction.square) + static_cast<long double>(p.epsilon));
    x -= step;
    path += std::abs(step);
  }
};

/// `count` rows of one tensor, each a parameter of its own.
template <class Real>
struct Parameters {
  explicit Parameters(std::size_t rows, std::int32_t width = 1)
      : value(rows * static_cast<std::size_t>(width)), grad(value), m(value), v(value), cols(width) {}
  View<Real> view(std::vector<Real>& x) { return {x.data(), static_cast<std::int64_t>(x.size()) / cols, cols}; }
  void dense(const AdamStep& step) {
    adam_dense<Real>(step, view(value), view(grad), view(m), view(v), 0, view(value).rows);
  }
  std::int64_t touched(const AdamStep& step) {
    return adam_touched<Real>(step, view(value), view(grad), view(m), view(v), 0, view(value).rows);
  }
  std::vector<Real> value, grad, m, v;
  std::int32_t cols;
};

template <class Real>
void check(CaseRun& run, const Parameters<Real>& got, std::size_t i, const Reference& want, double tolerance,
           const std::string& what) {
  run.measure(static_cast<double>(std::abs(static_cast<long double>(got.value[i]) - want.x) / want.path), tolerance,
              what);
}

}  // namespace

void adam_sizes(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const AdamParams params;
    constexpr int kSizes = 39;  // 1e-20 .. 1e18: from 1e19 on a step is refused (E08)
    for (const bool sparse : {false, true}) {
      Parameters<Real> state(kSizes);
      std::vector<Reference> want(kSizes);
      Numbers numbers(61);
      for (std::int64_t step = 0; step < 1000; ++step) {
        const Corrections correction(params, step);
        for (std::size_t i = 0; i < kSizes; ++i) {
          const double size = std::pow(10.0, static_cast<int>(i) - 20) * numbers.in(-0.5, 1.5);
          state.grad[i] = static_cast<Real>(size);
          want[i].update(params, static_cast<long double>(state.grad[i]), correction);
        }
        const AdamStep rule = adam_step(params, params.learning_rate, step);
        sparse ? static_cast<void>(state.touched(rule)) : state.dense(rule);
      }
      for (std::size_t i = 0; i < kSizes; ++i) {
        const std::string at = fmt::format("gradients near 1e{}", static_cast<int>(i) - 20);
        check(run, state, i, want[i], tolerance_of<Real>(1e-5), at);
        run.measure(relative_error(state.m[i], want[i].m), tolerance_of<Real>(1e-5), at);
        // Squares of gradients below 1e-15 leave the normal range of fp32; the root of them stands beside epsilon. In
        // fp32 beta2 = 0.999 is off by 1.3e-8, so 1,000 steps leave v off by up to 1.3e-5, and its root by half of it.
        if (std::is_same_v<Real, double> || want[i].v > 1e-33L)
          run.measure(relative_error(state.v[i], want[i].v), tolerance_of<Real>(2e-5), at);
      }
    }
  });
}

void adam_sparse(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const AdamParams params;
    for (const std::int32_t cols : {1, 2, 8, 3}) {  // widths with kernels of their own, and one without
      constexpr std::size_t kRows = 10;
      const auto width = static_cast<std::size_t>(cols);
      Parameters<Real> lazy(kRows, cols), dense(kRows, cols);
      std::vector<Reference> want_lazy(lazy.value.size()), want_dense(lazy.value.size());
      Numbers numbers(62);
      for (std::int64_t step = 0; step < 6000; ++step) {
        const Corrections correction(params, step);
        const std::size_t hit = static_cast<std::size_t>(step % 1000);  // row r at r, 1000 + r, ...
        std::fill(dense.grad.begin(), dense.grad.end(), Real(0));
        if (hit < kRows) {
          for (std::size_t c = 0; c < width; ++c) {
            const auto g = static_cast<Real>(numbers.in(0.5, 1.5));
            lazy.grad[hit * width + c] = dense.grad[hit * width + c] = g;
          }
        }
        for (std::size_t i = 0; i < want_dense.size(); ++i) {
          const auto g = static_cast<long double>(dense.grad[i]);
          if (g != 0) want_lazy[i].update(params, g, correction);
          if (step < 2500) want_dense[i].update(params, g, correction);
        }
        const AdamStep rule = adam_step(params, params.learning_rate, step);
        run.expect(lazy.touched(rule) == (hit < kRows ? 1 : 0), "rows touched");
        if (step < 2500) dense.dense(rule);
      }
      for (std::size_t i = 0; i < lazy.value.size(); ++i) {
        check(run, lazy, i, want_lazy[i], tolerance_of<Real>(1e-5), "lazy rule");
        check(run, dense, i, want_dense[i], tolerance_of<Real>(1e-5), "dense rule");
        run.expect(lazy.grad[i] == Real(0), "a touched row's gradient is cleared");
      }
      run.expect(std::abs(want_lazy[0].x - want_dense[0].x) > 1e-4L, "the two rules are told apart");
    }
    run.note("lazy: moments of an untouched row stay, bias correction counts all steps");
  });
}

void adam_epsilon(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    std::string first_zero = "none";
    for (const double epsilon : {1e-15, 1e-8}) {
      AdamParams params{.epsilon = epsilon};
      constexpr int kSizes = 14;
      Parameters<Real> state(kSizes);
      std::vector<Reference> want(kSizes);
      for (std::int64_t step = 0; step < 300; ++step) {
        const Corrections correction(params, step);
        for (std::size_t i = 0; i < kSizes; ++i) {
          state.grad[i] = static_cast<Real>(std::pow(10.0, -9 - static_cast<int>(i)));
          want[i].update(params, static_cast<long double>(state.grad[i]), correction);
        }
        state.dense(adam_step(params, params.learning_rate, step));
      }
      for (std::size_t i = 0; i < kSizes; ++i) {
        check(run, state, i, want[i], tolerance_of<Real>(1e-5), fmt::format("gradient 1e-{}", 9 + i));
        if (state.v[i] == Real(0) && first_zero == "none") first_zero = fmt::format("1e-{}", 9 + i);
      }
    }
    run.expect((first_zero == "none") == std::is_same_v<Real, double>, "squares underflow in fp32 alone");
    run.note("v is 0 from gradient " + first_zero + " on: epsilon alone then scales the step");
  });
}

void adam_zero(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const std::vector<Real> starts{Real(0),
                                   Real(-0.0),
                                   Real(1),
                                   Real(-1e-30),
                                   std::numeric_limits<Real>::denorm_min(),
                                   std::numeric_limits<Real>::max(),
                                   Real(1) / Real(3),
                                   Real(-7e8)};
    for (const std::int32_t cols : {1, 2, 4, 8}) {
      Parameters<Real> dense(8 / static_cast<std::size_t>(cols), cols),
          sparse(8 / static_cast<std::size_t>(cols), cols);
      dense.value = sparse.value = starts;
      for (std::size_t i = 0; i < 8; ++i) sparse.m[i] = sparse.v[i] = Real(0.25);  // rows hit before, not now
      std::int64_t touched = 0;
      for (std::int64_t step = 0; step < 1000; ++step) {
        const AdamStep rule = adam_step({}, 5e-4, step);
        dense.dense(rule);
        touched += sparse.touched(rule);
      }
      const std::size_t bytes = 8 * sizeof(Real);
      run.expect(std::memcmp(dense.value.data(), starts.data(), bytes) == 0, "dense: the same bits");
      run.expect(std::memcmp(sparse.value.data(), starts.data(), bytes) == 0, "sparse: the same bits");
      run.expect(touched == 0, "no row was touched");
      for (std::size_t i = 0; i < 8; ++i) {
        run.measure(static_cast<double>(std::abs(dense.m[i]) + std::abs(dense.v[i])), 0, "moments stay 0");
        run.expect(sparse.m[i] == Real(0.25) && sparse.v[i] == Real(0.25), "moments of untouched rows stay");
      }
    }
    run.note("no weight decay");
  });
}

void counters(CaseRun& run) {
  run.row("float64");
  const std::int64_t steps[] = {
      0, 1, 9, 999, 100000, (std::int64_t{1} << 31) - 1, std::int64_t{1} << 31, std::int64_t{1} << 53};
  for (const auto& [beta1, beta2] : {std::pair{0.9, 0.999}, std::pair{0.0, 0.99999999}, std::pair{0.999999, 0.9}}) {
    AdamParams params{.beta1 = beta1, .beta2 = beta2};
    for (const std::int64_t step : steps) {
      const AdamStep rule = adam_step(params, 5e-4, step);
      const long double t = static_cast<long double>(step) + 1;
      const auto power = [&](double beta) {
        return beta == 0 ? 0.0L : std::exp(t * std::log(static_cast<long double>(beta)));
      };
      const auto correction = [&](double beta) {
        return beta == 0 ? 1.0L : -std::expm1(t * std::log(static_cast<long double>(beta)));
      };
      run.measure(relative_error(rule.step_size, 5e-4 / correction(beta1)), 1e-12, "step size");
      run.measure(relative_error(rule.root_scale, 1 / std::sqrt(correction(beta2))), 1e-12, "root scale");
      run.expect(power(beta1) < 1 && std::isfinite(rule.step_size) && std::isfinite(rule.root_scale), "finite");
    }
  }
  const long double pi = 3.14159265358979323846264338327950288L;
  for (const std::int64_t end : {std::int64_t{1}, std::int64_t{250000}, std::int64_t{1} << 31}) {
    for (const std::int64_t warmup : {std::int64_t{0}, std::int64_t{100}}) {
      for (const std::int64_t step : {std::int64_t{0}, std::int64_t{1}, warmup - 1, warmup, end - 1, end, end + 1,
                                      2 * end, std::int64_t{1} << 33}) {
        if (step < 0) continue;
        const long double progress = static_cast<long double>(step) / static_cast<long double>(end);
        const long double rise =
            step < warmup ? static_cast<long double>(step + 1) / static_cast<long double>(warmup) : 1.0L;
        ScheduleParams schedule{.decay_steps = end, .warmup_steps = warmup};
        const auto check_factor = [&](ScheduleKind kind, long double want, const char* what) {
          schedule.kind = kind;
          run.measure(std::max(0.0, static_cast<double>(
                                        std::abs(static_cast<long double>(schedule_factor(schedule, step)) - want)) -
                                        5e-324) /
                          std::max(1e-300, static_cast<double>(want)),
                      1e-12, what);
        };
        check_factor(ScheduleKind::constant, rise, "constant");
        check_factor(ScheduleKind::exponential,
                     rise * std::pow(static_cast<long double>(schedule.factor), std::min(progress, 1.0L)),
                     "exponential, held at the end");
        const auto floor = static_cast<long double>(schedule.factor);
        check_factor(ScheduleKind::cosine,
                     rise * (floor + (1 - floor) * (1 + std::cos(pi * std::min(progress, 1.0L))) / 2), "cosine");
      }
    }
  }
  run.row("fp32");
  // One step of a parameter that has seen 2^31: the corrections are 1, so the plain moments count.
  Parameters<float> state(1);
  state.grad[0] = 0.5f;
  state.m[0] = 0.25f;
  state.v[0] = 0.0625f;
  state.dense(adam_step({}, 5e-4, std::int64_t{1} << 31));
  const long double m = 0.9L * 0.25L + 0.1L * 0.5L, v = 0.999L * 0.0625L + 0.001L * 0.25L;
  run.measure(relative_error(state.value[0], -5e-4L * m / (std::sqrt(v) + 1e-8L)), 1e-6, "step after 2^31 steps");
}

}  // namespace semfield::numerics
