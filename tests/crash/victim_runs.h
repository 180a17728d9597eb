// Runs the victim with a fault planned, and reads back the record of its file calls.
#pragma once

#include "tests/crash/scenarios.h"
#include "tests/program.h"
#include "tests/temp_dir.h"

namespace semfield::testing_crash {

/// One line of the shim's log.
struct FileCall {
  int number = 0;
  std::string name;  ///< open, read, write, fsync, close, flock, ftruncate, rename, link, unlink, mkdir
  int descriptor = -1;
  std::string path, other;
  std::int64_t offset = 0, size = 0;  ///< size: of an open its flags
  std::int64_t result = 0;
  int cause = 0;     ///< errno of a failed call
  std::string data;  ///< written bytes
};
std::vector<FileCall> read_calls(const std::string& log);

struct Fault {
  int call = 0;      ///< 0: none
  std::string kind;  ///< kill_before, kill_after, kill_half, short, or a number of errno
  bool sticky = false;
};

/// A folder with the state before a save, and the save with a fault in it.
class Trial {
 public:
  explicit Trial(Save what);
  Trial(const Trial&) = delete;
  Trial& operator=(const Trial&) = delete;

  testing_program::Result save(const Fault& fault = {});
  /// Of the last save; calls behind a kill are missing.
  std::vector<FileCall> calls() const { return read_calls(log_); }
  /// By a fresh process.
  Look look() const;
  const std::string& folder() const { return folder_; }

 private:
  Save what_;
  const TempDir root_;
  const std::string folder_ = root_ / "work", log_ = root_ / "log";
};

/// The environment that preloads the shim and plans `fault` for calls below `folder`.
std::vector<std::string> fault_environment(const std::string& folder, const std::string& log, const Fault& fault);

/// What an undisturbed save goes through and ends in; made once per kind.
struct Undisturbed {
  std::uint32_t old_crc = 0, new_crc = 0;
  std::vector<FileCall> calls;
};
const Undisturbed& undisturbed(Save what);

}  // namespace semfield::testing_crash
