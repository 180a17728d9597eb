// Groups of points by clusters of segments and by what views say.
#include <gtest/gtest.h>

#include <algorithm>
#include <set>

#include "objects/find_objects.h"

namespace semfield {
namespace {

constexpr std::int32_t kWidth = 3;

// A strip of cells along x, one point each, at y = 0.
struct Strip {
  explicit Strip(std::int32_t cells) : pool(1.0, 0) {
    for (std::int32_t i = 0; i < cells; ++i) {
      pool.cells.add(SurfaceCell{i, 0, 0});
      PoolPoint point;
      point.position = {i + 0.5, 0.5, 0.5};
      pool.points.push_back(point);
    }
    place.assign(static_cast<std::size_t>(cells * kWidth), 0);
  }
  void put(std::int32_t begin, std::int32_t end, float value) {
    for (std::int32_t i = begin; i < end; ++i) place[static_cast<std::size_t>(i * kWidth)] = value;
  }
  // A view in which segment k covers [borders[k], borders[k + 1]).
  void view(const std::vector<std::int32_t>& borders) {
    SegmentSights to;
    to.first.push_back(0);
    for (std::size_t k = 0; k + 1 < borders.size(); ++k) {
      for (std::int32_t i = borders[k]; i < borders[k + 1]; ++i) {
        to.point.push_back(i);
        to.segment.push_back(static_cast<std::int32_t>(k));
      }
      to.first.push_back(static_cast<std::int32_t>(to.point.size()));
      to.class_of.push_back(kVoid);
    }
    sights.push_back(to);
  }
  std::vector<std::int32_t> groups(const ClusterRules& rules = {.neighbours = 2, .least_points = 3},
                                   std::span<const bool> stuff = {}) const {
    return cluster_points(pool, {{place.data(), std::ssize(pool.points), kWidth}, stuff}, sights, rules);
  }
  SurfacePool pool;
  std::vector<float> place;
  std::vector<SegmentSights> sights;
};

TEST(Clusters, ThingsThatTouchAreToldApartByTheirSegments) {
  Strip strip(40);
  strip.put(0, 25, 0);
  strip.put(25, 40, 1);
  strip.put(24, 26, 0.5);  // the network blurs the border
  for (int k = 0; k < 4; ++k) strip.view({0, 25, 40});
  const std::vector<std::int32_t> group = strip.groups();
  for (std::int32_t i = 0; i < 40; ++i) EXPECT_EQ(group[static_cast<std::size_t>(i)], i < 25 ? 0 : 1) << i;
}

TEST(Clusters, AThingThatAnotherHidesInTheMiddleIsOne) {
  Strip strip(60);
  strip.put(20, 40, 1);
  SegmentSights behind;  // one segment on both sides
  for (int k = 0; k < 4; ++k) {
    strip.view({0, 20, 40, 60});
    SegmentSights& view = strip.sights.back();
    for (std::int32_t& s : view.segment) s = s == 2 ? 0 : s;
    std::stable_sort(view.point.begin(), view.point.end(), [](std::int32_t a, std::int32_t b) {
      const auto middle = [](std::int32_t i) { return i >= 20 && i < 40; };
      return middle(a) < middle(b);
    });
    std::stable_sort(view.segment.begin(), view.segment.end());
    view.first = {0, 40, 60};
    view.class_of.resize(2);
  }
  const std::vector<std::int32_t> group = strip.groups();
  EXPECT_EQ(group[5], group[55]);
  EXPECT_NE(group[5], group[30]);
}

TEST(Clusters, EqualPlacesFarApartThatNoViewSeesTogetherAreTwo) {
  Strip strip(60);
  strip.put(20, 40, 1);
  for (int k = 0; k < 4; ++k) {
    strip.view({0, 20, 40});
    strip.view({20, 40, 60});
  }
  const std::vector<std::int32_t> group = strip.groups();
  EXPECT_EQ(std::set<std::int32_t>(group.begin(), group.end()).size(), 3u);
  EXPECT_NE(group[5], group[55]);
}

TEST(Clusters, SegmentsThatSplitAThingInAFewViewsDoNotSplitIt) {
  Strip strip(40);
  for (int k = 0; k < 6; ++k) strip.view({0, 40});
  strip.view({0, 17, 40});
  strip.view({0, 30, 40});
  const std::vector<std::int32_t> group = strip.groups();
  EXPECT_EQ(std::set<std::int32_t>(group.begin(), group.end()), std::set<std::int32_t>{0});
}

TEST(Clusters, StuffAndWhatIsTooSmallAreNoObjects) {
  Strip strip(40);
  strip.put(20, 22, 1);
  strip.put(22, 40, 2);
  for (int k = 0; k < 4; ++k) strip.view({0, 20, 22, 40});
  std::unique_ptr<bool[]> stuff(new bool[40]{});
  std::fill(stuff.get() + 22, stuff.get() + 40, true);
  const std::vector<std::int32_t> group = strip.groups({.neighbours = 2, .least_points = 3}, {stuff.get(), 40});
  EXPECT_EQ(group[5], 0);
  EXPECT_EQ(group[21], 0) << "what is too small goes to the group beside it";
  EXPECT_EQ(group[30], -1);
}

}  // namespace
}  // namespace semfield
