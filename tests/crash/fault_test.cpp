// A save whose n-th file call fails, for all n: it succeeds where the failure means nothing, and else ends with the
// right kind of error, the old data and no temporary file. (G18)
#include <gtest/gtest.h>

#include <algorithm>
#include <cerrno>
#include <cstdio>
#include <cstring>
#include <filesystem>

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
  // The call that makes the new data the data; behind it an error is told, and the new stays.
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
          EXPECT_NE(r.err.find(trial.folder()), std::string::npos) << place << " names no path: " << r.err;
          EXPECT_NE(r.err.find(word_of(cause)), std::string::npos) << place << " names no cause: " << r.err;
          EXPECT_NE(r.err.find("; "), std::string::npos) << place << " names no remedy: " << r.err;
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
  EXPECT_NE(r.err.find("while saving the checkpoint of step 300 (the checkpoint of step 200 is kept): cannot write '"),
            std::string::npos)
      << r.err;
  EXPECT_NE(r.err.find("disk full: need " + std::to_string(write->size) + " bytes, have "), std::string::npos) << r.err;
}

}  // namespace
}  // namespace semfield::testing_crash
