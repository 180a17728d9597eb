// Class tables: three file formats, numbering, refusals.
#include "classes/class_table.h"

#include <gtest/gtest.h>

#include <set>

#include "system/files.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using testing_room::error_of;
using testing_room::fresh_folder;

TEST(ClassTable, NumbersValidClassesInOrderOfId) {
  const ClassTable t(
      {{7, "chair", {1, 2, 3}, false}, {0, "void", {}, true}, {3, "wall", {}, false}, {9, "hand", {}, true}});
  EXPECT_EQ(t.valid_count(), 2);
  EXPECT_EQ(t.index_of(3), 0);
  EXPECT_EQ(t.index_of(7), 1);
  EXPECT_EQ(t.index_of(0), kVoid);
  EXPECT_EQ(t.index_of(9), kVoid);
  EXPECT_EQ(t.index_of(4), -2);
  EXPECT_EQ(t.index_of(1000), -2);
  EXPECT_EQ(t.index_of(-1), -2);
  EXPECT_EQ(t.id_of(1), 7);
  EXPECT_EQ(t.id_of(kVoid), 0);
  EXPECT_EQ(t.valid(1).name, "chair");
}

TEST(ClassTable, YamlRoundTripKeepsEverything) {
  const std::string path = fresh_folder("t") + "/classes.yaml";
  const ClassTable t(
      {{0, "void", {0, 0, 0}, true}, {3, "wall \"a\" \\ b", {10, 20, 255}, false}, {4, "yes", {1, 1, 1}, false}});
  write_file_atomic(path, t.to_yaml());
  const ClassTable back = ClassTable::load(path);
  ASSERT_EQ(back.entries().size(), 3u);
  for (std::size_t i = 0; i < 3; ++i) {
    EXPECT_EQ(back.entries()[i].id, t.entries()[i].id);
    EXPECT_EQ(back.entries()[i].name, t.entries()[i].name);
    EXPECT_EQ(back.entries()[i].color, t.entries()[i].color);
    EXPECT_EQ(back.entries()[i].ignore, t.entries()[i].ignore);
  }
}

TEST(ClassTable, CsvSkipsTheHeaderAndIgnoresVoid) {
  const std::string path = fresh_folder("t") + "/classes.csv";
  write_file_atomic(path, std::string_view("class_id,class\r\n0,Undefined\r\n2,base, cabinet\r\n\r\n1,wall\r\n"));
  const ClassTable t = ClassTable::load(path);
  EXPECT_EQ(t.valid_count(), 2);
  EXPECT_TRUE(t.entries()[0].ignore);
  EXPECT_EQ(t.valid(0).name, "wall");
  EXPECT_EQ(t.valid(1).name, "base, cabinet");
}

TEST(ClassTable, ReplicaJsonGetsAVoidClass) {
  const std::string path = fresh_folder("t") + "/info_semantic.json";
  write_file_atomic(
      path,
      std::string_view(R"({"classes": [{"id": 2, "name": "b"}, {"id": 1, "name": "a"}, {"id": -1, "name": "x"}]})"));
  const ClassTable t = ClassTable::load(path);
  EXPECT_EQ(t.valid_count(), 2);
  EXPECT_EQ(t.index_of(0), kVoid);
  EXPECT_EQ(t.index_of(2), 1);
}

TEST(ClassTable, RefusalsNamePlaceAndRemedy) {
  const std::string folder = fresh_folder("t");
  const auto load = [&](const std::string& name, const std::string& text) {
    write_file_atomic(folder + "/" + name, text);
    return error_of([&] { (void)ClassTable::load(folder + "/" + name); });
  };
  EXPECT_EQ(load("a.csv", "id,name\n1,wall\nx2,floor\n"),
            folder + "/a.csv:3: expected a class id, got 'x2'; write one line 'id,name' for each class");
  EXPECT_EQ(load("b.csv", "1,wall\n1,floor\n"),
            folder + "/b.csv: class id 1 is given twice ('wall' and 'floor'); keep one of them");
  EXPECT_EQ(load("c.yaml", "- {id: 1, name: wall, colour: [1, 2, 3]}\n").find(folder + "/c.yaml:1:"), 0u);
  EXPECT_NE(load("c.yaml", "- {id: 1, name: wall, colour: [1, 2, 3]}\n")
                .find("unknown key 'colour' of a class; did you mean 'color'?"),
            std::string::npos);
  EXPECT_NE(load("d.yaml", "- {id: 1, name: wall, color: [1, 2, 300]}\n")
                .find("color: expected an integer from 0 to 255, got '300'"),
            std::string::npos);
  EXPECT_NE(load("e.json", "{\"classes\": 3}").find("no list 'classes' in it"), std::string::npos);
  EXPECT_NE(load("f.txt", "1,wall\n").find("is not a class table; give a .yaml, .csv or .json file"),
            std::string::npos);
  EXPECT_NE(error_of([] { ClassTable({{-4, "x", {}, false}}); }).find("has id -4"), std::string::npos);
  std::vector<ClassEntry> many;
  for (int i = 0; i < 1025; ++i) many.push_back({i, "c", {}, false});
  EXPECT_NE(error_of([&] { (void)ClassTable(many); }).find("1025 classes; at most 1024"), std::string::npos);
}

TEST(ClassTable, DefaultColorsDiffer) {
  std::set<std::array<std::uint8_t, 3>> seen;
  for (int id = 0; id < 200; ++id) seen.insert(ClassTable::default_color(id));
  EXPECT_EQ(seen.size(), 200u);
}

}  // namespace
}  // namespace semfield
