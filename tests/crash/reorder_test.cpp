// Power cuts that nobody can stage: every state of the disk that a recorded save allows holds the old or the new whole,
// and the new one once the save has returned.
#include <gtest/gtest.h>

#include <cstdio>
#include <filesystem>

#include "tests/crash/reorder_model.h"

namespace semfield::testing_crash {
namespace {

class TempFolder {
 public:
  TempFolder() {
    path_ = (std::filesystem::temp_directory_path() / "semfield_reorder_XXXXXX").string();
    if (mkdtemp(path_.data()) == nullptr) throw Error(ErrorKind::io, "test.error.made", "cannot make " + path_);
  }
  ~TempFolder() {
    std::error_code ignored;
    std::filesystem::remove_all(path_, ignored);
  }
  std::string path() const { return path_; }

 private:
  std::string path_;
};

struct Verdict {
  int states = 0, torn = 0, forgotten = 0, found_old = 0, found_new = 0;
  std::string first;  // what the first bad state was
};

Verdict judge(Save what, const std::vector<FileCall>& calls, const DiskState& before, const std::string& root) {
  const Undisturbed& u = undisturbed(what);
  const TempFolder disk;
  Verdict v;
  v.states = ReorderModel(before, root, calls).each_state([&](const DiskState& state, std::size_t done) {
    write_disk(state, disk.path() + "/d");
    const Look found = look(what, disk.path() + "/d");
    const bool is_old = found.bad.empty() && found.crc == u.old_crc,
               is_new = found.bad.empty() && found.crc == u.new_crc;
    const bool forgotten = !is_new && done == calls.size();
    v.found_old += is_old ? 1 : 0;
    v.found_new += is_new ? 1 : 0;
    v.torn += is_old || is_new ? 0 : 1;
    v.forgotten += forgotten ? 1 : 0;
    if ((forgotten || (!is_old && !is_new)) && v.first.empty())
      v.first = "after " + std::to_string(done) + " calls: " + (found.bad.empty() ? "the old one" : found.bad);
  });
  return v;
}

class Reorder : public ::testing::TestWithParam<Save> {
 protected:
  void SetUp() override {
    Trial trial(GetParam());
    before_ = read_disk(trial.folder());
    root_ = trial.folder();
    ASSERT_EQ(trial.save().code, 0);
    calls_ = trial.calls();
  }
  // The record without the calls that `drop` picks: a program that forgot them.
  template <class Drop>
  std::vector<FileCall> without(Drop&& drop) const {
    std::vector<FileCall> kept;
    for (const FileCall& c : calls_) {
      if (!drop(c)) kept.push_back(c);
    }
    return kept;
  }
  DiskState before_;
  std::string root_;
  std::vector<FileCall> calls_;
};

TEST_P(Reorder, EveryStateHoldsTheOldOrTheNewAndInTheEndTheNew) {
  const Verdict v = judge(GetParam(), calls_, before_, root_);
  EXPECT_EQ(v.torn, 0) << v.first;
  EXPECT_EQ(v.forgotten, 0) << v.first;
  EXPECT_GT(v.found_old, 0);
  EXPECT_GT(v.found_new, 0);
  std::printf("%s: %zu calls, %d states, %d hold the old, %d the new\n", name_of(GetParam()), calls_.size(), v.states,
              v.found_old, v.found_new);
}

// The model sees what it is for: without its syncs the same save is not safe.
TEST_P(Reorder, ASaveWithoutItsSyncsIsFoundOut) {
  const auto is_folder = [&](const FileCall& c) {
    return c.name == "fsync" && c.path.find(".tmp") == std::string::npos;
  };
  const Verdict no_folder = judge(GetParam(), without(is_folder), before_, root_);
  EXPECT_GT(no_folder.forgotten, 0) << "the folder's fsync is not needed, or the model is blind to it";
  const auto is_file = [&](const FileCall& c) { return c.name == "fsync" && !is_folder(c); };
  const Verdict no_file = judge(GetParam(), without(is_file), before_, root_);
  EXPECT_GT(no_file.forgotten + no_file.torn, 0) << "the file's fsync is not needed, or the model is blind to it";
}

std::string param_name(const ::testing::TestParamInfo<Save>& info) { return name_of(info.param); }
INSTANTIATE_TEST_SUITE_P(EverySave, Reorder, ::testing::ValuesIn(kSaves), param_name);

}  // namespace
}  // namespace semfield::testing_crash
