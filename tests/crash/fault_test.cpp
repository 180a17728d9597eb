// A save whose n-th file call fails, for all n: it succeeds where the failure means nothing, and else ends with the
// right kind of error, the old data and no temporary file. (G18)
#include <algorithm>
#include <cerrno>
#include <cstdio>
#include <cstring>

#include "tests/crash/reorder_model.h"
#include "tests/crash/victim_runs.h"

namespace semfield::testing_crash {
namespace {

bool creates(const FileCall& call) { return call.name == "open" && (call.size & O_CREAT) != 0; }

// Errors that a kind of call can give.
std::vector<int> causes_of(const FileCall& call) {
  if (call.name == "open" && creates(call)) return {ENOSPC, EDQUOT, EIO, EINTR, EMFILE, EACCES, EROFS};
  if (call.name == "open") return {EIO, EINTR, EMFILE};
  if (call.name == "read") return {EIO, EINTR};
  if (call.name == "write") return {ENOSPC, EDQUOT, EIO, EINTR, EFBIG};
  if (call.name == "fsync") return {EIO, ENOSPC, EDQUOT, EINTR};
  if (call.name == "close") return {EIO, EINTR};
  if (call.name == "flock") return {EINTR, ENOLCK, EWOULDBLOCK};
  if (call.name == "rename") return {EXDEV, EACCES, EIO, ENOSPC};
  if (call.name == "unlink") return {EIO, EACCES};
  if (call.name == "mkdir") return {ENOSPC, EACCES, EIO};
  return {EIO};
}

// Failures that may not disturb the save: those that POSIX wants tried again, locks (another name is taken, or none is
// needed), closing what is synced, old checkpoints that stay on the disk, and folders that are there already.
bool harmless(const FileCall& call, int cause) {
  const bool sets_aside = call.name == "rename" && call.other.ends_with(".abandoned");
  return cause == EINTR || call.name == "flock" || call.name == "close" || call.name == "unlink" || sets_aside ||
         (call.name == "mkdir" && call.cause == EEXIST);
}

int exit_code_of(int cause) { return cause == EACCES || cause == EROFS ? 73 : 74; }

std::string word_of(int cause) {
  return cause == ENOSPC || cause == EDQUOT ? "disk full: need "
         : cause == EFBIG                   ? "the limit of a file's size is reached: need "
                                            : std::strerror(cause);
}

// An fsync that failed is final: the same descriptor is not synced again.
void expect_no_second_sync(const std::vector<FileCall>& calls, const std::string& place) {
  for (auto call = calls.begin(); call != calls.end(); ++call) {
    if (call->name != "fsync" || call->result == 0 || call->cause == EINTR) continue;
    for (auto later = call + 1; later != calls.end() && later->descriptor == call->descriptor; ++later)
      EXPECT_NE(later->name, "fsync") << place;
  }
}

class Faults : public ::testing::TestWithParam<Save> {};

TEST_P(Faults, AtEveryCallKeepTheOldDataAndSayWhy) {
  const Undisturbed& u = undisturbed(GetParam());
  // The call that makes the new data the data; behind it an error is reported, and the new stays.
  const auto replaces = std::find_if(u.calls.begin(), u.calls.end(), [](const FileCall& c) {
    return c.name == "rename" &&
           (c.other.ends_with(".safetensors") || c.other.ends_with(".yaml") || c.other.ends_with(".sfpack"));
  });
  ASSERT_NE(replaces, u.calls.end());
  // A folder of checkpoints is first looked through for leftovers; what cannot be looked at stays. Libraries differ in
  // whether that opening can be seen; the one after the first file was made belongs to the save.
  const auto makes = std::find_if(u.calls.begin(), u.calls.end(), creates);
  const auto found_look = std::find_if(u.calls.begin(), makes, [](const FileCall& c) {
    return c.name == "open" && (c.size & O_DIRECTORY) != 0 && c.path.ends_with("/checkpoints");
  });
  const long look_number = found_look == makes ? -1 : found_look->number;
  int faults = 0, refused = 0, survived = 0;
  for (const FileCall& call : u.calls) {
    for (const int cause : causes_of(call)) {
      for (const bool sticky : {false, true}) {
        if (sticky && (cause != ENOSPC || (call.name != "write" && !creates(call)))) continue;
        const std::string place = std::string(std::strerror(cause)) + (sticky ? " from" : " at") + " call " +
                                  std::to_string(call.number) + ", " + call.name + " " + call.path;
        Trial trial(GetParam());
        const testing_program::Result r = trial.save({call.number, std::to_string(cause), sticky});
        const std::vector<FileCall> calls = trial.calls();
        ++faults;
        if (harmless(call, cause) || call.number == look_number) {
          ++survived;
          EXPECT_EQ(r.code, 0) << place << ": " << r.err;
        } else {
          ++refused;
          EXPECT_EQ(r.code, exit_code_of(cause)) << place << ": " << r.err;
          EXPECT_HAS(r.err, trial.folder()) << place << " names no path: " << r.err;
          EXPECT_HAS(r.err, word_of(cause)) << place << " names no cause: " << r.err;
          EXPECT_HAS(r.err, "; ") << place << " names no remedy: " << r.err;
        }
        // A temporary file stays only where removing it is what failed.
        for (const auto& entry : std::filesystem::recursive_directory_iterator(trial.folder()))
          EXPECT_NE(entry.path().extension(), ".tmp") << place;
        expect_no_second_sync(calls, place);
        const Look found = trial.look();
        EXPECT_EQ(found.bad, "") << place;
        const bool renewed = r.code == 0 || call.number > replaces->number;
        EXPECT_EQ(found.crc, renewed ? u.new_crc : u.old_crc) << place;
      }
    }
  }
  EXPECT_GT(refused, 10);
  EXPECT_GT(survived, 5);
  std::printf("%s: %zu calls, %d faults, %d refused, %d survived\n", name_of(GetParam()), u.calls.size(), faults,
              refused, survived);
}

TEST_P(Faults, ShortWritesAreGoneOnWith) {
  const Undisturbed& u = undisturbed(GetParam());
  int tried = 0;
  for (const FileCall& call : u.calls) {
    if (call.name != "write" || call.size < 2) continue;
    Trial trial(GetParam());
    const testing_program::Result r = trial.save({call.number, "short", false});
    EXPECT_EQ(r.code, 0) << r.err;
    EXPECT_GT(trial.calls().size(), u.calls.size()) << "the rest was not written by a call of its own";
    EXPECT_EQ(trial.look().crc, u.new_crc);
    ++tried;
  }
  EXPECT_GE(tried, 1);
}

std::string param_name(const ::testing::TestParamInfo<Save>& info) { return name_of(info.param); }
INSTANTIATE_TEST_SUITE_P(EverySave, Faults, ::testing::ValuesIn(kSaves), param_name);

TEST(FaultMessages, AFullDiskSaysWhatIsKept) {
  const Undisturbed& u = undisturbed(Save::checkpoint);
  const auto write = std::find_if(u.calls.begin(), u.calls.end(), [](const FileCall& c) { return c.name == "write"; });
  Trial trial(Save::checkpoint);
  const testing_program::Result r = trial.save({write->number, std::to_string(ENOSPC), true});
  EXPECT_EQ(r.code, 74);
  EXPECT_HAS(r.err, "while saving the checkpoint of step 300 (the checkpoint of step 200 is kept): cannot write '",
             "disk full: need " + std::to_string(write->size) + " bytes, have ");
}

// A save killed before, in and after every one of its file calls: a fresh process finds the old or the new, whole.

class Kill : public ::testing::TestWithParam<Save> {};

TEST_P(Kill, AtEveryCallLeavesTheOldOrTheNewWhole) {
  const Undisturbed& u = undisturbed(GetParam());
  int kills = 0, found_old = 0, found_new = 0, stale = 0;
  for (const FileCall& call : u.calls) {
    for (const char* kind : {"kill_before", "kill_half", "kill_after"}) {
      if (std::string(kind) == "kill_half" && (call.name != "write" || call.size < 2)) continue;
      const std::string place = std::string(kind) + " " + call.name + " " + call.path + ", call " +
                                std::to_string(call.number) + " of " + std::to_string(u.calls.size());
      Trial trial(GetParam());
      const testing_program::Result r = trial.save({call.number, kind, false});
      ASSERT_EQ(r.signal, SIGKILL) << place;
      ++kills;
      for (const auto& entry : std::filesystem::recursive_directory_iterator(trial.folder()))
        stale += entry.path().extension() == ".tmp" ? 1 : 0;
      const Look found = trial.look();
      EXPECT_EQ(found.bad, "") << place;
      EXPECT_EQ(found.temporaries, 0) << place;
      EXPECT_TRUE(found.crc == u.old_crc || found.crc == u.new_crc) << place;
      (found.crc == u.old_crc ? found_old : found_new) += 1;
      // The same save again, by a next process, ends as if nothing had been.
      const testing_program::Result again = trial.save();
      EXPECT_EQ(again.code, 0) << place << ": " << again.err;
      EXPECT_EQ(trial.look().crc, u.new_crc) << place;
    }
  }
  EXPECT_GT(found_old, 0);
  EXPECT_GT(found_new, 0);
  EXPECT_GT(stale, 0) << "no kill left a temporary file, so their removal was not tried";
  std::printf("%s: %zu calls, %d kills, %d found the old, %d the new, %d left a temporary file\n", name_of(GetParam()),
              u.calls.size(), kills, found_old, found_new, stale);
}

INSTANTIATE_TEST_SUITE_P(EverySave, Kill, ::testing::ValuesIn(kSaves), param_name);

// Power cuts that nobody can stage: every state of the disk that a recorded save allows holds the old or the new whole,
// and the new one once the save has returned.

struct Verdict {
  int states = 0, torn = 0, forgotten = 0, found_old = 0, found_new = 0;
  std::string first;  // what the first bad state was
};

Verdict judge(Save what, const std::vector<FileCall>& calls, const DiskState& before, const std::string& root) {
  const Undisturbed& u = undisturbed(what);
  const TempDir disk;
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

INSTANTIATE_TEST_SUITE_P(EverySave, Reorder, ::testing::ValuesIn(kSaves), param_name);

}  // namespace
}  // namespace semfield::testing_crash
