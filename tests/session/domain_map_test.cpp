// The map from the world to encoders: affine inside, all of space drawn in outside, against its own inverse.
#include "model/domain_map.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "core/rng.h"

namespace semfield {
namespace {

const Box kBounds{{-1, 2, 3}, {3, 4, 5}};  // longest side 4, centre (1, 3, 4)

DomainMap contracted() { return DomainMap::make(Domain::unit_cube, kBounds, 0, true); }

// Addressed places from `least` to `most` radii (2 each) away, in all directions.
Vec3d place(int i, double least, double most) {
  const auto random = [i](int k) {
    return static_cast<double>(uniform01({5, 0, 2}, static_cast<std::uint64_t>(8 * i + k)));
  };
  const Vec3d way = normalized(Vec3d{random(0) - 0.5, random(1) - 0.5, random(2) - 0.5});
  return kBounds.center() + way * (2 * least * std::pow(most / least, random(3)));
}

double reach(Vec3d p) {
  const Vec3d q = p - kBounds.center();
  return std::max({std::abs(q.x), std::abs(q.y), std::abs(q.z)});
}

TEST(DomainMap, WithoutContractionItIsAffine) {
  const DomainMap map = DomainMap::make(Domain::unit_cube, kBounds, 0);
  EXPECT_EQ(map.radius, 0);
  const Vec3d far = map({101, 3, 4});
  EXPECT_EQ(far.x, 25.5);
  EXPECT_EQ(DomainMap::make(Domain::metric, kBounds, 0.1)({7, 8, 9}).y, 8 * 0.1);
}

TEST(DomainMap, BoundsTakeTheInnerHalfAndKeepTheirShape) {
  const DomainMap map = contracted();
  EXPECT_EQ(map({-1, 3, 4}), (Vec3d{0.25, 0.5, 0.5}));
  EXPECT_EQ(map({3, 4, 5}), (Vec3d{0.75, 0.625, 0.625}));
  const DomainMap metric = DomainMap::make(Domain::metric, kBounds, 0.1, true);
  EXPECT_EQ(metric({3, 3, 4}), (Vec3d{0.5, 0, 0}));
}

TEST(DomainMap, AllOfSpaceFitsTheCube) {
  const DomainMap map = contracted();
  for (int i = 0; i < 3000; ++i) {
    const Vec3d x = map(place(i, 1e-3, 1e12));
    for (int a = 0; a < 3; ++a) {
      EXPECT_GE(x[a], 0);
      EXPECT_LE(x[a], 1);
    }
  }
  EXPECT_EQ(map({1e300, 3, 4}).x, 1);  // as good as infinity: the face, and no NaN
  EXPECT_EQ(map({-1e300, -1e300, 1e300}), (Vec3d{0, 0, 1}));
}

TEST(DomainMap, ExpandIsTheInverse) {
  const DomainMap map = contracted();
  for (int i = 0; i < 3000; ++i) {
    const Vec3d p = place(i, 1e-2, 1e4), back = map.expand(map.contract(p));
    // An ulp near the face of the cube is a large part of the distance to it.
    const double steep = std::max(1.0, reach(p) / map.radius);
    EXPECT_LT(length(back - p), 1e-14 * steep * length(p)) << i;
  }
}

TEST(DomainMap, ItIsContinuousAcrossTheBordersAndItsSlopeIsBounded) {
  const DomainMap map = contracted();
  double steepest = 0, flattest_inside = 1;
  for (int i = 0; i < 2000; ++i) {
    const Vec3d on = place(i, 0.5, 50);
    const double h = 1e-6 * reach(on);
    // On the border itself, where the formula changes.
    const Vec3d border = kBounds.center() + (on - kBounds.center()) * (map.radius / reach(on));
    const Vec3d within = map.contract(kBounds.center() + (border - kBounds.center()) * (1 - 1e-9));
    const Vec3d beyond = map.contract(kBounds.center() + (border - kBounds.center()) * (1 + 1e-9));
    EXPECT_LT(length(beyond - within), 1e-8 * map.radius);
    for (int a = 0; a < 3; ++a) {
      Vec3d step;
      step[a] = h;
      const Vec3d slope = (map.contract(on + step) - map.contract(on - step)) * (1 / (2 * h));
      steepest = std::max(steepest, length(slope));
      if (reach(on) < 0.99 * map.radius) flattest_inside = std::min(flattest_inside, length(slope));
    }
    // Farther places stay farther: nothing is folded.
    EXPECT_GT(reach(map.contract(kBounds.center() + (on - kBounds.center()) * 1.01)), reach(map.contract(on)));
  }
  EXPECT_NEAR(flattest_inside, 1, 1e-6);
  EXPECT_LE(steepest, 1.25);  // |(2 - 1/m) / m| <= 1 along, at most 1/2 more across each of two other axes
}

}  // namespace
}  // namespace semfield
