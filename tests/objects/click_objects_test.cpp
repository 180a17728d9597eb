// Clicks as objects: which points of a surface a click means, and clicks from a file.
#include <gtest/gtest.h>

#include "objects/find_objects.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

constexpr int kWall = 0, kChair = 1;

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
  EXPECT_EQ(row.objects({{2, kChair, 0}, {7, kChair, 0}}),
            "01111111"
            "1.00");
  EXPECT_EQ(row.objects({{2, kChair, 1}, {7, kChair, 2}}),
            "01111222"
            "2.00")
      << "the nearer click";
  EXPECT_EQ(row.objects({{2, kChair, 0}, {7, kChair, 2}}),
            "01111222"
            "2.00")
      << "another chair than the first";
  EXPECT_EQ(row.objects({{2, kChair, 3}, {10, kChair, 3}}),
            "01111111"
            "1.10");
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
  EXPECT_ERROR(read(R"({"id":"n","type":"class","name":"chair"})"
                    "\n"),
               "labels.clicks.empty", "clicks.jsonl");
  EXPECT_ERROR(read(R"({"id":"n","type":"class","name":"piano"}
{"id":"a","type":"click","frame":"a","size":[16,8],"points":[[3,1]],"radius":2,"class":"piano"}
)"),
               "labels.class.unknown", "clicks.jsonl", "piano");
  EXPECT_ERROR(
      read(R"({"id":"a","type":"click","frame":"a","size":[16,8],"points":[[3,1]],"radius":2,"class":"chair","object":0}
)"),
      "labels.event.format", "clicks.jsonl", "'object'", "from 1 to 65535");
}

}  // namespace
}  // namespace semfield
