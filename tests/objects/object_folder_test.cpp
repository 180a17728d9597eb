// The folder of objects that pages edit: nothing is half done, nothing is lost, and nobody edits what he has not seen.
#include <gtest/gtest.h>
#include <sys/resource.h>

#include <csignal>
#include <nlohmann/json.hpp>
#include <thread>
#include <vector>

#include "app/objects/object_files.h"
#include "app/objects/object_tables.h"
#include "core/error.h"
#include "system/files.h"
#include "tests/objects/blocks.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield::app {
namespace {

SceneInfo info_of_blocks() {
  SceneInfo info;
  info.classes = ClassTable({{1, "chair", {}, false}, {2, "table", {}, false}});
  return info;
}

ObjectEdit rename(int object, const std::string& name) {
  return parse_object_edit(nlohmann::json({{"do", "rename"}, {"object", object}, {"name", name}}).dump(), "here");
}

class ObjectFolders : public ::testing::Test {
 protected:
  ObjectFolders() {
    write_object_set(dir_ / "found.safetensors", testing_objects::blocks());
    folder_.mend();
  }

  std::string edits() const {
    const std::string path = dir_ / "edits.json";
    return std::filesystem::exists(path) ? read_text_file(path) : "";
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
  write_object_edits(dir_ / "edits.json", next.edits);
  ObjectFolder(dir_.path(), info_).mend();
  EXPECT_EQ(table(), "saved;not saved;chair 3;");
  std::filesystem::remove(dir_ / "objects.ply");
  ObjectFolder(dir_.path(), info_).mend();
  EXPECT_TRUE(std::filesystem::exists(dir_ / "objects.ply"));
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
  std::filesystem::remove(dir_ / "found.safetensors");
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

TEST_F(ObjectFolders, OneProgramAtATimeChangesThem) {
  const FolderLock alone = hold_objects(dir_.path(), 0);
  EXPECT_ERROR(hold_objects(dir_.path(), 0), "objects.folder.busy", dir_.path(), "process ");
}

}  // namespace
}  // namespace semfield::app
