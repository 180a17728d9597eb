// What label events add up to: classes that keep their places, clicks in order, undo and redo, and what they paint.
#include "labels/clicks/annotations.h"

#include <algorithm>

#include "labels/mask_outlines.h"
#include "tests/labels/annotations_case.h"

namespace semfield {
namespace {

using namespace testing_labels;
using namespace testing_annotations;

TEST(Annotations, ClassesGetTheNextFreeIdsBehindTheScenesOwn) {
  Annotations bare(scene_of(), 3);
  EXPECT_EQ(names_of_table(bare.classes()), "0-void 1=unnamed 1 2=unnamed 2 3=unnamed 3 ");
  EXPECT_EQ(bare.named_classes(), 0);
  EXPECT_TRUE(bare.apply(add("1", "chair")));
  EXPECT_EQ(names_of_table(bare.classes()), "0-void 1=chair 2=unnamed 2 3=unnamed 3 ");
  EXPECT_EQ(bare.classes().valid(0).color, ClassTable::default_color(1));
  EXPECT_EQ(names_of_table(bare.named_table()), "0-void 1=chair ");
  LabelEvent red = add("2", "lamp");
  red.color = {{200, 1, 2}};
  EXPECT_TRUE(bare.apply(red));
  EXPECT_EQ(bare.classes().valid(1).color, (std::array<std::uint8_t, 3>{200, 1, 2}));
  EXPECT_EQ(bare.named_classes(), 2);

  Annotations room(scene_of(room_table()), 5);  // wall 1, chair 4, table 7
  EXPECT_EQ(names_of_table(room.classes()), "0-void 1=wall 4=chair 7=table 8=unnamed 8 9=unnamed 9 ");
  EXPECT_EQ(room.named_classes(), 3);
  EXPECT_EQ(room.classes().valid(2).color, (std::array<std::uint8_t, 3>{70, 80, 90}));
  EXPECT_EQ(names_of_table(Annotations(scene_of(room_table()), 1).classes()), "0-void 1=wall 4=chair 7=table ");
  // A void class above does not push ids away, and is stepped over.
  const ClassTable high({{0, "wall", {}, false}, {2, "unlabeled", {}, true}, {255, "void", {}, true}});
  EXPECT_EQ(names_of_table(Annotations(scene_of(high), 3).classes()),
            "0=wall 1=unnamed 1 2-unlabeled 3=unnamed 3 255-void ");
  EXPECT_NE(error_of([] { Annotations many(scene_of(), 1025); }), "");
}

TEST(Annotations, AnEventCountsOnce) {
  Annotations annotations(scene_of(), 2);
  EXPECT_TRUE(annotations.check(add("1", "chair")));
  EXPECT_FALSE(annotations.seen("1"));
  EXPECT_TRUE(annotations.apply(add("1", "chair")));
  EXPECT_FALSE(annotations.apply(add("1", "table")));
  EXPECT_FALSE(annotations.check(add("1", "table")));
  EXPECT_EQ(annotations.named_classes(), 1);
  EXPECT_TRUE(annotations.apply(click("2", "chair", {1, 1})));
  EXPECT_FALSE(annotations.apply(click("2", "chair", {5, 5})));
  EXPECT_EQ(annotations.marks().size(), 1u);
}

TEST(Annotations, PaintsInOrderOverWhatWasThere) {
  Annotations annotations(scene_of(room_table()), 0);
  annotations.apply(click("1", "chair", {3.5, 2.5}, 1.5));
  annotations.apply(click("2", "table", {3.5, 2.5}));
  annotations.apply(click("3", "wall", {8, 6}));
  EXPECT_EQ(painted(annotations), (Rows{"........", "..111...", "..121...", "..111...", "........", ".......0"}));
  EXPECT_EQ(painted(annotations, 1), (Rows(6, "........")));
  EXPECT_EQ(annotations.frames_with_marks(), std::vector<int>{0});
  annotations.apply(click("4", "void", {3.5, 1.5}));
  annotations.apply(click("5", "wall", {0, 0}, 0, "b"));
  EXPECT_EQ(annotations.marks()[3].class_index, kVoid);
  EXPECT_EQ(painted(annotations, 0, std::vector<std::int16_t>(48, 2)),
            (Rows{"22222222", "221.1222", "22121222", "22111222", "22222222", "22222220"}));
  EXPECT_EQ(annotations.frames_with_marks(), (std::vector<int>{0, 1}));
}

TEST(Annotations, PointsAreScaledToTheLoadedFrame) {
  Annotations annotations(scene_of(room_table()), 0);
  LabelEvent large = click("1", "chair", {14, 10}, 6);  // of an image four times as wide
  large.width_px = 32;
  large.height_px = 24;
  large.points.push_back({18, 10});
  annotations.apply(large);
  EXPECT_EQ(annotations.marks()[0].points, (std::vector<PixelPoint>{{3.5, 2.5}, {4.5, 2.5}}));
  EXPECT_EQ(annotations.marks()[0].radius_px, 1.5);
  EXPECT_EQ(painted(annotations), (Rows{"........", "..1111..", "..1111..", "..1111..", "........", "........"}));
  large.id = "2";
  large.height_px = 32;
  EXPECT_EQ(refusal(annotations, large),
            "event '2': frame 'a': labels are 32 x 32 pixels, the frame is 8 x 6: another shape; label the image of "
            "this frame");
}

TEST(Annotations, UndoAndItsUndoGiveTheSamePaintingInTheOldOrder) {
  Annotations annotations(scene_of(room_table()), 0);
  annotations.apply(click("1", "chair", {3.5, 2.5}, 1.5));
  annotations.apply(click("2", "table", {3.5, 2.5}, 1.5));
  const Rows both = painted(annotations);
  annotations.apply(undo("3", "1"));
  EXPECT_EQ(ids(annotations.marks()), "2 ");
  annotations.apply(undo("4", "3"));
  EXPECT_EQ(ids(annotations.marks()), "1 2 ");
  EXPECT_EQ(painted(annotations), both);
  annotations.apply(undo("5", "4"));
  EXPECT_EQ(ids(annotations.marks()), "2 ");
  annotations.apply(undo("6", "5"));
  EXPECT_EQ(painted(annotations), both);
  EXPECT_EQ(refusal(annotations, undo("7", "3")),
            "event '7': event '3' is undone already; undo its undo to bring it back");
  EXPECT_EQ(refusal(annotations, undo("7", "nobody")), "event '7': there is no event 'nobody' to undo");
  annotations.apply(undo("8", "2"));
  EXPECT_EQ(refusal(annotations, undo("9", "2")),
            "event '9': event '2' is undone already; undo its undo to bring it back");
}

TEST(Annotations, AClassThatClicksUseStaysUntilTheyAreUndone) {
  Annotations annotations(scene_of(), 3);
  annotations.apply(add("1", "chair"));
  annotations.apply(add("2", "lamp"));
  annotations.apply(click("3", "chair", {1, 1}));
  EXPECT_EQ(refusal(annotations, undo("4", "1")), "event '4': the class 'chair' has 1 clicks; undo its clicks first");
  annotations.apply(undo("5", "3"));
  annotations.apply(undo("6", "1"));
  EXPECT_EQ(names_of_table(annotations.classes()), "0-void 1=unnamed 1 2=lamp 3=unnamed 3 ");
  EXPECT_EQ(annotations.named_classes(), 2);
  EXPECT_FALSE(annotations.is_named(0));
  EXPECT_TRUE(annotations.is_named(1));
  EXPECT_FALSE(annotations.is_named(2));
  EXPECT_FALSE(annotations.is_named(-1));
  EXPECT_EQ(names_of_table(annotations.named_table()), "0-void 2=lamp ");
  EXPECT_EQ(refusal(annotations, undo("7", "5")),
            "event '7': the class 'chair' of this click is undone; bring the class back first");
  EXPECT_EQ(refusal(annotations, click("7", "chair", {1, 1})),
            "event '7': no class 'chair'; add the class to the class table, or rename the label");
  EXPECT_EQ(refusal(annotations, click("7", "unnamed 1", {1, 1})),
            "event '7': no class 'unnamed 1'; add the class to the class table, or rename the label");
  annotations.apply(add("8", "table"));  // a place of its own
  EXPECT_EQ(names_of_table(annotations.classes()), "0-void 1=unnamed 1 2=lamp 3=table ");
  annotations.apply(undo("9", "6"));
  annotations.apply(undo("10", "5"));
  EXPECT_EQ(names_of_table(annotations.classes()), "0-void 1=chair 2=lamp 3=table ");
  EXPECT_EQ(ids(annotations.marks()), "3 ");
  EXPECT_EQ(refusal(annotations, add("11", "door")),
            "event '11': there is room for 3 classes, and all have names; rename a class that nobody needs, "
            "or raise scene.labels.class_room in a new run");
}

TEST(Annotations, AnUndoneClassGivesItsPlaceUpOnceEveryPlaceHasHadAName) {
  Annotations annotations(scene_of(), 2);
  std::vector<LabelEvent> events{
      add("1", "chair"), click("2", "chair", {1, 1}), undo("3", "2"), undo("4", "1"), rename("5", "lamp", "light"),
      add("6", "table"), click("7", "table", {2, 2})};
  events.insert(events.begin() + 4, add("4b", "lamp"));
  for (const LabelEvent& event : events) EXPECT_TRUE(annotations.apply(event)) << event.id;
  EXPECT_EQ(names_of_table(annotations.classes()), "0-void 1=table 2=light ");
  EXPECT_EQ(annotations.marks().at(0).class_index, 0);
  EXPECT_FALSE(annotations.has_room());
  EXPECT_EQ(refusal(annotations, add("8", "door")).find("event '8': there is room for 2 classes"), 0u);
  // What was undone cannot come back as something else.
  EXPECT_EQ(refusal(annotations, undo("8", "4")),
            "event '8': the place of the class 'chair' has been given to 'table'; add the class again, or undo 'table' "
            "first");
  EXPECT_EQ(refusal(annotations, undo("8", "3")),
            "event '8': the class 'chair' of this click is undone; bring the class back first");
  // The file gives every class the same place again, and room of its own where there is more.
  EXPECT_EQ(names_of_table(replay(scene_of(), 2, events, "log").classes()), "0-void 1=table 2=light ");
  EXPECT_EQ(names_of_table(replay(scene_of(), 0, events, "log").named_table()), "0-void 2=light 3=table ");
  for (const LabelEvent& event : {undo("8", "7"), undo("9", "6"), undo("10", "4")}) annotations.apply(event);
  EXPECT_EQ(names_of_table(annotations.classes()), "0-void 1=chair 2=light ");
  annotations.apply(undo("11", "3"));
  EXPECT_EQ(ids(annotations.marks()), "2 ");
}

TEST(Annotations, ARenamingStaysWithItsClassWhenThePlaceIsGivenAway) {
  Annotations annotations(scene_of(), 1);
  for (const LabelEvent& event : {add("1", "chair"), undo("2", "1"), add("3", "table"), rename("4", "table", "desk"),
                                  undo("5", "3"), undo("6", "2")})
    EXPECT_TRUE(annotations.apply(event)) << event.id;
  EXPECT_EQ(names_of_table(annotations.classes()), "0-void 1=chair ");
}

TEST(Annotations, AFileWithOneNameTwiceIsNamedWithItsLine) {
  const std::vector<LabelEvent> events{add("1", "chair"), click("2", "chair", {1, 1}), add("3", "chair")};
  EXPECT_EQ(error_of([&] { (void)replay(scene_of(), 0, events, "clicks.jsonl"); }),
            "clicks.jsonl:3: event '3': there is a class 'chair' already; delete the line, or change its name: clicks "
            "name their class by its name");
}

TEST(Annotations, ARenamedClassKeepsItsPlaceAndItsClicks) {
  Annotations annotations(scene_of(room_table()), 6);
  annotations.apply(add("1", "armchair"));
  annotations.apply(click("2", "armchair", {1, 1}));
  LabelEvent stool = rename("3", "armchair", "stool");
  stool.color = {{9, 8, 7}};
  annotations.apply(stool);
  EXPECT_EQ(annotations.classes().valid(3).name, "stool");
  EXPECT_EQ(annotations.classes().valid(3).color, (std::array<std::uint8_t, 3>{9, 8, 7}));
  EXPECT_EQ(annotations.marks()[0].class_index, 3);
  annotations.apply(click("4", "stool", {2, 2}));
  EXPECT_EQ(refusal(annotations, click("5", "armchair", {2, 2})).find("event '5': no class 'armchair'"), 0u);
  annotations.apply(add("6", "armchair"));  // the name is free again
  EXPECT_EQ(refusal(annotations, undo("7", "3")),
            "event '7': there is a class 'armchair' already; rename one of the two first");
  annotations.apply(undo("8", "6"));
  annotations.apply(undo("9", "3"));
  EXPECT_EQ(annotations.classes().valid(3).name, "armchair");
  EXPECT_EQ(annotations.classes().valid(3).color, ClassTable::default_color(8));
  EXPECT_EQ(annotations.marks()[1].class_index, 3);
  EXPECT_EQ(refusal(annotations, undo("10", "8")),
            "event '10': there is a class 'armchair' already; rename one of the two first");
  // The scene's own classes keep their names, which its files use; colours are free.
  EXPECT_EQ(refusal(annotations, rename("11", "chair", "sofa")),
            "event '11': the class 'chair' is one of the scene's own; rename it in the scene's table");
  LabelEvent color = rename("12", "chair", "chair");
  color.color = {{1, 2, 3}};
  annotations.apply(color);
  EXPECT_EQ(annotations.classes().valid(1).color, (std::array<std::uint8_t, 3>{1, 2, 3}));
  EXPECT_EQ(annotations.classes().valid(1).name, "chair");
}

TEST(Annotations, NamesAreOnce) {
  Annotations annotations(scene_of(room_table()), 6);
  annotations.apply(add("1", "sofa"));
  for (const char* taken : {"chair", "sofa", "void"}) {
    EXPECT_EQ(refusal(annotations, add("2", taken)),
              std::string("event '2': there is a class '") + taken + "' already; choose another name");
    EXPECT_EQ(refusal(annotations, taken == std::string("sofa") ? add("2", taken) : rename("2", "sofa", taken)),
              std::string("event '2': there is a class '") + taken + "' already; choose another name");
  }
  for (const char* name : {"Unlabelled", "unnamed 77"})
    EXPECT_EQ(refusal(annotations, add("2", name)), std::string("event '2': '") + name +
                                                        "' stands for pixels and classes without a name; choose "
                                                        "another name");
  EXPECT_EQ(refusal(annotations, rename("2", "void", "nothing")),
            "event '2': 'void' stands for pixels without a class");
  EXPECT_EQ(refusal(annotations, rename("2", "soffa", "x")), "event '2': no class 'soffa'; did you mean 'sofa'?");
}

TEST(Annotations, FramesThatDoNotTrainAndPointsOutsideAreRefused) {
  Annotations annotations(scene_of(room_table()), 0);
  EXPECT_EQ(refusal(annotations, click("1", "chair", {1, 1}, 0, "t")),
            "event '1': frame 't' is not a training frame; label training frames only");
  EXPECT_EQ(refusal(annotations, click("1", "chair", {1, 1}, 0, "elsewhere")),
            "event '1': no frame 'elsewhere'; see `semfield inspect` for the names");
  EXPECT_EQ(refusal(annotations, click("1", "chair", {8.1, 1})), "event '1': a point lies outside the image of 8 x 6");
  EXPECT_EQ(refusal(annotations, click("1", "chiar", {1, 1})), "event '1': no class 'chiar'; did you mean 'chair'?");
  LabelEvent empty = click("1", "chair", {1, 1});
  empty.points.clear();
  EXPECT_EQ(refusal(annotations, empty), "event '1': needs the size of an image and a point in it");
}

TEST(Annotations, SkipsAreListedAndUndone) {
  Annotations annotations(scene_of(room_table()), 0);
  LabelEvent skip = click("1", "", {2, 3});
  skip.kind = LabelEventKind::skip;
  annotations.apply(skip);
  EXPECT_EQ(ids(annotations.skips()), "1 ");
  EXPECT_TRUE(annotations.marks().empty());
  EXPECT_TRUE(annotations.frames_with_marks().empty());
  annotations.apply(undo("2", "1"));
  EXPECT_TRUE(annotations.skips().empty());
}

// --- strokes ---

Rows stroke(const std::vector<PixelPoint>& points, double radius, int width, int height) {
  LabelRaster raster = void_raster(width, height);
  paint(stroke_runs(points, radius, width, height), 1, raster);
  return rows_of(raster);
}

TEST(Strokes, OfOnePointAreDiscs) {
  for (const double radius : {0.6, 1.0, 2.3, 4.0}) {
    for (const PixelPoint at : {PixelPoint{4.5, 3.5}, PixelPoint{0.2, 5.9}, PixelPoint{8.7, 1.1}}) {
      LabelRaster disc = void_raster(9, 7);
      paint(disc_runs(at, radius, 9, 7), 1, disc);
      disc.hard[static_cast<int>(at.y) * 9 + static_cast<int>(at.x)] = 1;
      EXPECT_EQ(stroke({at}, radius, 9, 7), rows_of(disc)) << radius << " at " << at.x << ", " << at.y;
    }
  }
}

TEST(Strokes, CoverEveryPixelWhoseCentreIsNear) {
  // Against the distance to the polyline, pixel by pixel; without the pixels of the line itself.
  const std::vector<PixelPoint> line{{3.3, 2.1}, {20.7, 9.4}, {18.2, 25.5}, {5.5, 25.5}, {5.5, 12}};
  for (const double radius : {1.0, 2.7, 6.0}) {
    const Rows rows = stroke(line, radius, 24, 30);
    for (int y = 0; y < 30; ++y) {
      for (int x = 0; x < 24; ++x) {
        double nearest = 1e9;
        for (std::size_t i = 0; i + 1 < line.size(); ++i) {
          const double dx = line[i + 1].x - line[i].x, dy = line[i + 1].y - line[i].y;
          const double px = x + 0.5 - line[i].x, py = y + 0.5 - line[i].y;
          const double t = std::clamp((px * dx + py * dy) / (dx * dx + dy * dy), 0.0, 1.0);
          nearest = std::min(nearest, std::hypot(px - t * dx, py - t * dy));
        }
        const bool set = rows[y][x] == '1';
        EXPECT_EQ(set, nearest <= radius) << x << ", " << y << " at " << nearest << " of " << radius;
      }
    }
  }
}

TEST(Strokes, AThinOneIsTheLineWithoutGaps) {
  EXPECT_EQ(stroke({{0.5, 0.5}, {4.5, 2.5}}, 0, 6, 3), (Rows{"11....", ".111..", "...11."}));
  EXPECT_EQ(stroke({{1.5, 0.2}, {1.5, 2.9}}, 0, 3, 3), (Rows{".1.", ".1.", ".1."}));
  EXPECT_EQ(stroke({{0, 3}, {3, 3}}, 0, 3, 3), (Rows{"...", "...", "111"}));
  EXPECT_EQ(stroke({{2.9, 1.9}, {2.9, 1.9}}, 0, 3, 3), (Rows{"...", "..1", "..."}));
}

TEST(Strokes, AHugeOneFillsTheImageOnce) {
  std::vector<PixelPoint> points;
  for (int i = 0; i < 4096; ++i) points.push_back({i % 64 + 0.5, i / 64 + 0.5});
  const std::vector<PixelRun> runs = stroke_runs(points, 1e6, 64, 64);
  EXPECT_EQ(runs.size(), 64u);
  EXPECT_EQ(area_of(runs), 64 * 64);
}

}  // namespace
}  // namespace semfield
