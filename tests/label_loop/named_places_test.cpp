// Places of clicks and strokes: one in each cell of the pool, found once, a few at a time.
#include <gtest/gtest.h>

#include <set>

#include "tests/label_loop/looped_room.h"

namespace semfield {
namespace {

using namespace testing_loop;

// Every pixel of a view.
LabelledPixels whole_view(int view, std::int16_t class_index = 0) {
  LabelledPixels stroke{view, class_index, {}};
  for (std::int32_t i = 0; i < 48 * 36; ++i) stroke.pixels.push_back({i % 48, i / 48});
  return stroke;
}

struct Places {
  LoopedRoom room{60};
  NamedPlaces places{4};
  NamedPlaces::Surface surface{*room.training->session().pipeline, room.training->session().limits, room.loop->views(),
                               room.loop->pool()};
};

TEST(NamedPlaces, AStrokeHasOnePlaceInEachCellThatItCovers) {
  Places p;
  const std::vector<LabelledPixels> strokes{whole_view(2)};
  ASSERT_TRUE(p.places.find(strokes, p.surface, 1e9));
  std::set<std::int32_t> seen(p.surface.pool.point_of_pixel[2].begin(), p.surface.pool.point_of_pixel[2].end());
  seen.erase(-1);
  const auto nothing = static_cast<std::size_t>(
      std::count(p.surface.pool.point_of_pixel[2].begin(), p.surface.pool.point_of_pixel[2].end(), -1));
  EXPECT_GT(p.places.of(0).size(), seen.size() / 2);
  EXPECT_LE(p.places.of(0).size(), std::min<std::size_t>(256, seen.size() + nothing));
}

TEST(NamedPlaces, AClickHasItsOwnPlaceFirst) {
  Places p;
  const LabelledPixels click = p.room.click(1, {20, 18});
  const std::vector<LabelledPixels> clicks{click};
  ASSERT_TRUE(p.places.find(clicks, p.surface, 1e9));
  const RayCamera& camera = p.surface.views[1].camera;
  const double distance = surface_distances(p.surface.pipeline, camera, p.surface.limits, click.pixels).front();
  EXPECT_LT(length(p.places.of(0).front() - point_at(camera, p.surface.limits, {20, 18}, distance)), 1e-6);
  EXPECT_GT(p.places.of(0).size(), 1u) << "and what looks alike around it";
}

TEST(NamedPlaces, AreFoundOnceAndAFewAtATime) {
  Places p;
  std::vector<LabelledPixels> clicks = p.room.clicks(4);
  EXPECT_FALSE(p.places.find(clicks, p.surface, 0)) << "one at least, and no more without time";
  EXPECT_FALSE(p.places.of(0).empty());
  EXPECT_TRUE(p.places.of(1).empty());
  int turns = 1;
  while (!p.places.find(clicks, p.surface, 0)) ++turns;
  EXPECT_EQ(turns, 3);
  const std::int64_t found = p.places.found();
  EXPECT_EQ(found, 4);
  clicks.push_back(p.room.click(3, {30, 20}));
  clicks.erase(clicks.begin());
  EXPECT_TRUE(p.places.find(clicks, p.surface, 0));
  EXPECT_EQ(p.places.found(), found + 1) << "those of earlier clicks are kept";
  p.places.renew();
  EXPECT_TRUE(p.places.find(clicks, p.surface, 0));
  EXPECT_EQ(p.places.found(), found + 1) << "old ones serve meanwhile";
  p.places.refresh(clicks, p.surface, 1e9);
  EXPECT_EQ(p.places.found(), found + 5);
  p.places.refresh(clicks, p.surface, 1e9);
  EXPECT_EQ(p.places.found(), found + 5);
}

// What is learned from does not grow with the strokes over the same surface, and each weighs as it did.
TEST(NamedPlaces, ManyStrokesOverTheSameSurfaceCountItOnce) {
  LoopedRoom room;
  std::vector<LabelledPixels> strokes{whole_view(2)};
  room.loop->learn(strokes);
  const std::size_t once = room.loop->learned_points();
  EXPECT_GT(once, 50u);
  for (int i = 0; i < 20; ++i) strokes.push_back(whole_view(2));
  room.loop->learn(strokes);
  EXPECT_EQ(room.loop->learned_points(), once);
}

}  // namespace
}  // namespace semfield
