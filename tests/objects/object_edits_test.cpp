// Edits of objects: what they change, what they refuse, and the files that keep them.
#include "objects/object_edits.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <set>

#include "core/error.h"
#include "system/files.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

constexpr double kCell = 0.1;

// Points of blocks along x, one per cell: object 1 has a block of 6 x 4 cells, a bridge of one row of 5 cells and a
// block of 4 x 4 cells; object 2 two blocks of 4 x 4 and of 3 x 4 that do not touch, and one cell alone; object 3 a
// block.
ObjectSet blocks() {
  ObjectSet set;
  set.cells = SurfaceCells(kCell);
  set.about = R"({"run": "room"})";
  const auto block = [&](std::int32_t object, int x0, int wide, int y0, int tall, std::int16_t of_class) {
    for (int x = x0; x < x0 + wide; ++x) {
      for (int y = y0; y < y0 + tall; ++y) {
        set.position.push_back({(x + 0.5) * kCell, (y + 0.5) * kCell, 0.05});
        set.cells.add(set.position.back());
        set.color.push_back({200, 100, 50});
        set.id.push_back(object);
        set.class_of.push_back(of_class);
      }
    }
  };
  block(1, 0, 6, 0, 4, 0);
  block(1, 6, 5, 1, 1, 0);
  block(1, 11, 4, 0, 4, 1);
  block(2, 20, 4, 0, 4, 1);
  block(2, 30, 3, 0, 4, 1);
  block(2, 40, 1, 0, 1, 1);
  block(3, 50, 2, 0, 2, 0);
  for (std::int32_t id = 1; id <= 3; ++id) {
    ObjectRow& row = set.rows.emplace_back();
    row.id = id;
    row.class_index = static_cast<std::int16_t>(id == 2);
    row.views = 10 * id;
    row.agreement = 0.9;
  }
  std::ptrdiff_t points[3] = {};
  for (const std::int32_t id : set.id) ++points[id - 1];
  for (ObjectRow& row : set.rows) row.points = points[row.id - 1];
  return set;
}

std::int64_t count(const ObjectSet& set, std::int32_t id) { return std::count(set.id.begin(), set.id.end(), id); }

ObjectEdit edit(const std::string& json) { return parse_object_edit(json, "here"); }

TEST(ObjectEdits, ANameIsGivenAndTaken) {
  ObjectSet set = blocks();
  apply_edit(set, edit(R"({"do": "rename", "object": 2, "name": "my \"stools\""})"));
  EXPECT_EQ(set.rows[1].name, "my \"stools\"");
  apply_edit(set, edit(R"({"do": "rename", "object": 2, "name": ""})"));
  EXPECT_EQ(set.rows[1].name, "");
  EXPECT_EQ(set.id, blocks().id);
}

TEST(ObjectEdits, TheFirstOfMergedObjectsStays) {
  ObjectSet set = blocks();
  const std::int64_t both = count(set, 2) + count(set, 3);
  apply_edit(set, edit(R"({"do": "merge", "objects": [3, 2]})"));
  EXPECT_EQ(count(set, 3), both);
  EXPECT_EQ(count(set, 2), 0);
  EXPECT_EQ(set.rows[1].points, 0);
  const ObjectRow& row = set.rows[2];
  EXPECT_EQ(row.points, both);
  EXPECT_EQ(row.views, 30);
  EXPECT_EQ(row.class_index, 1) << "of most of its points now";
  EXPECT_NEAR(row.class_probability, static_cast<double>(both - 4) / static_cast<double>(both), 1e-12);
  EXPECT_NEAR(row.area, static_cast<double>(both) * kCell * kCell, 1e-12);
  EXPECT_NEAR(row.box.size.x, 3.1, 0.05) << "from the first block of 2 to the end of 3";
}

TEST(ObjectEdits, PiecesThatDoNotTouchArePartedAndCrumbsStay) {
  ObjectSet set = blocks();
  for (int k = 0; k < 40; ++k) {  // so that a cell is less than a fiftieth
    set.position.push_back({2.05 + 0.1 * (k % 4), 0.45 + 0.1 * (k / 4), 0.05});
    ASSERT_EQ(set.cells.add(set.position.back()), std::ssize(set.id));
    set.color.push_back({});
    set.id.push_back(2);
    set.class_of.push_back(1);
  }
  apply_edit(set, edit(R"({"do": "split", "object": 2})"));
  ASSERT_EQ(set.rows.size(), 4u);
  EXPECT_EQ(count(set, 2), 16 + 40 + 1) << "the largest piece, and the one cell";
  EXPECT_EQ(count(set, 4), 12);
  EXPECT_EQ(set.rows[3].id, 4);
  EXPECT_NEAR(set.rows[3].box.center.x, 3.15, 1e-9);
  EXPECT_EQ(count(set, 1), count(blocks(), 1)) << "others are not touched";
}

TEST(ObjectEdits, TwoPlacesPartWhatTouches) {
  ObjectSet set = blocks();
  EXPECT_ERROR(apply_edit(set, edit(R"({"do": "split", "object": 1})")), "objects.edit.invalid", "object 1");
  EXPECT_EQ(set.id, blocks().id) << "a refused edit changes nothing";
  apply_edit(set, edit(R"({"do": "split", "object": 1, "at": [[1.35, 0.15, 0.05], [0.05, 0.05, 0.05]]})"));
  EXPECT_GT(count(set, 1), count(set, 4)) << "the larger part keeps its id, whichever place came first";
  EXPECT_EQ(count(set, 1) + count(set, 4), count(blocks(), 1));
  EXPECT_EQ(set.at({0.05, 0.05, 0.05}), 1);
  EXPECT_EQ(set.at({1.35, 0.35, 0.05}), 4);
  EXPECT_EQ(set.rows[3].class_index, 1);
  EXPECT_EQ(set.rows[0].class_index, 0);
}

// Object 1 is its two blocks and the bridge between them, cut where its line is seen from above.
TEST(ObjectEdits, APlanePartsWhatLiesOnItsSides) {
  ObjectSet set = blocks();
  const ObjectEdit cut =
      edit(R"({"do": "split", "object": 1, "plane": [[0.8, 0.1, 0.05], [0.8, 0.2, 0.05], [0.8, 0.15, 9]]})");
  apply_edit(set, cut);
  EXPECT_EQ(count(set, 1), 24 + 2);
  EXPECT_EQ(count(set, 4), 16 + 3);
  EXPECT_EQ(set.at({0.75, 0.15, 0.05}), 1);
  EXPECT_EQ(set.at({0.85, 0.15, 0.05}), 4);
  EXPECT_EQ(count(set, 3), 4) << "others on that side are not touched";
  ObjectSet turned = blocks();
  apply_edit(turned, edit(R"({"do": "split", "object": 1, "plane": [[0.8, 0.2, 0], [0.8, 0.1, 0], [0.8, 0.15, 9]]})"));
  EXPECT_EQ(turned.id, set.id) << "the larger part keeps the id, whichever side is first";
  EXPECT_ERROR(apply_edit(set, edit(R"({"do": "split", "object": 3, "plane": [[0, 0, 0], [0, 1, 0], [0, 0, 1]]})")),
               "objects.edit.invalid", "object 3", "one side");
  EXPECT_ERROR(apply_edit(set, edit(R"({"do": "split", "object": 3, "plane": [[0, 0, 0], [0, 1, 0], [0, 2, 0]]})")),
               "objects.edit.invalid", "object 3", "line");
  EXPECT_ERROR(edit(R"({"do": "split", "object": 3, "plane": [[0, 0, 0], [0, 1, 0]]})"), "objects.edit.invalid",
               "plane");
}

TEST(ObjectEdits, WhatCannotBeIsRefusedWithTheObject) {
  ObjectSet set = blocks();
  EXPECT_ERROR(apply_edit(set, edit(R"({"do": "merge", "objects": [1, 9]})")), "objects.edit.invalid", "object 9");
  EXPECT_ERROR(apply_edit(set, edit(R"({"do": "merge", "objects": [1, 1]})")), "objects.edit.invalid", "twice");
  EXPECT_ERROR(apply_edit(set, edit(R"({"do": "split", "object": 1, "at": [[0.05, 0.05, 0.05], [2.05, 0.05, 0.05]]})")),
               "objects.edit.invalid", "object 1");
  for (const char* bad : {"{", "[]", R"({"do": "melt", "object": 1})", R"({"do": "rename", "object": 0, "name": "x"})",
                          R"({"do": "rename", "object": 1})", R"({"do": "merge", "objects": [1]})",
                          R"({"do": "split", "object": 1, "at": [[0, 0, 0]]})",
                          R"({"do": "split", "object": 1, "at": [[0, 0], [1, 1]]})"})
    EXPECT_ERROR(edit(bad), "objects.edit.invalid", "here");
}

TEST(ObjectEdits, PlacesOffThePointsTakeWhatIsNear) {
  const ObjectSet set = blocks();
  EXPECT_EQ(set.at({0.05, 0.05, 0.12}), 1) << "the cell beside";
  EXPECT_EQ(set.at({0.05, 0.05, 0.3}), 1) << "within four cells";
  EXPECT_EQ(set.at({0.05, 0.05, 0.8}), 0);
}

TEST(ObjectEdits, FilesKeepObjectsAndEditsAndKnowThoseOfOthers) {
  const TempDir dir;
  ObjectSet set = blocks();
  write_object_set(dir / "found.safetensors", set);
  ObjectEdits edits{set.digest(),
                    {edit(R"({"do": "merge", "objects": [1, 3]})"),
                     edit(R"({"do": "split", "object": 1, "at": [[1.35, 0.15, 0.05], [0.05, 0.05, 0.05]]})"),
                     edit(R"({"do": "rename", "object": 4, "name": "small"})"),
                     edit(R"({"do": "split", "object": 2, "plane": [[2.5, 0, 0], [2.5, 1, 0], [2.5, 0, 1]]})")}};
  write_object_edits(dir / "edits.json", edits);
  for (const ObjectEdit& one : edits.edits) apply_edit(set, one);
  const EditedObjects read = read_edited_objects(dir.path());
  EXPECT_EQ(read.set.id, set.id);
  EXPECT_EQ(read.set.position, set.position);
  EXPECT_EQ(read.set.class_of, set.class_of);
  EXPECT_EQ(read.set.about, set.about);
  ASSERT_EQ(read.set.rows.size(), set.rows.size());
  EXPECT_EQ(read.set.rows[3].name, "small");
  EXPECT_EQ(read.set.rows[0].views, 30);
  EXPECT_EQ(read.edits.edits.size(), 4u);
  EXPECT_EQ(read.edits.edits[3].plane, edits.edits[3].plane);
  edits.digest = "0123456789abcdef";
  write_object_edits(dir / "edits.json", edits);
  EXPECT_ERROR(read_edited_objects(dir.path()), "objects.edits.foreign", "edits.json", "4 edits");
  write_file_atomic(dir / "edits.json", std::string_view(R"({"objects": "x", "edits": [{"do": "split"}]})"));
  EXPECT_ERROR(read_edited_objects(dir.path()), "objects.edit.invalid", "edits.json", "edit 1", "object");
}

}  // namespace
}  // namespace semfield
