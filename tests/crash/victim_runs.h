// Runs the victim with a fault planned, and reads back the record of its file calls.
#pragma once

#include <fstream>
#include <map>
#include <sstream>

#include "core/non_copyable.h"
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

inline std::vector<FileCall> read_calls(const std::string& log) {
  std::vector<FileCall> calls;
  if (!fs::exists(log)) return calls;
  std::ifstream lines(log);
  const std::string data = read_text_file(log + ".data");
  std::size_t taken = 0;
  for (std::string line; std::getline(lines, line);) {
    std::vector<std::string> fields;
    std::istringstream split(line);
    for (std::string field; std::getline(split, field, '\t');) fields.push_back(field);
    if (fields.size() != 9)
      throw Error(ErrorKind::internal, "test.error.made", "a line of the log is not whole: " + line);
    FileCall c{std::stoi(fields[0]),
               fields[1],
               std::stoi(fields[2]),
               fields[3],
               fields[4],
               std::stoll(fields[5]),
               std::stoll(fields[6]),
               std::stoll(fields[7]),
               std::stoi(fields[8]),
               {}};
    if (c.name == "write" && c.result > 0) {
      c.data = data.substr(taken, static_cast<std::size_t>(c.result));
      taken += c.data.size();
    }
    calls.push_back(std::move(c));
  }
  return calls;
}

struct Fault {
  int call = 0;      ///< 0: none
  std::string kind;  ///< kill_before, kill_after, kill_half, short, or a number of errno
  bool sticky = false;
};

using namespace testing_program;

/// Words for `env` that preload the shim and plan `fault` for calls below `folder`.
inline std::string fault_environment(const std::string& folder, const std::string& log, const Fault& fault) {
  const fs::path shim = SEMFIELD_FAULT_SHIM;
  std::string words;
  for (const std::string& word : {"LD_PRELOAD=" + shim.filename().string(),  // in a path a space would end it
                                  "LD_LIBRARY_PATH=" + shim.parent_path().string(),
                                  std::string("ASAN_OPTIONS=verify_asan_link_order=0"), "SEMFIELD_FAULT_BELOW=" + folder,
                                  "SEMFIELD_FAULT_LOG=" + log, "SEMFIELD_FAULT_CALL=" + std::to_string(fault.call),
                                  "SEMFIELD_FAULT=" + fault.kind,
                                  std::string("SEMFIELD_FAULT_STICKY=") + (fault.sticky ? "1" : "0")})
    words += shell_word(word) + " ";
  return words;
}

/// A folder with the state before a save, and the save with a fault in it.
class Trial : NonCopyable {
 public:
  explicit Trial(Save what) : what_(what) {
    fs::create_directories(folder_);
    prepare(what, folder_);
  }

  Result save(const Fault& fault = {}) {
    fs::remove(log_);
    fs::remove(log_ + ".data");
    return victim("save", fault_environment(folder_, log_, fault));
  }
  /// Of the last save; calls behind a kill are missing.
  std::vector<FileCall> calls() const { return read_calls(log_); }
  /// By a fresh process.
  Look look() const {
    const Result r = victim("look", "");
    std::istringstream words(r.out);
    Look found;
    words >> std::hex >> found.crc >> std::dec >> found.temporaries;
    std::getline(words >> std::ws, found.bad);
    if (r.code != 0 || r.out.empty())
      found.bad += "the process that looked ended with " + std::to_string(r.code) + r.err;
    return found;
  }
  const std::string& folder() const { return folder_; }

 private:
  Result victim(const std::string& word, const std::string& settings) const {
    return shell_run("exec env " + settings + shell_word(SEMFIELD_VICTIM) + " " + word + " " + name_of(what_) + " " +
                         shell_word(folder_),
                     root_.path());
  }
  Save what_;
  const TempDir root_;
  const std::string folder_ = root_ / "work", log_ = root_ / "log";
};

/// What an undisturbed save goes through and ends in; made once per kind.
struct Undisturbed {
  std::uint32_t old_crc = 0, new_crc = 0;
  std::vector<FileCall> calls;
};
inline const Undisturbed& undisturbed(Save what) {
  static std::map<Save, Undisturbed> made;
  const auto present = made.find(what);
  if (present != made.end()) return present->second;
  Undisturbed& u = made[what];
  u.old_crc = Trial(what).look().crc;
  Trial trial(what);
  const Result r = trial.save();
  EXPECT_EQ(r.code, 0) << r.err;
  u.calls = trial.calls();
  const Look after = trial.look();
  u.new_crc = after.crc;
  EXPECT_EQ(after.bad, "");
  EXPECT_NE(u.new_crc, u.old_crc);
  EXPECT_GE(u.calls.size(), 8u) << "the shim saw no save: is it preloaded?";
  return u;
}

}  // namespace semfield::testing_crash
