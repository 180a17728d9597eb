// Edits of objects: what they change, what they refuse, and the files that keep them.
#include "objects/object_edits.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>

#include "core/error.h"
#include "formats/safetensors.h"
#include "system/files.h"
#include "tests/objects/blocks.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

using testing_objects::blocks;
using testing_objects::kCell;

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
  for (const char* bad :
       {"{", "[]", R"({"do": "melt", "object": 1})", R"({"do": "rename", "object": 0, "name": "x"})",
        R"({"do": "rename", "object": 1})", R"({"do": "merge", "objects": [1]})",
        R"({"do": "split", "object": 1, "at": [[0, 0, 0]]})", R"({"do": "split", "object": 1, "at": [[0, 0], [1, 1]]})",
        R"({"do": "split", "object": 1, "at": [[0, 0, 1e300], [1, 1, 1]]})",
        R"({"do": "rename", "object": 4294967297, "name": "x"})",
        R"({"do": "rename", "object": 18446744073709551615, "name": "x"})",
        R"({"do": "rename", "object": 1, "name": "a\tb"})", R"({"do": "rename", "object": 1, "name": "a\nb"})",
        R"({"do": "rename", "object": 1, "name": "\u007f"})"})
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
  const EditedObjects read = read_edited_objects(dir.path(), 2);
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
  EXPECT_ERROR(read_edited_objects(dir.path(), 2), "objects.edits.foreign", "edits.json", "4 edits");
  write_file_atomic(dir / "edits.json", std::string_view(R"({"objects": "x", "edits": [{"do": "split"}]})"));
  EXPECT_ERROR(read_edited_objects(dir.path(), 2), "objects.edit.invalid", "edits.json", "edit 1", "object");
}

// Many at once do what they do one by one, and objects are counted in the end as they are after each.
TEST(ObjectEdits, TogetherTheyAreAsOneByOne) {
  ObjectEdits edits{
      blocks().digest(),
      {edit(R"({"do": "split", "object": 2})"), edit(R"({"do": "merge", "objects": [3, 4, 2]})"),
       edit(R"({"do": "split", "object": 3})"),
       edit(R"({"do": "split", "object": 1, "plane": [[0.8, 0.1, 0.05], [0.8, 0.2, 0.05], [0.8, 0, 9]]})"),
       edit(R"({"do": "rename", "object": 5, "name": "far"})")}};
  ObjectSet together = blocks(), one_by_one = blocks();
  apply_edits(together, edits, "edits.json");
  for (const ObjectEdit& one : edits.edits) apply_edit(one_by_one, one);
  EXPECT_EQ(together.id, one_by_one.id);
  ASSERT_EQ(together.rows.size(), one_by_one.rows.size());
  for (std::size_t o = 0; o < together.rows.size(); ++o) {
    const ObjectRow &a = together.rows[o], &b = one_by_one.rows[o];
    EXPECT_EQ(a.id, b.id);
    EXPECT_EQ(a.points, count(together, a.id));
    EXPECT_EQ(a.points, b.points);
    EXPECT_EQ(a.name, b.name);
    EXPECT_EQ(a.class_index, b.class_index);
    EXPECT_EQ(a.class_probability, b.class_probability);
    EXPECT_EQ(a.area, b.area);
    EXPECT_EQ(a.box.center, b.box.center);
    EXPECT_EQ(a.box.size, b.box.size);
  }
  edits.edits.push_back(edit(R"({"do": "merge", "objects": [1, 2]})"));
  EXPECT_ERROR(apply_edits(one_by_one = blocks(), edits, "edits.json"), "objects.edit.invalid", "edits.json: edit 6",
               "object 2");
}

// Writes found.safetensors with one number of one tensor changed, checksums and all.
template <class T>
void change(const std::string& path, const std::string& name, std::size_t at, T value) {
  write_object_set(path, blocks());
  const TensorFile file = TensorFile::read(path);
  std::vector<TensorRef> tensors = file.tensors();
  std::vector<std::byte> bytes;
  for (TensorRef& tensor : tensors) {
    if (tensor.name != name) continue;
    bytes.assign(tensor.bytes.begin(), tensor.bytes.end());
    std::memcpy(bytes.data() + at * sizeof value, &value, sizeof value);
    tensor.bytes = bytes;
  }
  ASSERT_FALSE(bytes.empty()) << name;
  write_safetensors(path, tensors, file.metadata());
}

TEST(ObjectSets, NumbersThatCannotBeAreRefused) {
  const TempDir dir;
  const std::string path = dir / "found.safetensors";
  constexpr int kClasses = 2;
  const struct {
    const char* tensor;
    std::size_t at;
    std::int64_t value;
    const char* shown;
  } whole[] = {{"row.class", 0, -5, "-5"},
               {"row.class", 1, 196610, "196610"},
               {"row.class", 1, 2, "is 2"},
               {"class", 3, 65536, "65536"},
               {"class", 3, -2, "-2"},
               {"id", 0, 4, "is 4"},
               {"id", 0, -1, "-1"},
               {"id", 0, 1LL << 32, "4294967296"},
               {"row.views", 0, -1, "-1"},
               {"row.views", 0, 1LL << 32, "4294967296"},
               {"place", 0, 1LL << 32, "4294967296"},
               {"place", 0, 1 << 20, "point 1"},
               {"place", 0, 5, "point 1"}};
  for (const auto& bad : whole) {
    change(path, bad.tensor, bad.at, bad.value);
    EXPECT_ERROR(read_object_set(path, kClasses), "objects.found.unreadable", path, bad.shown);
  }
  const struct {
    const char* tensor;
    double value;
  } real[] = {{"cell", -1},    {"cell", 0},      {"cell", 1e300},         {"position", 1e300},
              {"position", 7}, {"cell", 1e-300}, {"row.agreement", -0.1}, {"row.agreement", 2}};
  for (const auto& bad : real) {
    change(path, bad.tensor, 0, bad.value);
    EXPECT_ERROR(read_object_set(path, kClasses), "objects.found.unreadable", path);
  }
  for (const char* about : {"", "[]", "{\"step\": \"x\"}", "{\"step\": -1}"}) {
    ObjectSet set = blocks();
    set.about = about;
    write_object_set(path, set);
    EXPECT_ERROR(read_object_set(path, kClasses), "objects.found.unreadable", path, "about");
  }
  write_file_atomic(path, std::string_view("no tensors"));
  EXPECT_ERROR(read_object_set(path, kClasses), "objects.found.unreadable", path, "semfield objects");
  write_object_set(path, blocks());
  EXPECT_EQ(read_object_set(path, kClasses).id, blocks().id);
}

}  // namespace
}  // namespace semfield
