// Compositing of part of the rays, its gradients against finite differences, and the addresses of density noise. Group
// A and cases D11, D16 and D17 of tests/numerics compare both with closed forms and long double.

#include <algorithm>

#include "adam_rows.h"
#include "model/losses/loss_list.h"
#include "model/stages.h"
#include "rays_of_slabs.h"
#include "testkit/compare.h"
#include "testkit/laws.h"
#include "testkit/loss_rays.h"
#include "tests/linked_registry.h"
#include "tests/says.h"
#include "tests/threads.h"

namespace semfield {
namespace {

using testing::AdamRows;
using testing::RayBuffers;
using testing::TestNumbers;

template <class Real>
class Compositor : public ::testing::Test {};
using Reals = ::testing::Types<float, double>;
TYPED_TEST_SUITE(Compositor, Reals);

TYPED_TEST(Compositor, HiddenMayCoverTheFirstRaysAlone) {
  RayBuffers<TypeParam> rays({2, 3, 2}, 37);
  rays.space_evenly(2);
  TestNumbers random{7};
  for (auto& s : rays.sigma) s = static_cast<TypeParam>(random.in(0, 2));
  for (auto& h : rays.hidden) h = static_cast<TypeParam>(random.in(-1, 1));
  for (auto& g : rays.g_hidden) g = static_cast<TypeParam>(random.in(-1, 1));
  rays.forward();
  rays.backward();
  const auto all_hidden = rays.out_hidden, all_d_hidden = rays.d_hidden, all_d_sigma = rays.d_sigma;
  std::fill(rays.out_hidden.begin(), rays.out_hidden.end(), TypeParam(-5));
  std::fill(rays.d_hidden.begin(), rays.d_hidden.end(), TypeParam(-5));
  CompositeIn<TypeParam> in = rays.in();
  CompositeOut<TypeParam> out = rays.out();
  CompositeGrad<TypeParam> grad = rays.grad();
  in.hidden = in.hidden.row_range(0, 5);
  out.hidden = out.hidden.row_range(0, 2);
  grad.hidden = grad.hidden.row_range(0, 2);
  composite_forward(in, out);
  composite_backward(in, out, grad, rays.col(rays.d_sigma), rays.mat(rays.d_rgb, 3),
                     rays.mat(rays.d_hidden, 37).row_range(0, 5));
  for (std::size_t i = 0; i < 2 * 37; ++i) EXPECT_EQ(rays.out_hidden[i], all_hidden[i]);
  for (std::size_t i = 2 * 37; i < 3 * 37; ++i) EXPECT_EQ(rays.out_hidden[i], TypeParam(-5));
  for (std::size_t i = 0; i < 5 * 37; ++i) EXPECT_EQ(rays.d_hidden[i], all_d_hidden[i]);
  for (std::size_t i = 5 * 37; i < 7 * 37; ++i) EXPECT_EQ(rays.d_hidden[i], TypeParam(-5));
  for (std::size_t k = 0; k < 5; ++k) EXPECT_EQ(rays.d_sigma[k], all_d_sigma[k]);
  for (std::size_t k = 5; k < 7; ++k) EXPECT_EQ(rays.d_sigma[k], 0);
}

TEST(CompositorGradient, DotsStandForHiddenActivationsOfTheFirstRays) {
  RayBuffers<float> rays({8, 5, 6}, 5);
  rays.space_evenly(1);
  rays.fill_random(12, 1.0);
  std::fill(rays.g_hidden.begin() + 10, rays.g_hidden.end(), 0.f);  // of the last ray
  rays.forward();
  rays.backward();
  const std::vector<float> whole = rays.d_sigma;
  std::vector<float> dots(13);
  for (std::size_t k = 0; k < dots.size(); ++k) {
    for (std::size_t c = 0; c < 5; ++c) dots[k] += rays.g_hidden[5 * (k < 8 ? 0 : 1) + c] * rays.hidden[5 * k + c];
  }
  CompositeIn<float> in = rays.in();
  CompositeGrad<float> grad = rays.grad();
  in.hidden = {};
  grad.hidden = {};
  grad.dotted_rays = 2;
  grad.dots = View<const float>(dots.data(), 13, 1);
  composite_backward(in, rays.out(), grad, rays.col(rays.d_sigma), {}, {});
  for (std::size_t k = 0; k < whole.size(); ++k)
    EXPECT_NEAR(rays.d_sigma[k], whole[k], 1e-5 * (1 + std::abs(whole[k]))) << k;
}

// Rounds of part of each ray, or all at once: the samples in front of which 1e-3 of the light is left, which are those
// that weigh something.
TYPED_TEST(Compositor, LightReachesTheSamplesInFrontOfTheDark) {
  RayBuffers<TypeParam> rays({0, 1, 40, 33, 0, 100}, 0);
  rays.space_evenly(2);
  TestNumbers random{11};
  for (auto& s : rays.sigma) s = static_cast<TypeParam>(random.in(0, 20));
  rays.sigma[3] = TypeParam(1e30);
  rays.forward();
  const Stages<TypeParam>& stages = cpu_stages<TypeParam>();
  std::vector<std::int32_t> in_rounds, at_once;
  Workspace arena;
  for (const ReachedBy part : {ReachedBy{0, 8, 1e-3}, {8, 16, 1e-3}, {16, 200, 1e-3}, {0, 200, 1e-3}}) {
    const Workspace::Scope scope(arena);
    const ChosenSamples<TypeParam> chosen =
        stages.reached(arena, rays.samples, rays.col(rays.sigma), part, rays.rows());
    ASSERT_EQ(chosen.samples.first(rays.rays(), 0), chosen.samples.count);
    for (std::int64_t k = 0; k < chosen.samples.count; ++k) {
      const std::int32_t m = chosen.source(k, 0), ray = rays.ray[static_cast<std::size_t>(m)];
      EXPECT_EQ(chosen.samples.t(k, 0), rays.t[static_cast<std::size_t>(m)]);
      EXPECT_EQ(chosen.samples.delta(k, 0), rays.delta[static_cast<std::size_t>(m)]);
      EXPECT_EQ(chosen.samples.ray_of_sample(k, 0), ray);
      EXPECT_LE(chosen.samples.first(ray, 0), k);
      EXPECT_GT(chosen.samples.first(ray + 1, 0), k);
      (part.end == 200 && part.begin == 0 ? at_once : in_rounds).push_back(m);
    }
  }
  std::sort(in_rounds.begin(), in_rounds.end());
  EXPECT_EQ(in_rounds, at_once);
  for (std::int32_t r = 0; r < rays.rays(); ++r) {
    double passed = 1;
    for (std::int32_t m = rays.first[static_cast<std::size_t>(r)]; m < rays.first[static_cast<std::size_t>(r) + 1];
         ++m) {
      const bool chosen = std::binary_search(at_once.begin(), at_once.end(), m);
      EXPECT_TRUE(chosen == (passed > 1e-3) || std::abs(passed - 1e-3) < 1e-6) << "ray " << r << ", sample " << m;
      passed -= static_cast<double>(rays.weight[static_cast<std::size_t>(m)]);
    }
  }
}

TEST(CompositorGradient, RaysDoNotTouchEachOther) {
  RayBuffers<float> both({40, 7}, 33), alone({7}, 33);
  both.fill_random(3, 1.0);
  both.space_evenly(2);
  alone.take_inputs(both);
  both.forward();
  both.backward();
  alone.forward();
  alone.backward();
  EXPECT_TRUE(std::equal(alone.d_sigma.begin(), alone.d_sigma.end(), both.d_sigma.end() - 7));
  EXPECT_TRUE(std::equal(alone.d_hidden.begin(), alone.d_hidden.end(), both.d_hidden.end() - 7 * 33));
}

TEST(DensityNoise, IsNormalAndIndependentOfTiles) {
  const int rays = 64, n = 100;
  std::vector<std::int32_t> first;
  for (int r = 0; r <= rays; ++r) first.push_back(r * n);
  std::vector<double> whole(rays * n, 1.0), part(10 * n, 1.0);
  const RandomAddress address{3, 4, stream_id("noise")};
  add_density_noise<double>(address, 5, View<const std::int32_t>(first.data(), rays + 1, 1), 2.0,
                            View<double>(whole.data(), rays * n, 1));
  add_density_noise<double>(address, 5 + 20, View<const std::int32_t>(first.data(), 11, 1), 2.0,
                            View<double>(part.data(), 10 * n, 1));
  for (int i = 0; i < 10 * n; ++i) ASSERT_EQ(part[i], whole[20 * n + i]);
  double mean = 0, square = 0;
  for (const double x : whole) {
    mean += (x - 1) / (rays * n);
    square += (x - 1) * (x - 1) / (rays * n);
  }
  EXPECT_NEAR(mean, 0, 4 * 2.0 / std::sqrt(rays * n));
  EXPECT_NEAR(square, 4, 4 * 4 * std::sqrt(2.0 / (rays * n)));
}

using testkit::LossRays;

// The list of losses: which work, what their means are over, and what a list may not hold.

const std::vector<int> kCounts{7, 0, 1, 12, 3, 5};

LossList list_of(const std::vector<std::pair<std::string, testkit::Settings>>& losses) {
  std::vector<LossEntry> entries;
  for (const auto& [type, settings] : losses) {
    const PluginEntry& entry = testkit::linked_registry().get(PluginKind::loss, type);
    entries.push_back({type, entry.loss(*testkit::make_params(entry, settings)), nullptr, "here"});
  }
  return LossList(std::move(entries));
}

TEST(LossList, ActiveLossesAreMeansOverTheRaysThatCount) {
  const LossList list = list_of({{"distortion", {{"weight", "0.5"}}}, {"depth", {{"weight", "0.25"}}}});
  LossRays<double> rays(kCounts);
  const LossScales early = list.scales(2, rays.targets(), rays.rays()), late = list.scales(~0U, rays.targets(), 6);
  EXPECT_EQ(early.active, 2u);
  EXPECT_EQ(late.active, 3u);
  EXPECT_EQ(early.scale[0], 0);
  EXPECT_EQ(late.count[0], 6);
  EXPECT_EQ(late.count[1], 3) << "rays 0, 3 and 4 have depth";
  EXPECT_EQ(late.scale[0], 0.5 / 6);
  EXPECT_EQ(late.scale[1], 0.25 / 3);
  EXPECT_EQ(list.moving(channel::depth), 2u);
  EXPECT_EQ(list.moving(channel::weight), 1u);
  EXPECT_EQ(list.on_logits() | list.on_heads() | list.reading_heads(), 0u);
  LossNumbers sums{};
  list.add(late.active, late, rays.targets(), rays.values(), rays.gradients(), sums);
  LossRays<double> alone(kCounts);
  const double distortion = alone.add(*list.entries()[0].loss, 0), depth = alone.add(*list.entries()[1].loss, 0);
  EXPECT_DOUBLE_EQ(list.finish(late, sums), 0.5 * distortion / 6 + 0.25 * depth / 3);
  EXPECT_DOUBLE_EQ(sums[1], depth / 3);
}

TEST(LossList, ABatchWithoutDepthIsNoLossAndNoDivisionByZero) {
  const LossList list = list_of({{"depth", {}}});
  LossRays<double> rays(kCounts);
  std::fill(rays.depth_target.begin(), rays.depth_target.end(), 0.0F);
  const LossScales scales = list.scales(~0U, rays.targets(), rays.rays());
  LossNumbers sums{};
  list.add(scales.active, scales, rays.targets(), rays.values(), rays.gradients(), sums);
  EXPECT_EQ(list.finish(scales, sums), 0);
  EXPECT_EQ(sums[0], 0);
  for (const double d : rays.d_depth) EXPECT_EQ(d, 0);
}

TEST(LossList, LossesOnLogitsAndOnOtherHeadsAreApart) {
  const LossList list = list_of({{"distortion", {}}, {"cosine_distance", {}}, {"generalised_cross_entropy", {}}});
  EXPECT_EQ(list.on_heads(), 2u);
  EXPECT_EQ(list.reading_heads(), 2u);
  EXPECT_EQ(list.on_logits(), 4u);
}

struct BothParams : LossRule {};
class Both final : public LossOf<Both, BothParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override { return {.moves = {channel::logits, channel::color}}; }
  template <class Real>
  double sum(const RayTargets&, const RayValues<Real>&, double, const RayGradients<Real>&) const {
    return 0;
  }
};

// Gradients of heads are made before the others where a branch stands between.
TEST(LossList, ALossMovesHeadsOrThePassAndNotBoth) {
  const std::vector<LossEntry> both{{"both", std::make_shared<Both>(), nullptr, ""}};
  EXPECT_HAS(error_of(ErrorKind::config, [&] { const LossList list(both); }), "'both'");
}

// Adam: bad gradients, ranges and threads. Cases E01 to E08 of tests/numerics compare it with long double.

TEST(Adam, TouchedGivesTheSameBitsForAnyRangesAndWidths) {
  for (const std::int32_t cols : {1, 2, 3, 4, 8}) {
    constexpr std::int64_t kRows = 1003;
    AdamRows<float> whole(kRows, cols), ranges(kRows, cols), dense(kRows, cols);
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
    const AdamRows<float> before = whole;
    const AdamStep step = adam_step({}, 1e-2, 7);
    EXPECT_EQ(whole.touched(step), want_touched);
    dense.dense(step);
    std::int64_t touched = 0;
    const std::vector<std::int64_t> cuts{0, 1, 4, 333, 340, 1001, kRows};
    for (std::size_t k = 0; k + 1 < cuts.size(); ++k) touched += ranges.touched(step, cuts[k], cuts[k + 1] - cuts[k]);
    EXPECT_EQ(touched, want_touched);
    EXPECT_EQ(whole.value, ranges.value) << cols;
    EXPECT_EQ(whole.m, ranges.m);
    EXPECT_EQ(whole.v, ranges.v);
    EXPECT_EQ(whole.grad, std::vector<float>(whole.grad.size(), 0.f));
    for (std::int64_t r = 0; r < kRows; ++r) {
      const bool hit = r % 5 == 1 || (r > 500 && r < 600);
      for (std::int32_t c = 0; c < cols; ++c) {
        const auto i = static_cast<std::size_t>(r * cols + c);
        const AdamRows<float>& source = hit ? dense : before;
        ASSERT_EQ(whole.value[i], source.value[i]) << cols << " columns, row " << r;
        ASSERT_EQ(std::signbit(whole.value[i]), std::signbit(source.value[i]));
        ASSERT_EQ(whole.m[i], source.m[i]);
        ASSERT_EQ(whole.v[i], source.v[i]);
      }
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

TEST(Adam, TheFirstNonFiniteIsTheSameForAnyThreads) {
  std::vector<float> g(700000, 1.f);  // many parallel ranges
  g[699999] = g[300001] = g[200003] = std::nanf("");
  for (int threads : {1, 2, 3}) {
    const ThreadScope scope(threads);
    EXPECT_EQ(first_non_finite<float>(View<const float>(g.data(), 350000, 2)), 200003);
  }
}

TEST(Adam, SameBitsForAnyRangesAndThreads) {
  constexpr std::int64_t kRows = 100003;
  AdamRows<float> whole(kRows, 2), ranges(kRows, 2), threads(kRows, 2), lazy(kRows, 2), lazy_threads(kRows, 2);
  for (std::size_t i = 0; i < 2 * kRows; ++i) {
    const float g = i % 7 < 2 ? 0.f : uniform01({9, 0, 1}, i) - 0.5f;
    for (auto* s : {&whole, &ranges, &threads, &lazy, &lazy_threads}) s->grad[i] = g;
  }
  const AdamStep step = adam_step({}, 1e-3, 5);
  whole.dense(step);
  for (const auto& [begin, count] : {std::pair<std::int64_t, std::int64_t>{0, 1}, {1, 77776}, {77777, kRows - 77777}})
    ranges.dense(step, begin, count);
  const std::int64_t touched = lazy.touched(step);
  const ThreadScope scope(2);
  const auto tensor = [](AdamRows<float>& of, bool touched_only) {
    return AdamTensor<float>{of.value.data(), of.grad.data(), of.m.data(), of.v.data(), kRows, 2, touched_only};
  };
  const std::array tensors{tensor(threads, false), tensor(lazy_threads, true)};
  adam_update<float>(&step, {tensors.data(), 2, 4 * kRows});
  EXPECT_LT(touched, kRows);
  EXPECT_EQ(whole.value, ranges.value);
  EXPECT_EQ(whole.value, threads.value);
  EXPECT_EQ(whole.v, threads.v);
  EXPECT_EQ(lazy.value, lazy_threads.value);
  EXPECT_EQ(lazy.m, lazy_threads.m);
}

// Learning-rate schedules: holds and legs. Case E07 has their formulas and warm-up.

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
