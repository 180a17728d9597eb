// A small set of objects: blocks of cells in a row.

#include <sys/resource.h>

#include <algorithm>
#include <csignal>
#include <cstddef>
#include <cstring>
#include <nlohmann/json.hpp>
#include <thread>
#include <vector>

#include "app/objects/object_files.h"
#include "formats/safetensors.h"
#include "surface/objects/object_set.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield::testing_objects {
namespace {

inline constexpr double kCell = 0.1;

// Points of blocks along x, one per cell: object 1 has a block of 6 x 4 cells, a bridge of one row of 5 cells and a
// block of 4 x 4 cells; object 2 two blocks of 4 x 4 and of 3 x 4 that do not touch, and one cell alone; object 3 a
// block.
inline ObjectSet blocks() {
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

}  // namespace
}  // namespace semfield::testing_objects

namespace semfield {
namespace {

// Edits of objects: what they change, what they refuse, and the files that keep them.

using testing_objects::blocks;
using testing_objects::kCell;

std::int64_t count(const ObjectSet& set, std::int32_t id) { return std::count(set.id.begin(), set.id.end(), id); }

ObjectEdit edit(const std::string& json) { return parse_object_edit(json, "here"); }

struct EditedBlocks : testing::Test {
  ObjectSet set = blocks();
};

TEST_F(EditedBlocks, ANameIsGivenAndTaken) {
  apply_edit(set, edit(R"({"do": "rename", "object": 2, "name": "my \"stools\""})"));
  EXPECT_EQ(set.rows[1].name, "my \"stools\"");
  apply_edit(set, edit(R"({"do": "rename", "object": 2, "name": ""})"));
  EXPECT_EQ(set.rows[1].name, "");
  EXPECT_EQ(set.id, blocks().id);
}

TEST_F(EditedBlocks, TheFirstOfMergedObjectsStays) {
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

TEST_F(EditedBlocks, PiecesThatDoNotTouchArePartedAndCrumbsStay) {
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

TEST_F(EditedBlocks, TwoPlacesPartWhatTouches) {
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
TEST_F(EditedBlocks, APlanePartsWhatLiesOnItsSides) {
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

TEST_F(EditedBlocks, WhatCannotBeIsRefusedWithTheObject) {
  EXPECT_ERROR(apply_edit(set, edit(R"({"do": "merge", "objects": [1, 9]})")), "objects.edit.invalid", "object 9");
  EXPECT_ERROR(apply_edit(set, edit(R"({"do": "merge", "objects": [1, 1]})")), "objects.edit.invalid", "twice");
  EXPECT_ERROR(apply_edit(set, edit(R"({"do": "split", "object": 1, "at": [[0.05, 0.05, 0.05], [2.05, 0.05, 0.05]]})")),
               "objects.edit.invalid", "object 1");
  for (const char* bad :
       {"{", "[]", R"({"do": "melt", "object": 1})", R"({"do": "rename", "object": 0, "name": "x"})",
        R"({"do": "rename", "object": 1})", R"({"do": "merge", "objects": [1]})",
        R"({"do": "split", "object": 1, "at": [[0, 0, 0]]})", R"({"do": "split", "object": 1, "at": [[0, 0], [1, 1]]})",
        R"({"do": "split", "object": 1, "at": [[0, 0, 1e300], [1, 1, 1]]})",
        R"({"do": "rename", "object": 4294967297, "name": "x"})", R"({"do": "rename", "object": 1, "name": "a\tb"})",
        R"({"do": "rename", "object": 1, "name": "\u007f"})"})
    EXPECT_ERROR(edit(bad), "objects.edit.invalid", "here");
}

TEST_F(EditedBlocks, PlacesOffThePointsTakeWhatIsNear) {
  EXPECT_EQ(set.at({0.05, 0.05, 0.12}), 1) << "the cell beside";
  EXPECT_EQ(set.at({0.05, 0.05, 0.3}), 1) << "within four cells";
  EXPECT_EQ(set.at({0.05, 0.05, 0.8}), 0);
}

TEST_F(EditedBlocks, FilesKeepObjectsAndEditsAndKnowThoseOfOthers) {
  const TempDir dir;
  set.up = Vec3d{0, 0, 1};
  write_object_set(dir / "found.safetensors", set);
  ObjectEdits edits{set.digest(),
                    {edit(R"({"do": "merge", "objects": [1, 3]})"),
                     edit(R"({"do": "split", "object": 1, "at": [[1.35, 0.15, 0.05], [0.05, 0.05, 0.05]]})"),
                     edit(R"({"do": "rename", "object": 4, "name": "small"})"),
                     edit(R"({"do": "split", "object": 2, "plane": [[2.5, 0, 0], [2.5, 1, 0], [2.5, 0, 1]]})")}};
  write_file_atomic(dir / "edits.json", object_edits_text(edits));
  for (const ObjectEdit& one : edits.edits) apply_edit(set, one);
  const EditedObjects read = read_edited_objects(dir.path(), 2);
  EXPECT_EQ(read.set.id, set.id);
  EXPECT_EQ(read.set.position, set.position);
  EXPECT_EQ(read.set.up, set.up);
  EXPECT_EQ(read.set.rows[1].box.axis[2], *set.up);
  EXPECT_EQ(read.set.class_of, set.class_of);
  EXPECT_EQ(read.set.about, set.about);
  ASSERT_EQ(read.set.rows.size(), set.rows.size());
  EXPECT_EQ(read.set.rows[3].name, "small");
  EXPECT_EQ(read.set.rows[0].views, 30);
  EXPECT_EQ(read.edits.edits.size(), 4u);
  EXPECT_EQ(read.edits.edits[3].plane, edits.edits[3].plane);
  edits.digest = "0123456789abcdef";
  write_file_atomic(dir / "edits.json", object_edits_text(edits));
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
    EXPECT_EQ(std::tie(a.points, a.name, a.class_index, a.class_probability, a.area),
              std::tie(b.points, b.name, b.class_index, b.class_probability, b.area));
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
  } whole[] = {{"row.class", 1, 2},  {"class", 3, 65536},     {"id", 0, 4},          {"id", 0, -1},
               {"row.views", 0, -1}, {"place", 0, 1LL << 32}, {"place", 0, 1 << 20}, {"place", 0, 5}};
  for (const auto& bad : whole) {
    change(path, bad.tensor, bad.at, bad.value);
    EXPECT_ERROR(read_object_set(path, kClasses), "objects.found.unreadable", path);
  }
  for (const auto& [tensor, value] :
       {std::pair{"cell", 0.0}, {"cell", 1e300}, {"position", 1e300}, {"position", 7}, {"row.agreement", 2}}) {
    change(path, tensor, 0, value);
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

namespace semfield::app {
namespace {

// The folder of objects that pages edit: nothing is half done, nothing is lost, and nobody edits what he has not seen.

SceneInfo info_of_blocks() {
  SceneInfo info;
  info.classes = ClassTable({{1, "chair", {}, false}, {2, "table", {}, false}});
  return info;
}

ObjectEdit rename(int object, const std::string& name) {
  return parse_object_edit(nlohmann::json({{"do", "rename"}, {"object", object}, {"name", name}}).dump(), "here");
}

struct ObjectFolders : ::testing::Test {
  ObjectFolders() {
    write_object_set(dir_ / "found.safetensors", testing_objects::blocks());
    folder_.mend();
  }

  std::string edits() const {
    const std::string path = dir_ / "edits.json";
    return fs::exists(path) ? read_text_file(path) : "";
  }
  // Names of the table's rows.
  std::string table() const {
    const auto root = nlohmann::json::parse(read_text_file(dir_ / "objects.json"));
    std::string names;
    for (const auto& row : root.at("objects")) names += row.at("name").get<std::string>() + ";";
    EXPECT_HAS(read_text_file(dir_ / "objects.csv"), names.substr(0, names.find(';')));
    return names;
  }
  void edit(ObjectFolder& folder, const ObjectEdit& edit) {
    ASSERT_NE(folder.look(), nullptr);
    (void)folder.edit(edit, folder.state());
  }

  const TempDir dir_;
  const SceneInfo info_ = info_of_blocks();
  ObjectFolder folder_{dir_.path(), info_};
};

TEST_F(ObjectFolders, EditsAreKeptAndTakenBack) {
  EXPECT_EQ(table(), "chair 1;table 2;chair 3;");
  edit(folder_, rename(1, "mine"));
  edit(folder_, parse_object_edit(R"({"do": "merge", "objects": [2, 3]})", "here"));
  EXPECT_EQ(table(), "mine;table 2;");
  ObjectFolder other(dir_.path(), info_);
  EXPECT_EQ(other.look()->edits.edits.size(), 2u);
  (void)other.edit(std::nullopt, other.state());
  EXPECT_EQ(table(), "mine;table 2;chair 3;");
  (void)other.edit(std::nullopt, other.state());
  EXPECT_EQ(table(), "chair 1;table 2;chair 3;");
  EXPECT_ERROR(other.edit(std::nullopt, other.state()), "view.undo.none");
}

// Places in a scene of millimetres, or far from 0, are known as finely as those in metres.
TEST_F(ObjectFolders, TablesHoldPlacesOfAnyUnit) {
  EditedObjects objects = *folder_.look();
  objects.set.rows[0].centroid = {1234567.25, 0.000123456789, -2};
  write_object_tables(dir_.path(), objects, info_);
  EXPECT_HAS(read_text_file(dir_ / "objects.csv"), ",1234567.25,0.000123456789,-2,");
}

TEST_F(ObjectFolders, AnEditThatCannotBeChangesNothing) {
  edit(folder_, rename(2, "kept"));
  const std::string before = edits(), tables = table();
  for (const char* bad : {R"({"do": "merge", "objects": [1, 9]})", R"({"do": "split", "object": 1})"}) {
    EXPECT_ERROR(folder_.edit(parse_object_edit(bad, "here"), folder_.state()), "objects.edit.invalid");
    EXPECT_EQ(edits(), before);
    EXPECT_EQ(table(), tables);
  }
}

// The file size limit of the process stands for a full disk: no table of points has room.
TEST_F(ObjectFolders, WhatCannotBeWrittenIsNotSaved) {
  edit(folder_, rename(2, "kept"));
  const std::string before = edits(), tables = table();
  rlimit usual{};
  ASSERT_EQ(::getrlimit(RLIMIT_FSIZE, &usual), 0);
  const auto handler = std::signal(SIGXFSZ, SIG_IGN);
  for (const rlim_t room : {0, 100, 600, 2000}) {
    const rlimit small{room, usual.rlim_max};
    ASSERT_EQ(::setrlimit(RLIMIT_FSIZE, &small), 0);
    EXPECT_ERROR(folder_.edit(rename(1, "lost"), folder_.state()), "files.write.failed");
    ASSERT_EQ(::setrlimit(RLIMIT_FSIZE, &usual), 0);
    EXPECT_EQ(edits(), before) << room;
    ObjectFolder opened(dir_.path(), info_);
    opened.mend();
    EXPECT_EQ(table(), tables) << room;
  }
  std::signal(SIGXFSZ, handler);
  edit(folder_, rename(1, "there"));
  EXPECT_EQ(table(), "there;kept;chair 3;");
}

// As a kill leaves them: tables of an edit that was not saved, a table of the edit before, and no tables.
TEST_F(ObjectFolders, TablesThatAreNotOfTheEditsAreWrittenAnewOnOpening) {
  edit(folder_, rename(1, "saved"));
  EditedObjects next = *folder_.look();
  const ObjectEdit lost = rename(2, "not saved");
  apply_edit(next.set, lost);
  next.edits.edits.push_back(lost);
  write_object_tables(dir_.path(), next, info_);
  EXPECT_EQ(table(), "saved;not saved;chair 3;");
  ObjectFolder(dir_.path(), info_).mend();
  EXPECT_EQ(table(), "saved;table 2;chair 3;");
  write_file_atomic(dir_ / "edits.json", object_edits_text(next.edits));
  ObjectFolder(dir_.path(), info_).mend();
  EXPECT_EQ(table(), "saved;not saved;chair 3;");
  fs::remove(dir_ / "objects.ply");
  ObjectFolder(dir_.path(), info_).mend();
  EXPECT_TRUE(fs::exists(dir_ / "objects.ply"));
  ObjectSet others = testing_objects::blocks();
  std::swap(others.id.front(), others.id.back());
  write_object_set(dir_ / "found.safetensors", others);
  EXPECT_ERROR(ObjectFolder(dir_.path(), info_).mend(), "objects.edits.foreign", "edits.json");
}

TEST_F(ObjectFolders, AnEditOfWhatWasChangedMeanwhileIsRefused) {
  ObjectFolder other(dir_.path(), info_);
  (void)folder_.look();
  (void)other.look();
  const std::string seen = other.state();
  edit(folder_, rename(1, "first"));
  EXPECT_ERROR(other.edit(rename(1, "second"), seen), "objects.edit.stale", "nothing was saved", "load the page again");
  EXPECT_ERROR(other.edit(std::nullopt, seen), "objects.edit.stale");
  EXPECT_EQ(table(), "first;table 2;chair 3;");
  edit(other, rename(2, "second"));
  EXPECT_EQ(table(), "first;second;chair 3;");
  // Undone and done again is what it was.
  const std::string two = other.state();
  (void)folder_.look();
  (void)folder_.edit(std::nullopt, folder_.state());
  EXPECT_NE(folder_.state(), two);
  edit(folder_, rename(2, "second"));
  EXPECT_EQ(folder_.state(), two);
}

TEST_F(ObjectFolders, AnEditOfObjectsThatWereFoundAnewIsRefused) {
  (void)folder_.look();
  const std::string seen = folder_.state();
  ObjectSet others = testing_objects::blocks();
  for (std::int32_t& id : others.id) id = id == 1 ? 3 : id == 3 ? 1 : id;
  write_object_set(dir_ / "found.safetensors", others);
  EXPECT_ERROR(folder_.edit(rename(1, "the big one"), seen), "objects.edit.stale");
  EXPECT_EQ(edits(), "");
  fs::remove(dir_ / "found.safetensors");
  EXPECT_ERROR(folder_.edit(rename(1, "the big one"), seen), "view.objects.none");
}

TEST_F(ObjectFolders, NoEditOfTwoPagesIsLost) {
  constexpr int kEach = 10;
  const auto work = [&](int page) {
    ObjectFolder own(dir_.path(), info_);
    for (int k = 0; k < kEach;) {
      (void)own.look();
      try {
        (void)own.edit(rename(1, std::to_string(page) + "/" + std::to_string(k)), own.state());
        ++k;
      } catch (const Error& e) {
        ASSERT_EQ(std::string(e.code().text()), "objects.edit.stale") << e.what();
      }
    }
  };
  {
    const std::jthread one([&] { work(1); }), two([&] { work(2); });
  }
  const ObjectEdits all = read_object_edits(dir_ / "edits.json");
  EXPECT_EQ(all.edits.size(), 2u * kEach);
  EXPECT_EQ(table(), all.edits.back().name + ";table 2;chair 3;");
}

}  // namespace
}  // namespace semfield::app
