// Tests of the occupancy-grid sampler: jumps against step-by-step marching, certified skipping, updates, laws.
#include "samplers/occupancy_grid/occupancy_grid.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "tests/linked_registry.h"
#include "tests/numerics/ray_bench.h"

namespace semfield {
namespace {

SamplerBuild room() { return SamplerBuild{.bounds = {{-2, -2, -1}, {3, 2, 2}}, .near_m = 0.05, .far_m = 12}; }

// Density of a ball at (0.5, 0, 0.5), radius 0.8, over a thin haze.
template <class Real>
DensityQuery<Real> ball(double inside, double haze) {
  return [=](View<const double> p, View<Real> sigma) {
    for (std::int64_t i = 0; i < p.rows; ++i) {
      const double x = p(i, 0) - 0.5, y = p(i, 1), z = p(i, 2) - 0.5;
      *sigma.row(i) = static_cast<Real>(x * x + y * y + z * z < 0.64 ? inside : haze);
    }
  };
}

template <class Real>
struct Bench : numerics::RayBench<Real> {
  explicit Bench(const OccupancyGridParams& p)
      : numerics::RayBench<Real>(std::make_unique<OccupancyGrid<Real>>(p, room(), tables())),
        grid(static_cast<OccupancyGrid<Real>&>(*this->sampler)) {
    this->ctx.seed = 3;
  }
  static const KernelTables& tables() { return testkit::linked_registry().kernels(); }
  void learn(const DensityQuery<Real>& query, std::int64_t steps) {
    for (std::int64_t s = 0; s < steps; ++s) {
      this->ctx.step = s;
      this->ctx.training = true;
      grid.observe(this->ctx, this->box.values_only(), query);
    }
    this->ctx.training = false;
  }
  const unsigned char* bits() const { return reinterpret_cast<const unsigned char*>(this->box.value(1).data); }
  std::vector<Real> of_ray(const std::vector<Real>& values, std::int64_t r) const {
    return {values.begin() + this->first[r], values.begin() + this->first[r + 1]};
  }
  // Rays from a corner of the room in many directions.
  void shoot(std::int64_t rays) {
    this->set_rays(rays, 0.05, 12.0);
    for (std::int64_t r = 0; r < rays; ++r) {
      const auto random = [&](int i) {
        return static_cast<double>(uniform01({8, 0, 1}, static_cast<std::uint64_t>(8 * r + i)));
      };
      const Vec3d d = normalized(Vec3d{random(0) - 0.5, random(1) - 0.5, random(2) - 0.5});
      for (int i = 0; i < 3; ++i) {
        this->origin[3 * r + i] = room().bounds.lo[i] + (0.05 + 0.9 * random(3 + i)) * room().bounds.size()[i];
        this->direction[3 * r + i] = d[i];
      }
    }
    this->draw();
  }
  OccupancyGrid<Real>& grid;
};

OccupancyGridParams small_grid() {
  return OccupancyGridParams{.resolution = 32, .max_samples = 2048, .warmup_steps = 64};
}

// Lattice indices whose cell is marked occupied, looked at one by one.
template <class Real>
std::vector<Real> brute_force(Bench<Real>& bench, std::int64_t r) {
  const OccupancyGeometry& g = bench.grid.geometry();
  const double* o = &bench.origin[3 * r];
  const double* d = &bench.direction[3 * r];
  double enter = 0, leave = 0;
  std::vector<Real> result;
  if (!intersect(g.outer(), {o[0], o[1], o[2]}, {d[0], d[1], d[2]}, enter, leave)) return result;
  const double near_m = std::max(0.05, enter), far_m = std::min(12.0, leave);
  const auto n = static_cast<std::int64_t>(std::ceil((far_m - near_m) / g.step_m));
  const CellRay ray(g, o, d);
  for (std::int64_t i = 0; i < n; ++i) {
    const double t = near_m + (static_cast<double>(i) + 0.5) * ((far_m - near_m) / static_cast<double>(n));
    if (!is_empty_cell<Real>(bench.bits(), ray.cell_at(g, t).index(g.n))) result.push_back(static_cast<Real>(t));
  }
  return result;
}

TEST(OccupancyGrid, JumpsGiveTheSamplesOfStepByStepMarching) {
  for (const std::int64_t cascades : {1, 3}) {
    OccupancyGridParams params = small_grid();
    params.cascades = cascades;
    params.resolution = cascades == 1 ? 64 : 32;
    params.skip = SkipRule::threshold;
    Bench<double> bench(params);
    bench.learn(ball<double>(50, 0), 80);
    bench.shoot(300);
    std::size_t total = 0;
    for (std::int64_t r = 0; r < 300; ++r) {
      const std::vector<double> want = brute_force(bench, r);
      ASSERT_EQ(bench.of_ray(bench.t, r), want) << "ray " << r;
      total += want.size();
    }
    EXPECT_GT(total, 1000u);
    EXPECT_LT(total, 300u * 200u);  // most of the lattice is empty
  }
}

// A fog in the shape of a wedge, striped, behind a post of 2 cm: as a field has them after a minute.
double density_of_wedge_and_post(double x, double y) {
  const bool post = std::fabs(x + 0.49) < 0.01 && std::fabs(y - 0.21) < 0.01;
  return post ? 500 : x > 0.5 + 0.3 * y && x < 1.5 + 0.3 * y ? 3 : 0;
}

// Colour of each pixel of a view of it.
std::vector<double> picture_of_wedge_and_post(std::int64_t max_samples) {
  constexpr std::int64_t kWidth = 96, kHeight = 24;
  OccupancyGridParams params = small_grid();
  params.resolution = 64;
  params.skip = SkipRule::threshold;
  params.max_samples = max_samples;
  Bench<double> bench(params);
  bench.learn(
      [](View<const double> p, View<double> sigma) {
        for (std::int64_t i = 0; i < p.rows; ++i) *sigma.row(i) = density_of_wedge_and_post(p(i, 0), p(i, 1));
      },
      80);
  bench.set_rays(kWidth * kHeight, 0.05, 12.0);
  for (std::int64_t r = 0; r < kWidth * kHeight; ++r) {
    const double across = static_cast<double>(r % kWidth) / kWidth - 0.5;
    const double up = static_cast<double>(r / kWidth) / kWidth - 0.125;
    const Vec3d d = normalized(Vec3d{1, 0.8 * across, 0.8 * up});
    for (int i = 0; i < 3; ++i) {
      bench.origin[3 * r + i] = i == 0 ? -1.9 : 0.1;
      bench.direction[3 * r + i] = d[i];
    }
  }
  bench.draw();
  std::vector<double> picture;
  for (std::int64_t r = 0; r < kWidth * kHeight; ++r) {
    double light = 1, color = 0;
    for (std::int32_t s = bench.first[r]; s < bench.first[r + 1]; ++s) {
      const double x = -1.9 + bench.t[s] * bench.direction[3 * r], y = 0.1 + bench.t[s] * bench.direction[3 * r + 1];
      const double opacity = 1 - std::exp(-density_of_wedge_and_post(x, y) * bench.delta[s]);
      color += light * opacity * (x < 0 ? 1 : 0.25 + 0.25 * std::sin(40 * x));
      light *= 1 - opacity;
    }
    picture.push_back(color);
  }
  return picture;
}

TEST(OccupancyGrid, PicturesHaveNeitherSquaresNorCombs) {
  const std::vector<double> want = picture_of_wedge_and_post(65536), got = picture_of_wedge_and_post(48);
  int off = 0;
  for (std::size_t i = 0; i < want.size(); ++i) off += std::fabs(got[i] - want[i]) > 1.0 / 64 ? 1 : 0;
  EXPECT_EQ(off, 0) << "of " << want.size() << " pixels";
  EXPECT_GT(*std::max_element(want.begin(), want.end()), 0.9) << "no post";
}

TEST(UnrolledDistance, IsTheIdentityNearbyAndDoublesItsStepsWithTheDistance) {
  const UnrolledDistance distance{0.7};
  for (const double t : {0.0, 0.1, 0.69, 0.7}) {
    EXPECT_EQ(distance.of(t), t);
    EXPECT_EQ(distance.back(t), t);
  }
  EXPECT_EQ(distance.of(1.4), 1.4);  // the first octave has the step of what is before it
  EXPECT_DOUBLE_EQ(distance.of(2.8), 2.1);
  EXPECT_DOUBLE_EQ(distance.of(0.7 * 1024), 0.7 * 11);
  double before = -1;
  for (int i = 0; i < 20000; ++i) {
    const double t = 1e-3 * std::pow(1.002, i), unrolled = distance.of(t);
    if (unrolled > 600) break;
    EXPECT_NEAR(distance.back(unrolled), t, 1e-13 * t * std::max(1.0, unrolled));
    EXPECT_GT(unrolled, before);
    before = unrolled;
  }
  EXPECT_NEAR(distance.back(distance.of(1e300)) / 1e300, 1, 1e-12);
}

OccupancyGridParams growing_grid() {
  OccupancyGridParams params = small_grid();
  params.cascades = 6;
  params.growth = 0.05;
  params.skip = SkipRule::threshold;
  return params;
}

TEST(OccupancyGrid, GrowingStepsTileTheRayAndStayBelowTheirShare) {
  Bench<double> bench(growing_grid());
  bench.shoot(100);  // nothing is left out yet
  const OccupancyGeometry& g = bench.grid.geometry();
  for (std::size_t r = 0; r < 100; ++r) {
    double border = 0.05, longest = 0;
    for (std::int32_t k = bench.first[r]; k < bench.first[r + 1]; ++k) {
      EXPECT_GT(bench.t[k], border);
      border += bench.delta[k];
      EXPECT_LT(bench.t[k], border);
      EXPECT_LE(bench.delta[k], std::max(g.step_m, 0.05 * bench.t[k]) * (1 + 1e-9));
      longest = std::max(longest, bench.delta[k]);
    }
    EXPECT_NEAR(border, 12, 1e-9);  // the last cascade reaches farther
    EXPECT_GT(longest, 16 * g.step_m);
  }
}

TEST(OccupancyGrid, GrowingStepsJumpAsStepByStepMarchingGoes) {
  OccupancyGridParams params = growing_grid();
  Bench<double> all(params), bench(params);
  all.shoot(300);
  bench.learn(ball<double>(50, 0), 80);
  bench.shoot(300);
  const OccupancyGeometry& g = bench.grid.geometry();
  std::size_t kept = 0;
  for (std::int64_t r = 0; r < 300; ++r) {
    const CellRay ray(g, &bench.origin[3 * r], &bench.direction[3 * r]);
    std::vector<double> want, lengths;
    for (std::int32_t k = all.first[r]; k < all.first[r + 1]; ++k) {
      if (is_empty_cell<double>(bench.bits(), ray.cell_at(g, all.t[k]).index(g.n))) continue;
      want.push_back(all.t[k]);
      lengths.push_back(all.delta[k]);
    }
    ASSERT_EQ(bench.of_ray(bench.t, r), want) << "ray " << r;
    ASSERT_EQ(bench.of_ray(bench.delta, r), lengths) << "ray " << r;
    kept += want.size();
  }
  EXPECT_GT(kept, 500u);
  EXPECT_LT(kept, static_cast<std::size_t>(all.out.count) / 3);
}

// As thin a medium hides as much behind it where steps are twice as long.
TEST(OccupancyGrid, GrowingStepsLowerTheThresholdOfOuterCascades) {
  const auto occupied = [](double growth) {
    OccupancyGridParams params = growing_grid();
    params.growth = growth;
    Bench<double> bench(params);
    // 0.7 of the threshold of the finest cells everywhere, a dense ball that keeps the mean high.
    const double haze = 0.7 * params.threshold / bench.grid.geometry().step_m;
    bench.learn(ball<double>(1e7, haze), 80);
    const std::int64_t of_cascade = bench.grid.geometry().cells_per_cascade();
    return std::array{!is_empty_cell<double>(bench.bits(), 0), !is_empty_cell<double>(bench.bits(), of_cascade)};
  };
  EXPECT_EQ(occupied(0.05), (std::array<bool, 2>{false, true}));
  EXPECT_EQ(occupied(0), (std::array<bool, 2>{false, false}));
}

TEST(OccupancyGrid, EverySampleNearTheBallIsKept) {
  OccupancyGridParams params = small_grid();
  params.update_every = 1;  // cells that the ball only grazes need many draws
  Bench<float> bench(params);
  bench.learn(ball<float>(50, 0), 80);
  bench.shoot(200);
  for (std::int64_t r = 0; r < 200; ++r) {
    // Length inside the ball, from the geometry, against the length that the samples inside it cover.
    const double* o = &bench.origin[3 * r];
    const double* d = &bench.direction[3 * r];
    const Vec3d to{0.5 - o[0], -o[1], 0.5 - o[2]};
    const double along = to.x * d[0] + to.y * d[1] + to.z * d[2];
    const double gap2 = 0.64 - (dot(to, to) - along * along);
    const double half = gap2 > 0 ? std::sqrt(gap2) : 0;
    const double want = std::max(0.0, along + half - std::max(0.05, along - half));
    double covered = 0;
    for (std::int32_t k = bench.first[r]; k < bench.first[r + 1]; ++k) {
      const double t = static_cast<double>(bench.t[k]);
      if (std::abs(t - along) < half) covered += static_cast<double>(bench.delta[k]);
    }
    EXPECT_NEAR(covered, gap2 > 0 ? want : 0, 2 * bench.grid.geometry().step_m) << "ray " << r;
  }
}

// Optical depth of the haze that samples leave out, the most over all rays.
double largest_loss(SkipRule rule, double haze) {
  OccupancyGridParams params = small_grid();
  params.skip = rule;
  Bench<double> bench(params);
  bench.learn(ball<double>(50, haze), 80);
  bench.shoot(200);
  double worst = 0;
  for (std::int64_t r = 0; r < 200; ++r) {
    double enter = 0, leave = 0, covered = 0;
    const double* o = &bench.origin[3 * r];
    const double* d = &bench.direction[3 * r];
    intersect(bench.grid.geometry().outer(), {o[0], o[1], o[2]}, {d[0], d[1], d[2]}, enter, leave);
    for (std::int32_t k = bench.first[r]; k < bench.first[r + 1]; ++k) covered += bench.delta[k];
    worst = std::max(worst, haze * (std::min(12.0, leave) - std::max(0.05, enter) - covered));
  }
  return worst;
}

TEST(OccupancyGrid, CertifiedSkippingKeepsItsBudget) {
  for (const double haze : {1e-5, 1e-3, 0.1, 1.0})
    EXPECT_LE(largest_loss(SkipRule::certified, haze), 1e-3 + 1e-9) << haze;
  EXPECT_GT(largest_loss(SkipRule::certified, 1e-5), 0);
  EXPECT_GT(largest_loss(SkipRule::threshold, 0.1), 0.1);  // what the budget is there to prevent
}

TEST(OccupancyGrid, NothingIsLeftOutDuringWarmUpOrWithoutAnyDensity) {
  Bench<float> bench(small_grid());
  bench.shoot(20);
  const std::int64_t all = bench.out.count;
  bench.learn(ball<float>(50, 0), 40);
  bench.shoot(20);
  EXPECT_EQ(bench.out.count, all);
  Bench<float> dead(small_grid());
  dead.learn(ball<float>(0, 0), 200);
  dead.shoot(20);
  EXPECT_EQ(dead.out.count, all);
  Bench<float> even(small_grid());  // equal densities below the threshold: occupied, not empty
  even.learn(ball<float>(0.01, 0.01), 200);
  even.shoot(20);
  EXPECT_EQ(even.out.count, all);
}

TEST(OccupancyGrid, FollowsAFieldThatMoves) {
  OccupancyGridParams params = small_grid();
  params.update_share = 0.25;
  Bench<float> bench(params);
  bench.learn(ball<float>(50, 0), 80);
  const float before = bench.box.value(3).data[2];
  EXPECT_NEAR(before, 2.14 / (5.1 * 4.1 * 3.1), 0.01);  // the ball's share of the padded room
  for (std::int64_t s = 80; s < 80 + 16 * 110; s += 16) {
    bench.ctx.step = s;
    bench.grid.observe(bench.ctx, bench.box.values_only(), ball<float>(0, 20));  // inside out
  }
  EXPECT_NEAR(bench.box.value(3).data[2], 1 - before, 0.02);
}

TEST(OccupancyGrid, StateIsFiniteWhateverTheDensity) {  // a checkpoint refuses anything else
  Bench<float> bench(small_grid());
  bench.learn(
      [](View<const double> p, View<float> sigma) {
        for (std::int64_t i = 0; i < p.rows; ++i)
          *sigma.row(i) = static_cast<float>(std::exp(8 * std::sin(5 * p(i, 0) + p(i, 1) * p(i, 2))));
      },
      129);
  for (std::size_t i = 0; i < 4; ++i)
    for (const float v : std::span(bench.box.value(i).data, bench.box.value(i).rows))
      ASSERT_TRUE(std::isfinite(v)) << i;
}

// Case B11 of tests/numerics has steps that are scarce.
TEST(OccupancyGrid, ARayThatMissesTheGridHasNoSamples) {
  Bench<float> bench(small_grid());
  bench.set_rays(1, 0, 1e7);
  bench.origin = {1e5, 1e5, 1e5};
  bench.draw();
  EXPECT_EQ(bench.out.count, 0);
}

TEST(OccupancyGrid, RefusesWhatItCannotUse) {
  SamplerBuild build = room();
  build.bounds = Box{};
  EXPECT_THROW((OccupancyGrid<float>({}, build, Bench<float>::tables())), Error);
  OccupancyGridParams params{.resolution = 100};
  Diagnostics diagnostics;
  validate(params, diagnostics);
  EXPECT_EQ(diagnostics.error_count(), 1);
  Bench<float> bench(small_grid());
  EXPECT_THROW(bench.learn(ball<float>(NAN, 0), 1), Error);
}

}  // namespace
}  // namespace semfield
