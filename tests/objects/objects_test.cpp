// Clicks as objects: which points of a surface a click means, and clicks from a file.

#include <algorithm>
#include <cmath>
#include <set>

#include "formats/image_io.h"
#include "formats/npz.h"
#include "labels/segments.h"
#include "scene/scene.h"
#include "surface/objects/find_objects.h"
#include "surface/objects/object_network.h"
#include "surface/objects/object_score.h"
#include "surface/objects/object_set.h"
#include "testkit/compare.h"
#include "tests/linked_registry.h"
#include "tests/says.h"
#include "tests/temp_dir.h"
#include "tests/threads.h"

namespace semfield {
namespace {

constexpr std::int16_t kWall = 0, kChair = 1;

// A row of ten cells, each a pixel of one view.
struct Row {
  ObjectSurface surface;
  TouchingCells touching;
  std::vector<std::int16_t> class_of;

  // 'c': a point of a chair, 'w': of a wall, '.': nothing is there.
  explicit Row(const std::string& cells) {
    surface.pool = SurfacePool(1.0, 1);
    PoolView view;
    view.camera.camera.width_px = view.map.width_px = static_cast<std::int32_t>(cells.size());
    view.camera.camera.height_px = view.map.height_px = 1;
    view.map.stride = 1;
    surface.views.push_back(view);
    std::vector<std::int32_t>& of_pixel = surface.pool.point_of_pixel[0];
    std::vector<std::vector<std::int32_t>> near;
    for (std::size_t x = 0; x < cells.size(); ++x) {
      of_pixel.push_back(-1);
      if (cells[x] == '.') continue;
      PoolPoint point;
      point.position = {static_cast<double>(x) + 0.5, 0.5, 0.5};
      of_pixel.back() = surface.pool.cells.add(point.position);
      surface.pool.points.push_back(point);
      class_of.push_back(cells[x] == 'c' ? kChair : kWall);
      near.push_back({of_pixel.back()});
      if (x == 0 || cells[x - 1] == '.') continue;
      near.back().push_back(of_pixel.back() - 1);
      near[near.size() - 2].push_back(of_pixel.back());
    }
    touching.first.push_back(0);
    for (const std::vector<std::int32_t>& of_cell : near) {
      touching.of.insert(touching.of.end(), of_cell.begin(), of_cell.end());
      touching.first.push_back(static_cast<std::int32_t>(touching.of.size()));
    }
  }

  struct Click {
    int x, class_index, object;
    double radius_px = 0;
  };
  // Objects of the pixels, a digit each.
  std::string objects(const std::vector<Click>& clicks, std::int64_t least = 1) const {
    std::vector<Annotations::Mark> marks;
    for (const Click& click : clicks)
      marks.push_back({"a", 0, {{click.x + 0.5, 0.5}}, click.radius_px, click.class_index, false, click.object});
    const std::vector<std::int32_t> id = clicked_objects(surface, touching, class_of, {true, false}, marks, least).id;
    std::string out;
    for (const std::int32_t point : surface.pool.point_of_pixel[0])
      out += point < 0 ? '.' : static_cast<char>('0' + id[static_cast<std::size_t>(point)]);
    return out;
  }
};

TEST(ClickObjects, PiecesThatDoNotTouchAreObjectsOfTheirOwn) {
  const Row row("ccwwccc.cc");
  EXPECT_EQ(row.objects({{0, kChair, 0}, {5, kChair, 0}}), "1100222.00") << "nobody clicked the last chair";
  EXPECT_EQ(row.objects({{5, kChair, 0}, {0, kChair, 0}, {6, kChair, 0}}), "2200111.00")
      << "ids in the order of clicks";
}

TEST(ClickObjects, NumbersTellTouchingThingsApartAndJoinPieces) {
  const Row row("wcccccccc.cw");
  EXPECT_EQ(row.objects({{2, kChair, 0}, {7, kChair, 0}}), "011111111.00");
  EXPECT_EQ(row.objects({{2, kChair, 1}, {7, kChair, 2}}),
            "01111222"
            "2.00")
      << "the nearer click";
  EXPECT_EQ(row.objects({{2, kChair, 0}, {7, kChair, 2}}),
            "01111222"
            "2.00")
      << "another chair than the first";
  EXPECT_EQ(row.objects({{2, kChair, 3}, {10, kChair, 3}}), "011111111.10");
}

TEST(ClickObjects, StuffAndVoidAreNoObjectsAndHoldObjectsBack) {
  const Row row("wcccccccw");
  EXPECT_EQ(row.objects({{0, kWall, 0}, {8, kWall, 4}}), "000000000");
  EXPECT_EQ(row.objects({{1, kChair, 0}, {7, kVoid, 0}}), "011110000");
  EXPECT_EQ(row.objects({{3, kVoid, 0}, {3, kChair, 0}}), "011111110") << "the last click at a place counts";
  EXPECT_EQ(row.objects({{0, kChair, 0}}), "111111110") << "the field says wall there, and a person says chair";
}

// A click as wide as five cells over the rim of a chair: what is behind the rim is neither the chair's nor an object.
TEST(ClickObjects, OneClickIsOneObjectAndTheSurfaceAroundIt) {
  const Row row("wwwcccccc.w.c");
  EXPECT_EQ(row.objects({{8, kChair, 0, 2.2}}, 3), "000111111.0.0") << "the wall beyond the gap is no thing of a point";
  EXPECT_EQ(row.objects({{2, kChair, 0, 2.2}}, 3), "111111111.0.0") << "what touches under a click is one thing";
  EXPECT_EQ(row.objects({{12, kChair, 0}, {5, kChair, 0}}, 3), "000111111.0.0") << "a chair of one point";
  EXPECT_EQ(row.objects({{12, kChair, 2}, {5, kChair, 2}}, 3), "000111111.0.1") << "a piece of the chair";
  EXPECT_EQ(row.objects({{10, kChair, 2}, {5, kChair, 2}}, 3), "000111111.0.0") << "no piece of it";
  EXPECT_EQ(row.objects({{10, kChair, 0}}, 3), "000000000.0.0");
}

// The field has not learned the click: it is of the surface around it.
TEST(ClickObjects, AClickThatTheFieldDoesNotSeeIsTheSurfaceAroundIt) {
  EXPECT_EQ(Row("wwwwwcwwww").objects({{5, kChair, 0}}, 3), "0000111000");
  EXPECT_EQ(Row("wwwww").objects({{2, kChair, 0}}, 3), "01110");
  EXPECT_EQ(Row("wwwww").objects({{2, kChair, 0}, {3, kWall, 0}}, 3), "11100") << "as far as no other click is nearer";
  EXPECT_EQ(Row("ww.ww").objects({{1, kChair, 0}}, 3), "00.00") << "no surface of three points";
}

TEST(ClickObjects, ClicksThatClaimNothingAreTold) {
  const Row row("cccc.w.c");
  std::vector<Annotations::Mark> marks;
  for (const int x : {5, 0, 7, 4}) marks.push_back({"a", 0, {{x + 0.5, 0.5}}, 0, kChair, false, 0});
  const ClickedObjects told = clicked_objects(row.surface, row.touching, row.class_of, {true, false}, marks, 2);
  EXPECT_EQ(told.unclaimed, (std::vector<std::size_t>{0, 2, 3}));
  EXPECT_EQ(told.class_of, std::vector<std::int16_t>{kChair});
}

SceneInfo room_info() {
  SceneInfo info;
  info.classes = ClassTable({{1, "wall", {}, false}, {2, "chair", {}, false}, {3, "lamp", {}, false}});
  FrameInfo& frame = info.frames.emplace_back();
  frame.name = "a";
  frame.camera.width_px = 8;
  frame.camera.height_px = 4;
  return info;
}

constexpr const char* kChairs =
    R"({"id":"n","type":"class","name":"chair"}
{"id":"a","type":"click","frame":"a","size":[16,8],"points":[[3,1]],"radius":2,"class":"chair"}
{"id":"b","type":"click","frame":"a","size":[16,8],"points":[[9,1]],"radius":2,"class":"chair","object":2}
{"id":"c","type":"click","frame":"a","size":[16,8],"points":[[9,5]],"radius":2,"class":"wall"}
{"id":"d","type":"undo","of":"c"}
)";

// The run has learned from the file, so that its table has the class that the file adds.
TEST(ClickObjects, ClicksOfAFileHaveTheClassesOfTheRun) {
  const TempDir dir;
  Diagnostics diagnostics;
  const SegmentSet set = segments_of_clicks(dir.write("clicks.jsonl", kChairs), room_info(), diagnostics);
  ASSERT_EQ(set.clicks.size(), 2u) << "one is undone";
  EXPECT_EQ(set.count(), 2);
  EXPECT_EQ(set.clicks[0].class_index, 1);
  EXPECT_EQ(set.clicks[0].object, 0);
  EXPECT_EQ(set.clicks[1].object, 2);
  EXPECT_EQ(set.clicks[1].points[0].x, 4.5) << "in pixels of the frame";
  EXPECT_EQ(set.frames.size(), 1u);
}

TEST(ClickObjects, WhatIsWrongIsNamed) {
  const TempDir dir;
  Diagnostics diagnostics;
  const auto read = [&](const std::string& text) {
    return segments_of_clicks(dir.write("clicks.jsonl", text), room_info(), diagnostics);
  };
  const std::string only_a_class = R"({"id":"n","type":"class","name":"piano"})"
                                   "\n";
  EXPECT_ERROR(read(only_a_class), "labels.clicks.empty", "clicks.jsonl");
  EXPECT_ERROR(
      read(only_a_class + R"({"id":"a","type":"click","frame":"a","size":[16,8],"points":[[3,1]],"radius":2,)" +
           "\"class\":\"piano\"}\n"),
      "labels.class.unknown", "clicks.jsonl", "piano");
}

// Groups of points by clusters of segments and by what views say.

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
                                   std::span<const std::int16_t> class_of = {}) const {
    return cluster_points(pool, {{place.data(), std::ssize(pool.points), kWidth}, class_of, {true, false, false}},
                          sights, rules);
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
  std::vector<std::int16_t> class_of(40, kChair);
  std::fill(class_of.begin() + 22, class_of.end(), kWall);
  const std::vector<std::int32_t> group = strip.groups({.neighbours = 2, .least_points = 3}, class_of);
  EXPECT_EQ(group[5], 0);
  EXPECT_EQ(group[21], 0) << "what is too small goes to the group beside it";
  EXPECT_EQ(group[30], -1);
}

// As a segmenter of everything gives them: parts lie in front of their whole in some views, pixels are in no mask, and
// numbers mean nothing from one view to the next.
TEST(Clusters, NestedMasksAndGapsOfASegmenter) {
  Strip strip(60);
  strip.put(30, 60, 1);
  for (const char* masks : {"aaaaaaaaaaaaaaaaaaaaaaaaaaaa...bbbbbbbbbbbbbbbbbbbbbbbbbbbb.",
                            "bbbbbbbbbbbbbbbbbbbbbbbbbbbbbb.aaaaaaaaaaaaaaaaaaaaaaaaaaaaa",
                            "aaaaaaaaaaccccccccaaaaaaaaaa...bbbbbbbbbbbbbbbbbbbbbbbbbbbb.",
                            "..aaaaaaaaaaaaaaaaaaaaaaaaaaaa............bbbbbbbbbbbbbbbbbb",
                            "cccccccccccccccccccccccccccccc.aaaaaaaaaaaaaaabbbbbbbbbbbbbb",
                            "...........................................aaaaaaaaaaaaaaaaa"}) {
    SegmentSights& view = strip.sights.emplace_back();
    view.first.push_back(0);
    for (const char mask : {'a', 'b', 'c'}) {
      for (std::int32_t i = 0; i < 60; ++i) {
        if (masks[i] != mask) continue;
        view.point.push_back(i);
        view.segment.push_back(view.segments());
      }
      if (std::ssize(view.point) == view.first.back()) continue;
      view.first.push_back(static_cast<std::int32_t>(view.point.size()));
      view.class_of.push_back(kVoid);
    }
  }
  const std::vector<std::int32_t> group = strip.groups();
  for (const std::int32_t i : {0, 14, 27}) EXPECT_EQ(group[static_cast<std::size_t>(i)], group[5]) << i;
  for (const std::int32_t i : {31, 44, 58}) EXPECT_EQ(group[static_cast<std::size_t>(i)], group[50]) << i;
  EXPECT_NE(group[5], group[50]);
}

// The network has put three books into one place; views tell them apart, and a chair of two segments stays one.
TEST(Clusters, ThingsOfOnePlaceComeApartWhereViewsPartThem) {
  Strip strip(60);
  strip.put(36, 60, 1);
  for (int k = 0; k < 4; ++k) strip.view({0, 12, 24, 36, 60});
  for (int k = 0; k < 3; ++k) strip.view({36, 48, 60});
  const std::vector<std::int32_t> group = strip.groups();
  EXPECT_EQ(std::set<std::int32_t>(group.begin(), group.end()).size(), 4u);
  for (const std::int32_t i : {5, 17, 29, 41, 55})
    EXPECT_EQ(group[static_cast<std::size_t>(i)], group[static_cast<std::size_t>(i / 12 * 12)]) << i;
  EXPECT_EQ(group[36], group[59]);
}

// What the field says of the border: the segments know better, as they do of floor that it calls a chair.
TEST(Clusters, PointsAreStuffWhereTheirSegmentsAre) {
  Strip strip(40);
  strip.put(20, 40, 1);
  for (int k = 0; k < 4; ++k) {
    strip.view({0, 20, 40});
    strip.sights.back().class_of = {kChair, kWall};
  }
  std::vector<std::int16_t> class_of(40, kChair);
  std::fill(class_of.begin() + 16, class_of.begin() + 20, kWall);
  const std::vector<std::int32_t> group = strip.groups({.neighbours = 2, .least_points = 3}, class_of);
  for (std::int32_t i = 0; i < 40; ++i) EXPECT_EQ(group[static_cast<std::size_t>(i)], i < 20 ? 0 : -1) << i;
}

// No segment holds the floor under a chair, and none of its rim.
TEST(Clusters, OnlyPointsOfItsClassGoToAGroupBesideThem) {
  Strip strip(40);
  for (int k = 0; k < 4; ++k) strip.view({0, 20});
  std::vector<std::int16_t> class_of(40, kChair);
  std::fill(class_of.begin() + 24, class_of.end(), std::int16_t{2});
  const std::vector<std::int32_t> group = strip.groups({.neighbours = 2, .least_points = 3}, class_of);
  for (std::int32_t i = 0; i < 40; ++i) EXPECT_EQ(group[static_cast<std::size_t>(i)], i < 24 ? 0 : -1) << i;
}

// What lies apart in a chair's segment, as the depth of its rim throws points, is no second chair.
TEST(Clusters, RimsOfAThingAreNone) {
  Strip strip(60);
  strip.put(40, 60, 1);
  for (int k = 0; k < 6; ++k) {
    strip.view({0, 30});
    SegmentSights& view = strip.sights.back();
    for (std::int32_t i = 40; i < 48; ++i) view.point.push_back(i);
    view.segment.resize(view.point.size(), 0);
    view.first.back() = static_cast<std::int32_t>(view.point.size());
  }
  const std::vector<std::int32_t> group = strip.groups({.neighbours = 2, .agree = 1, .least_points = 3});
  EXPECT_EQ(std::set<std::int32_t>(group.begin(), group.end()), std::set<std::int32_t>{0});
}

// Segments know what the field does not.
TEST(ObjectTable, ClassesOfSegmentsVoteToo) {
  const Row row("cc");
  const PointClasses classes{3, {0.0f, 0.8f, 0.2f, 0.0f, 0.8f, 0.2f}};
  SegmentSights view{{0, 1}, {0, 0}, {0, 2}, {2}};
  const std::vector<std::int32_t> one{1, 1};
  const std::vector<ObjectRow> rows = object_table(row.surface, one, {&view, 1}, classes, {true, false, false}, {});
  EXPECT_EQ(rows.at(0).class_index, 2);
  EXPECT_NEAR(rows.at(0).class_probability, 0.6, 1e-6);
  view.class_of = {kVoid};
  EXPECT_EQ(object_table(row.surface, one, {&view, 1}, classes, {true, false, false}, {}).at(0).class_index, kChair);
}

// A table of 1.2 x 0.6 m that stands turned by 30 degrees, whose top tilts a little; a lost point lies far away.
TEST(ObjectTable, BoxesStandUpright) {
  std::vector<Vec3d> position;
  const double c = std::cos(0.5236), s = std::sin(0.5236);
  for (int i = 0; i <= 60; ++i)
    for (int j = 0; j <= 30; ++j) {
      const double x = 0.02 * i, y = 0.02 * j;
      position.push_back({1 + c * x - s * y, 2 + s * x + c * y, 0.7 + 0.02 * x});
      if (i == 0 && j == 0)
        for (int k = 0; k < 60; ++k) position.push_back({1, 2, 0.01 * k});
    }
  position.push_back({9, 9, 9});
  const std::vector<std::int32_t> id(position.size(), 1);
  std::vector<ObjectRow> rows(1);
  measure_objects(rows, position, id, 0.02, Vec3d{0, 0, 1});
  const TurnedBox& box = rows[0].box;
  EXPECT_EQ(box.axis[2], (Vec3d{0, 0, 1}));
  EXPECT_NEAR(dot(box.axis[0], Vec3d{c, s, 0}), 1, 1e-4) << "the longer side";
  EXPECT_NEAR(dot(cross(box.axis[0], box.axis[1]), box.axis[2]), 1, 1e-12);
  EXPECT_NEAR(box.size.x, 1.2, 0.05);
  EXPECT_NEAR(box.size.y, 0.6, 0.05);
  EXPECT_GT(box.size.z, 0.5) << "the leg under a corner";
  measure_objects(rows, position, id, 0.02, std::nullopt);
  EXPECT_LT(std::abs(box.axis[2].z), 0.9999) << "along the spread of the points, where up is not known";
}

// Each of two points is a thing's, and both may be the wall's: together they vote for it.
TEST(ObjectTable, NoObjectIsOfAClassOfStuff) {
  const Row row("cc");
  const std::vector<std::int32_t> one{1, 1};
  const PointClasses classes{3, {0.45f, 0.5f, 0.05f, 0.45f, 0.1f, 0.45f}};
  const std::vector<ObjectRow> free = object_table(row.surface, one, {}, classes, {false, false, false}, {});
  EXPECT_EQ(free.at(0).class_index, kWall);
  const std::vector<ObjectRow> rows = object_table(row.surface, one, {}, classes, {true, false, false}, {});
  ASSERT_EQ(rows.size(), 1u);
  EXPECT_EQ(rows[0].class_index, kChair);
  EXPECT_NEAR(rows[0].class_probability, 0.3, 1e-6);
  const std::vector<ObjectRow> none = object_table(row.surface, one, {}, classes, {true, true, true}, {});
  EXPECT_EQ(none[0].class_index, kVoid);
  EXPECT_EQ(none[0].class_probability, 0);
}

// Segments made worse: shares, numbers, and the same again for the same seed.

// Ten bars, each 8 pixels wide, in two equal frames; bar k is of class k % 3.
SegmentSet bars() {
  SegmentSet set;
  FrameSegments frame{80, 40, {}, {}};
  for (int i = 0; i < 80 * 40; ++i) frame.id.push_back(1 + i % 80 / 8);
  for (int k = 1; k <= 10; ++k) frame.class_of[k] = static_cast<std::int16_t>(k % 3);
  set.frames = {frame, {}, frame};
  return set;
}

std::set<std::int32_t> ids_of(const FrameSegments& frame) { return {frame.id.begin(), frame.id.end()}; }

SegmentSet damaged(const SegmentDamage& damage, std::uint64_t seed = 1) {
  SegmentSet set = bars();
  damage_segments(set, damage, seed);
  return set;
}

TEST(SegmentDamage, ShuffledNumbersKeepPixelsAndClasses) {
  const SegmentSet set = damaged({.shuffle = true});
  const FrameSegments before = bars().frames[0], after = set.frames[0];
  EXPECT_NE(after.id, before.id);
  EXPECT_NE(after.id, set.frames[2].id) << "two frames have one order";
  EXPECT_EQ(ids_of(after), ids_of(before));
  for (int x = 0; x < 80; ++x) {
    EXPECT_EQ(after.id[static_cast<std::size_t>(x)], after.id[static_cast<std::size_t>(x / 8 * 8)]);
    EXPECT_EQ(after.class_of.at(after.id[static_cast<std::size_t>(x)]), (1 + x / 8) % 3);
  }
  EXPECT_EQ(damaged({.shuffle = true}).frames[0].id, after.id);
  EXPECT_NE(damaged({.shuffle = true}, 2).frames[0].id, after.id);
}

TEST(SegmentDamage, SharesAreOfTheSegmentsOfAnImage) {
  EXPECT_EQ(ids_of(damaged({.split = 0.2}).frames[0]).size(), 12u);
  EXPECT_EQ(ids_of(damaged({.missing = 0.3}).frames[0]).size(), 8u) << "seven, and what is missing";
  const std::size_t merged = ids_of(damaged({.merge = 0.2}).frames[0]).size();
  EXPECT_LT(merged, 10u);
  EXPECT_GE(merged, 8u);
}

TEST(SegmentDamage, HalvesOfASplitSegmentKeepItsClass) {
  const FrameSegments after = damaged({.split = 1}).frames[0];
  for (std::size_t i = 0; i < after.id.size(); ++i)
    EXPECT_EQ(after.class_of.at(after.id[i]), static_cast<int>(1 + i % 80 / 8) % 3);
}

TEST(SegmentDamage, BordersMoveByNoMoreThanIsAskedFor) {
  const FrameSegments after = damaged({.border_px = 2}).frames[0];
  int moved = 0;
  for (std::int32_t i = 0; i < 80 * 40; ++i) {
    const int x = i % 80, own = 1 + x / 8, left = 1 + std::max(0, x - 2) / 8, right = 1 + std::min(79, x + 2) / 8;
    const int id = after.id[static_cast<std::size_t>(i)];
    EXPECT_TRUE(id >= left && id <= right) << i;
    moved += id != own;
  }
  EXPECT_GT(moved, 100);
}

// The network of objects: gradients against central differences, the same bits on any threads, and that it learns.

std::unique_ptr<Grouping> grouping_of(const std::string& name) {
  const PluginEntry& entry = testkit::linked_registry().get(PluginKind::grouping, name);
  return entry.grouping(*entry.new_params());
}

constexpr ObjectNetworkShape kShape{3, 16, 2};
constexpr Box kBox{{-1, -1, -1}, {1, 1, 1}};

// Points on a line; the left and the right half are segments of three views.
struct TwoThings {
  TwoThings() {
    for (int i = 0; i < 40; ++i) positions.push_back({-1 + i / 20.0, 0.2, 0.1 * (i % 3)});
    for (int v = 0; v < 3; ++v) {
      SegmentSights view;
      for (int i = 0; i < 40; ++i) {
        view.point.push_back(i);
        view.segment.push_back(i < 20 ? 0 : 1);
      }
      view.first = {0, 20, 40};
      view.class_of = {kVoid, kVoid};
      sights.push_back(view);
    }
  }
  std::vector<Vec3d> positions;
  std::vector<SegmentSights> sights;
};

TEST(ObjectNetwork, GradientsOfAStepAreThoseOfItsLoss) {
  const TwoThings things;
  const ObjectLearning learning{.views = 2, .view_points = 24};
  const std::unique_ptr<Grouping> contrastive = grouping_of("contrastive");
  ObjectNetwork<double> net(testkit::linked_registry().kernels(), *contrastive, kShape, kBox, 3, learning.views);
  (void)net.gradients(things.positions, things.sights, learning, 5);
  for (Tensor<double>& tensor : net.store().all()) {
    if (!tensor.learned()) continue;
    std::vector<double> slope(tensor.grad.data(), tensor.grad.data() + tensor.size());
    const auto loss = [&] { return net.gradients(things.positions, things.sights, learning, 5); };
    EXPECT_EQ(testkit::check_gradient(loss, tensor.view(tensor.value),
                                      {slope.data(), tensor.spec.rows, tensor.spec.cols}, {1e-5, 1e-6, 12, 1}),
              "")
        << tensor.name;
  }
}

TEST(ObjectNetwork, FloatFollowsTheOracle) {
  const TwoThings things;
  const ObjectLearning learning{.views = 2, .view_points = 24};
  const std::unique_ptr<Grouping> contrastive = grouping_of("contrastive");
  ObjectNetwork<double> wide(testkit::linked_registry().kernels(), *contrastive, kShape, kBox, 3, learning.views);
  ObjectNetwork<float> narrow(testkit::linked_registry().kernels(), *contrastive, kShape, kBox, 3, learning.views);
  const double want = wide.gradients(things.positions, things.sights, learning, 0);
  EXPECT_NEAR(narrow.gradients(things.positions, things.sights, learning, 0), want, 1e-4 * std::abs(want));
}

TEST(ObjectNetwork, HasTheSameBitsOnAnyNumberOfThreads) {
  const TwoThings things;
  const std::unique_ptr<Grouping> contrastive = grouping_of("contrastive");
  std::vector<std::vector<float>> outputs;
  for (const int threads : {1, 2, 3}) {
    const ThreadScope scope(threads);
    ObjectNetwork<float> net(testkit::linked_registry().kernels(), *contrastive, kShape, kBox, 3, 5);
    net.learn(things.positions, things.sights, {.steps = 20, .views = 5, .view_points = 32}, {});
    outputs.push_back(net.outputs(things.positions));
  }
  EXPECT_EQ(outputs[0], outputs[1]);
  EXPECT_EQ(outputs[0], outputs[2]);
}

TEST(ObjectNetwork, NoSegmentIsAnError) {
  const std::unique_ptr<Grouping> contrastive = grouping_of("contrastive");
  ObjectNetwork<float> net(testkit::linked_registry().kernels(), *contrastive, kShape, kBox, 3, 4);
  const std::vector<Vec3d> one{{0, 0, 0}};
  EXPECT_THROW(net.learn(one, std::vector<SegmentSights>(2), {}, {}), Error);
}

// Panoptic quality by hand.

constexpr std::int16_t kTable = 2;
const std::vector<bool> kStuff{true, false, false};

struct Pixels {
  std::vector<std::int16_t> label, rendered;
  std::vector<std::int32_t> instance, object;
  void add(int count, std::int16_t true_class, std::int32_t true_object, std::int16_t class_index, std::int32_t found) {
    label.insert(label.end(), static_cast<std::size_t>(count), true_class);
    instance.insert(instance.end(), static_cast<std::size_t>(count), true_object);
    rendered.insert(rendered.end(), static_cast<std::size_t>(count), class_index);
    object.insert(object.end(), static_cast<std::size_t>(count), found);
  }
};

ObjectRow row(std::int32_t id, std::int16_t class_index) {
  ObjectRow out;
  out.id = id;
  out.class_index = class_index;
  return out;
}

TEST(ObjectScore, IsTheFormula) {
  // Two chairs, of which one is found with IoU 0.8 and the other not; a wrong table; all of the wall.
  const std::vector<ObjectRow> rows{row(1, kChair), row(2, kTable)};
  Pixels p;
  p.add(1000, kWall, 9, kWall, 0);
  p.add(80, kChair, 1, kChair, 1);
  p.add(20, kChair, 1, kChair, 0);
  p.add(50, kChair, 2, kTable, 2);
  ObjectScore score(rows, kStuff, 10);
  // In two halves: a segment is what a thing covers in all images.
  score.add({std::span(p.label).first(1040), std::span(p.instance).first(1040), std::span(p.rendered).first(1040),
             std::span(p.object).first(1040)});
  score.add({std::span(p.label).subspan(1040), std::span(p.instance).subspan(1040), std::span(p.rendered).subspan(1040),
             std::span(p.object).subspan(1040)});
  const ObjectFigures f = score.figures();
  // Wall 1; chairs 0.8 / (1 + 1/2); tables 0 / (1/2).
  EXPECT_NEAR(f.pq, (1 + 0.8 / 1.5 + 0) / 3, 1e-12);
  EXPECT_NEAR(f.sq, (1 + 0.8 + 0) / 3, 1e-12);
  EXPECT_NEAR(f.rq, (1 + 1 / 1.5 + 0) / 3, 1e-12);
  EXPECT_NEAR(f.pq_stuff, 1, 1e-12);
  EXPECT_NEAR(f.mcov, (0.8 + 1.0) / 2, 1e-12) << "whatever the class";
  EXPECT_NEAR(f.count_error, (1 + 1) / 2.0, 1e-12) << "a chair too few, a table too many";
  EXPECT_EQ(f.objects, 2);
  EXPECT_EQ(f.found, 2);
}

TEST(ObjectScore, VoidAndWhatIsTinyCountNowhere) {
  const std::vector<ObjectRow> rows{row(1, kChair), row(2, kChair), row(3, kTable)};
  Pixels p;
  p.add(100, kChair, 1, kChair, 1);
  p.add(100, kVoid, 0, kChair, 1);  // beside it, void: no part of the union
  p.add(30, kVoid, 0, kChair, 2);   // found in void alone
  p.add(9, kTable, 7, kTable, 3);   // too small to be true
  ObjectScore score(rows, kStuff, 10);
  score.add({p.label, p.instance, p.rendered, p.object});
  const ObjectFigures f = score.figures();
  EXPECT_NEAR(f.pq, 1, 1e-12);
  EXPECT_EQ(f.objects, 1);
  EXPECT_EQ(f.found, 1);
  EXPECT_EQ(f.count_error, 0);
}

TEST(ObjectScore, AnObjectOfAnotherClassDoesNotMatch) {
  Pixels p;
  p.add(100, kChair, 1, kTable, 1);
  const std::vector<ObjectRow> tables{row(1, kTable)}, unknown{row(1, kVoid)};
  ObjectScore wrong(tables, kStuff, 10), any(unknown, kStuff, 10);
  wrong.add({p.label, p.instance, p.rendered, p.object});
  any.add({p.label, p.instance, p.rendered, p.object});
  EXPECT_EQ(wrong.figures().pq, 0);
  EXPECT_EQ(any.figures().matched, 1) << "an object without a class matches any";
}

// Segments from files: every form, and what is wrong with them.

constexpr std::int32_t kImageWidth = 4, kHeight = 3;

SceneInfo scene_info() {
  SceneInfo info;
  info.classes = ClassTable({{1, "wall", {}, false}, {2, "chair", {}, false}});
  for (const char* name : {"rgb_0", "rgb_1"}) {
    FrameInfo frame;
    frame.name = name;
    frame.source = std::string("rgb/") + name + ".jpg";
    frame.camera.width_px = kImageWidth;
    frame.camera.height_px = kHeight;
    info.frames.push_back(frame);
  }
  info.frames[1].split = Split::test;
  return info;
}

const std::vector<std::int32_t> kIds{0, 1, 1, 2, 0, 1, 1, 2, 0, 0, 0, 2};

TEST(ReadSegments, InstanceImagesOfEightSixteenBitsAndAPalette) {
  const std::vector<std::uint8_t> narrow(kIds.begin(), kIds.end());
  std::vector<std::uint16_t> wide(kIds.begin(), kIds.end());
  wide[0] = 65535;
  const TempDir a, b, c;
  write_png_gray8(a / "rgb_0.png", kImageWidth, kHeight, narrow);
  write_png_gray16(b / "rgb_0.png", kImageWidth, kHeight, wide);
  const std::vector<std::uint8_t> palette{0, 0, 0, 9, 9, 9, 200, 0, 0};
  write_png_palette(c / "seg_0.png", kImageWidth, kHeight, narrow, palette);
  EXPECT_EQ(read_segments(a.path(), "", scene_info()).frames[0].id, kIds);
  EXPECT_EQ(read_segments(b.path(), "", scene_info()).frames[0].id, kIds);
  const SegmentSet set = read_segments(c.path(), "seg_{number}.png", scene_info());
  EXPECT_EQ(set.frames[0].id, kIds);
  EXPECT_FALSE(set.classes);
  EXPECT_EQ(set.count(), 2);
}

TEST(ReadSegments, AnImageOfAnotherSizeIsReadByItsNearestPixel) {
  const TempDir dir;
  write_png_gray8(dir / "rgb_0.png", 2 * kImageWidth, 2 * kHeight, std::vector<std::uint8_t>(48, 7));
  const FrameSegments frame = read_segments(dir.path(), "", scene_info()).frames[0];
  EXPECT_EQ(frame.width_px, 8);
  EXPECT_EQ(frame.at(3, 2, kImageWidth, kHeight), 7);
}

// Orientation 6: viewers turn the image to the right, and stored pixel (x, y) is shown at (2 - y, x).
TEST(ReadSegments, OfATurnedPhotographAreThoseOfItsStoredPixels) {
  SceneInfo info = scene_info();
  info.frames[0].orientation = 6;
  std::vector<std::uint8_t> shown(kIds.size());
  for (std::size_t y = 0; y < 3; ++y)
    for (std::size_t x = 0; x < 4; ++x) shown[3 * x + 2 - y] = static_cast<std::uint8_t>(kIds[4 * y + x]);
  const TempDir dir;
  write_png_gray8(dir / "rgb_0.png", kHeight, kImageWidth, shown);
  const FrameSegments frame = read_segments(dir.path(), "", info).frames[0];
  EXPECT_EQ(frame.width_px, kImageWidth);
  EXPECT_EQ(frame.id, kIds);
}

TEST(ReadSegments, PanopticImagesHaveClassesByName) {
  const TempDir dir;
  std::vector<std::uint8_t> rgb(3 * kIds.size(), 0);
  for (std::size_t i = 0; i < kIds.size(); ++i) {
    rgb[3 * i] = static_cast<std::uint8_t>(kIds[i] == 2 ? 0 : kIds[i]);
    rgb[3 * i + 1] = kIds[i] == 2 ? 1 : 0;  // 256
  }
  std::filesystem::create_directories(dir / "panoptic");
  write_png_rgb(dir / "panoptic/rgb_0.png", kImageWidth, kHeight, rgb);
  const std::string file = dir.write("panoptic.json",
                                     R"({"annotations": [{"image_id": 5, "file_name": "rgb_0.png", "segments_info":
          [{"id": 1, "category_id": 3}, {"id": 256, "category_id": 4}]}],
          "categories": [{"id": 3, "name": "chair"}, {"id": 4, "name": "piano"}]})");
  const SegmentSet set = read_segments(file, "", scene_info());
  EXPECT_EQ(set.frames[0].id[1], 1);
  EXPECT_EQ(set.frames[0].id[3], 256);
  EXPECT_EQ(set.frames[0].class_of.at(1), 1);
  EXPECT_FALSE(set.frames[0].class_of.contains(256)) << "the scene has no piano";
  EXPECT_TRUE(set.classes);
}

TEST(ReadSegments, OfMasksThatOverlapTheSmallerLiesInFront) {
  const TempDir dir;
  // Column by column: all 12 pixels, and the second column alone, as counts and as a polygon.
  dir.write("rgb_0.json", R"([{"segmentation": {"size": [3, 4], "counts": [3, 3, 6]}, "area": 3},
                              {"segmentation": {"size": [3, 4], "counts": [0, 12]}},
                              {"segmentation": [[3, 0, 4, 0, 4, 1, 3, 1]]}])");
  const std::vector<std::int32_t> id = read_segments(dir.path(), "", scene_info()).frames[0].id;
  EXPECT_EQ(id, (std::vector<std::int32_t>{1, 2, 1, 3, 1, 2, 1, 1, 1, 2, 1, 1}));
}

TEST(ReadSegments, InstancesOfCoco) {
  const TempDir dir;
  const std::string file = dir.write(
      "instances.json",
      R"({"images": [{"id": 8, "file_name": "rgb_0.jpg", "width": 4, "height": 3}, {"id": 9, "file_name": "other.jpg"}],
          "annotations": [{"image_id": 8, "category_id": 2, "segmentation": {"size": [3, 4], "counts": "0<"}},
                          {"image_id": 8, "segmentation": []}, {"image_id": 9, "segmentation": []}],
          "categories": [{"id": 2, "name": "wall"}]})");
  const FrameSegments frame = read_segments(file, "", scene_info()).frames[0];
  EXPECT_EQ(frame.id, std::vector<std::int32_t>(12, 1));
  EXPECT_EQ(frame.class_of.at(1), 0);
}

// An array of a .npz file, whose values are one byte each.
struct ByteArray {
  std::string key, type;
  std::vector<std::int64_t> shape;
  std::string values;
};

std::string write_arrays(const TempDir& dir, const std::vector<ByteArray>& arrays) {
  ZipWriter archive(dir / "rgb_0.npz");
  for (const ByteArray& a : arrays) archive.add(a.key + ".npy", npy_header(a.type, a.shape) + a.values);
  archive.write();
  return dir.path();
}

std::string pixels(const std::string& rows) {  // 'x' is inside
  std::string out;
  for (const char c : rows) out += static_cast<char>(c == 'x' ? 1 : 0);
  return out;
}

TEST(ReadSegments, MasksOfNumPyTogetherAndOneByOne) {
  const std::string all = pixels("xxxxxxxxxxxx"), column = pixels(".x...x...x..");
  const std::vector<std::int32_t> want{1, 2, 1, 1, 1, 2, 1, 1, 1, 2, 1, 1};
  const TempDir together, apart, channel;
  const SegmentSet set = read_segments(write_arrays(together, {{"scores", "<f4", {1}, "abcd"},
                                                               {"masks", "|b1", {2, 3, 4}, column + all},
                                                               {"class_ids", "|u1", {2}, "\x02\x01"}}),
                                       "", scene_info());
  EXPECT_EQ(set.frames[0].id, want) << "the smaller mask lies in front";
  EXPECT_EQ(set.frames[0].class_of.at(2), 1) << "the column is a chair";
  EXPECT_EQ(set.frames[0].class_of.at(1), 0);
  EXPECT_TRUE(set.classes);
  const FrameSegments one_by_one =
      read_segments(write_arrays(apart, {{"m0", "|u1", {3, 4}, all}, {"m1", "|u1", {3, 4}, column}}), "", scene_info())
          .frames[0];
  EXPECT_EQ(one_by_one.id, want);
  EXPECT_TRUE(one_by_one.class_of.empty());
  const std::string four = write_arrays(channel, {{"masks", "|b1", {2, 1, 3, 4}, column + all}});
  EXPECT_EQ(read_segments(four, "{name}.npz", scene_info()).frames[0].id, want);
}

TEST(ReadSegments, WhatIsWrongWithMasksOfNumPyIsNamed) {
  const TempDir dir;
  const std::string all(12, '\1');
  const auto read = [&](const std::vector<ByteArray>& arrays) {
    return read_segments(write_arrays(dir, arrays), "", scene_info());
  };
  EXPECT_ERROR(read({{"masks", "<f4", {1, 3, 1}, all}}), "files.array.type", "rgb_0.npz", "'masks'", "bool or uint8");
  EXPECT_ERROR(read({{"masks", "|b1", {3, 4}, all}}), "labels.array.shape", "'masks'", "(3, 4)",
               "[masks, height, width]");
  EXPECT_ERROR(read({{"masks", "|b1", {1, 2, 6}, all}}), "labels.image.size", "'masks'", "6 x 2", "4 x 3");
  EXPECT_ERROR(read({{"masks", "|b1", {2, 3, 4}, all}}), "files.array.format", "'masks'", "(2, 3, 4)");
  EXPECT_ERROR(read({{"scores", "<f4", {3}, all}}), "labels.array.shape", "rgb_0.npz", "no masks");
  EXPECT_ERROR(read({{"masks", "|b1", {10001, 3, 4}, std::string(12 * 10001, '\0')}}), "labels.array.shape", "'masks'",
               "at most 10000 masks");
  const ByteArray masks{"masks", "|b1", {1, 3, 4}, all};
  EXPECT_ERROR(read({masks, {"class_ids", "|u1", {2}, "\1\1"}}), "labels.array.shape", "'class_ids'", "(2,)", "(1,)");
  EXPECT_ERROR(read({masks, {"class_ids", "|u1", {1}, "\7"}}), "labels.id.unknown", "'class_ids'", "mask 1", "7");
  EXPECT_ERROR(read({masks, {"class_ids", "<f4", {1}, "abcd"}}), "files.array.type", "'class_ids'", "int64");
}

TEST(ReadSegments, WhatIsWrongIsNamed) {
  const TempDir dir;
  EXPECT_ERROR(read_segments(dir / "nothing", "", scene_info()), "files.read.missing", "nothing");
  EXPECT_ERROR(read_segments(dir.path(), "", scene_info()), "objects.segments.none", "rgb_0");
  EXPECT_ERROR(read_segments(dir.write("a.json", "{"), "", scene_info()), "labels.file.format", "a.json");
  EXPECT_ERROR(read_segments(dir.write("b.json", "{}"), "", scene_info()), "labels.file.format", "annotations");
  const TempDir masks;
  masks.write("rgb_0.json", R"([{"segmentation": {"size": [3, 4], "counts": [3, 30]}}])");
  EXPECT_ERROR(read_segments(masks.path(), "", scene_info()), "labels.run_lengths.damaged", "rgb_0.json: mask 1");
  masks.write("rgb_0.json", R"([{"segmentation": {"size": [3, 40], "counts": [120]}}])");
  EXPECT_ERROR(read_segments(masks.path(), "", scene_info()), "labels.image.size", "rgb_0.json");
  const std::string coco =
      dir.write("c.json", R"({"images": [], "annotations": [{"image_id": 7, "segmentation": []}]})");
  EXPECT_ERROR(read_segments(coco, "", scene_info()), "labels.annotation.reference", "annotation 1", "7");
  EXPECT_ERROR(read_segments(dir.path(), "{nome}.png", scene_info()), "labels.pattern.invalid", "nome");
}

}  // namespace
}  // namespace semfield
