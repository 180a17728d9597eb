// Adam: decay, bad gradients, ranges and threads. Cases E01 to E08 of tests/numerics compare it with long double.
#include "model/optim/adam.h"

#include <gtest/gtest.h>

#include "compute/parallel.h"
#include "core/rng.h"

namespace semfield {
namespace {

template <class Real>
struct State {
  explicit State(std::int64_t rows, std::int32_t cols = 1)
      : value(static_cast<std::size_t>(rows * cols)), grad(value), m(value), v(value), rows_(rows), cols_(cols) {}
  View<Real> view(std::vector<Real>& x) { return View<Real>(x.data(), rows_, cols_); }
  void dense(const AdamStep& step) { adam_dense<Real>(step, view(value), view(grad), view(m), view(v), 0, rows_); }
  std::int64_t touched(const AdamStep& step) {
    return adam_touched<Real>(step, view(value), view(grad), view(m), view(v), 0, rows_);
  }
  std::vector<Real> value, grad, m, v;
  std::int64_t rows_;
  std::int32_t cols_;
};

TEST(Adam, DecayTakesItsShareBeforeTheUpdate) {
  State<double> plain(3), decayed(3);
  AdamStep step = adam_step(AdamParams{}, 0.01, 5);
  for (std::size_t i = 0; i < 3; ++i) {
    plain.value[i] = decayed.value[i] = 1.0 + static_cast<double>(i);
    plain.grad[i] = decayed.grad[i] = 0.5 - static_cast<double>(i);
  }
  plain.dense(step);
  step.decay = 0.25;
  decayed.dense(step);
  for (std::size_t i = 0; i < 3; ++i)
    EXPECT_NEAR(decayed.value[i], plain.value[i] - 0.25 * (1.0 + static_cast<double>(i)), 1e-15);
}

TEST(Adam, TouchedGivesTheSameBitsForAnyRangesAndWidths) {
  for (const std::int32_t cols : {1, 2, 3, 4, 8}) {
    constexpr std::int64_t kRows = 1003;
    State<float> whole(kRows, cols), ranges(kRows, cols), dense(kRows, cols);
    std::int64_t want_touched = 0;
    for (std::int64_t r = 0; r < kRows; ++r) {
      const bool hit = r % 5 == 1 || (r > 500 && r < 600);
      want_touched += hit ? 1 : 0;
      for (std::int32_t c = 0; c < cols; ++c) {
        const auto i = static_cast<std::size_t>(r * cols + c);
        // One element of the row suffices: the others are updated with a zero gradient.
        const float g = hit && c == r % cols ? uniform01({9, 0, 1}, i) + 0.1f : 0.f;
        for (auto* s : {&whole, &ranges, &dense}) {
          s->grad[i] = g;
          s->value[i] = hit ? uniform01({9, 0, 2}, i) : -0.f;
          s->m[i] = hit ? uniform01({9, 0, 3}, i) : 1e-41f;
          s->v[i] = hit ? uniform01({9, 0, 4}, i) : 3e-39f;
        }
      }
    }
    const State<float> before = whole;
    const AdamStep step = adam_step({}, 1e-2, 7);
    EXPECT_EQ(whole.touched(step), want_touched);
    dense.dense(step);
    std::int64_t touched = 0;
    const std::vector<std::int64_t> cuts{0, 1, 4, 333, 340, 1001, kRows};
    for (std::size_t k = 0; k + 1 < cuts.size(); ++k)
      touched += adam_touched<float>(step, ranges.view(ranges.value), ranges.view(ranges.grad), ranges.view(ranges.m),
                                     ranges.view(ranges.v), cuts[k], cuts[k + 1] - cuts[k]);
    EXPECT_EQ(touched, want_touched);
    EXPECT_EQ(whole.value, ranges.value) << cols;
    EXPECT_EQ(whole.m, ranges.m);
    EXPECT_EQ(whole.v, ranges.v);
    EXPECT_EQ(whole.grad, std::vector<float>(whole.grad.size(), 0.f));
    for (std::int64_t r = 0; r < kRows; ++r) {
      const bool hit = r % 5 == 1 || (r > 500 && r < 600);
      for (std::int32_t c = 0; c < cols; ++c) {
        const auto i = static_cast<std::size_t>(r * cols + c);
        const State<float>& source = hit ? dense : before;
        ASSERT_EQ(whole.value[i], source.value[i]) << cols << " columns, row " << r;
        ASSERT_EQ(std::signbit(whole.value[i]), std::signbit(source.value[i]));
        ASSERT_EQ(whole.m[i], source.m[i]);
        ASSERT_EQ(whole.v[i], source.v[i]);
      }
    }
  }
}

TEST(Adam, FirstNonFiniteIsFoundAnywhere) {  // E05
  std::vector<float> g(10000, 1.f);
  const View<float> view(g.data(), 5000, 2);
  EXPECT_EQ(first_non_finite<float>(view), -1);
  EXPECT_EQ(first_non_finite<float>({}), -1);
  for (const float bad :
       {std::nanf(""), std::numeric_limits<float>::infinity(), -std::numeric_limits<float>::infinity()}) {
    for (const std::size_t at :
         {std::size_t{0}, std::size_t{1}, std::size_t{4095}, std::size_t{4096}, std::size_t{9999}}) {
      g[at] = bad;
      g[9999] = at == 9999 ? bad : std::nanf("");
      EXPECT_EQ(first_non_finite<float>(view), static_cast<std::int64_t>(at));
      g[at] = g[9999] = std::numeric_limits<float>::max();
    }
  }
}

// E05: what no update may start from, in every array, whole tensors and touched rows.
TEST(Adam, UnsoundElementsAreFoundInEveryArray) {
  constexpr std::size_t kSize = 70003 * 2;  // two parallel ranges and a block that is not whole
  std::vector<float> arrays[4];
  for (auto& array : arrays) array.assign(kSize, 0.5F);
  const auto look = [&](bool touched) {
    const auto view = [&](int i) { return View<const float>(arrays[i].data(), kSize / 2, 2); };
    return first_unsound<float>(view(0), view(1), view(2), view(3), touched);
  };
  const char* const names[] = {"value", "gradient", "first moment", "second moment"};
  const float inf = std::numeric_limits<float>::infinity();
  for (const bool touched : {false, true}) {
    EXPECT_EQ(look(touched).element, -1);
    for (int i = 0; i < 4; ++i) {
      for (const std::size_t at : {std::size_t{0}, std::size_t{65535}, std::size_t{65541}, kSize - 1}) {
        for (const float bad : {std::nanf(""), inf, -inf, i == 3 ? -1e-30F : -2e19F, i == 3 ? 2e38F : 2e19F}) {
          arrays[i][at] = bad;
          const Unsound<float> found = look(touched);
          EXPECT_EQ(found.element, static_cast<std::int64_t>(at)) << names[i] << ' ' << bad;
          EXPECT_STREQ(found.array, names[i]);
          arrays[i][at] = 0.5F;
        }
      }
    }
  }
  // A row that no gradient touches is not visited, and not looked at.
  for (std::size_t i = 0; i < 32; ++i) arrays[1][64 + i] = 0;
  arrays[2][80] = inf;
  EXPECT_EQ(look(true).element, -1);
  EXPECT_EQ(look(false).element, 80);
}

// Sound numbers stay finite: the update from the corner of what is let through.
TEST(Adam, AnUpdateFromTheLargestSoundNumbersIsFinite) {
  for (const double epsilon : {1e-8, 1e-15}) {
    for (const float m : {-kLargestSound<float>, kLargestSound<float>}) {
      for (const float v : {0.F, kLargestSound<float> * kLargestSound<float>}) {
        float x = kLargestSound<float>, g = -m, mean = m, square = v;
        AdamParams params{.epsilon = epsilon};
        adam_dense<float>(adam_step(params, 1.0, 0), {&x, 1, 1}, {&g, 1, 1}, {&mean, 1, 1}, {&square, 1, 1}, 0, 1);
        EXPECT_TRUE(std::isfinite(x) && std::isfinite(mean) && std::isfinite(square))
            << x << ' ' << mean << ' ' << square;
      }
    }
  }
}

TEST(Adam, TheFirstNonFiniteIsTheSameForAnyThreads) {
  std::vector<float> g(700000, 1.f);  // many parallel ranges
  g[699999] = g[300001] = g[200003] = std::nanf("");
  for (int threads : {1, 2, 3}) {
    set_thread_count(threads);
    EXPECT_EQ(first_non_finite<float>(View<const float>(g.data(), 350000, 2)), 200003);
  }
  set_thread_count(0);
}

TEST(Adam, SameBitsForAnyRangesAndThreads) {
  constexpr std::int64_t kRows = 100003;
  State<float> whole(kRows, 2), ranges(kRows, 2), threads(kRows, 2), lazy(kRows, 2), lazy_threads(kRows, 2);
  for (std::size_t i = 0; i < 2 * kRows; ++i) {
    const float g = i % 7 < 2 ? 0.f : uniform01({9, 0, 1}, i) - 0.5f;
    for (auto* s : {&whole, &ranges, &threads, &lazy, &lazy_threads}) s->grad[i] = g;
  }
  const AdamStep step = adam_step({}, 1e-3, 5);
  whole.dense(step);
  for (const auto& [begin, count] : {std::pair<std::int64_t, std::int64_t>{0, 1}, {1, 77776}, {77777, kRows - 77777}})
    adam_dense<float>(step, ranges.view(ranges.value), ranges.view(ranges.grad), ranges.view(ranges.m),
                      ranges.view(ranges.v), begin, count);
  const std::int64_t touched = lazy.touched(step);
  const int before = thread_count();
  set_thread_count(2);
  adam_dense_parallel<float>(step, threads.view(threads.value), threads.view(threads.grad), threads.view(threads.m),
                             threads.view(threads.v));
  EXPECT_EQ(
      adam_touched_parallel<float>(step, lazy_threads.view(lazy_threads.value), lazy_threads.view(lazy_threads.grad),
                                   lazy_threads.view(lazy_threads.m), lazy_threads.view(lazy_threads.v)),
      touched);
  set_thread_count(before);
  EXPECT_LT(touched, kRows);
  EXPECT_EQ(whole.value, ranges.value);
  EXPECT_EQ(whole.value, threads.value);
  EXPECT_EQ(whole.v, threads.v);
  EXPECT_EQ(lazy.value, lazy_threads.value);
  EXPECT_EQ(lazy.m, lazy_threads.m);
}

// Learning-rate schedules: holds and legs. Case E07 has their formulas and warm-up.

TEST(Schedule, ExponentialToTheBit) { EXPECT_EQ(schedule_factor({}, 12345), std::pow(0.1, 12345.0 / 250000.0)); }

TEST(Schedule, TheRateIsHeldBeforeItFallsAndWhileItsEndIsUnknown) {
  ScheduleParams params{.decay_steps = 0};
  for (const std::int64_t step : {0, 1, 99999}) EXPECT_EQ(schedule_factor(params, step), 1) << step;
  params.hold_steps = 100;
  params.decay_steps = 300;
  for (const std::int64_t step : {0, 50, 100}) EXPECT_EQ(schedule_factor(params, step), 1) << step;
  EXPECT_NEAR(schedule_factor(params, 200), std::sqrt(0.1), 1e-15);
  EXPECT_NEAR(schedule_factor(params, 300), 0.1, 1e-15);
  params.hold_steps = 300;
  EXPECT_EQ(schedule_factor(params, 300), 1) << "nothing is left to fall in";
  EXPECT_EQ(schedule_factor(params, 301), 0.1);
}

TEST(Schedule, ALegHasItsOwnRateHoldAndEnd) {
  for (const ScheduleKind kind : {ScheduleKind::exponential, ScheduleKind::cosine}) {
    ScheduleParams params{.kind = kind, .decay_steps = 100, .legs = {{150, 0.5, 160, 200, 0}, {300, 0.4, 300, 0, 60}}};
    EXPECT_NEAR(schedule_factor(params, 149), 0.1, 1e-15);
    EXPECT_EQ(schedule_factor(params, 150), 0.5);
    EXPECT_EQ(schedule_factor(params, 160), 0.5);
    EXPECT_LT(schedule_factor(params, 161), 0.5);
    EXPECT_GT(schedule_factor(params, 199), 0.1);
    EXPECT_NEAR(schedule_factor(params, 250), 0.1, 1e-15);
    EXPECT_EQ(schedule_factor(params, 300), 0.4);
    EXPECT_EQ(schedule_factor(params, 5000), 0.4) << "its end is not settled";
  }
}

TEST(Schedule, AShareOfTheRunBeginsAtItsStepAndNotBeforeTheRateFalls) {
  ScheduleParams params;
  EXPECT_EQ(step_of_share(0, 0, params), 0);
  EXPECT_EQ(step_of_share(0.2, 100, params), 20);
  EXPECT_EQ(step_of_share(0.201, 100, params), 21);
  EXPECT_GT(step_of_share(0.2, 0, params), 1000000000) << "nobody knows how long the run is";
  params.hold_steps = 30;
  EXPECT_EQ(step_of_share(0.2, 100, params), 30);
  EXPECT_EQ(step_of_share(0.5, 100, params), 50);
}

}  // namespace
}  // namespace semfield
