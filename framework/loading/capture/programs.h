// Programs of others that capture starts: ffmpeg, ffprobe and colmap.
#pragma once

#include <functional>
#include <string>
#include <vector>

#include "core/error.h"

namespace semfield {

/// What is counted while a step goes on: "matching 200/595 pairs".
struct CaptureStep {
  const char* doing;
  const char* unit;
};
/// How far a step is. It may throw to stop the work.
using CaptureProgress = std::function<void(const CaptureStep& step, double done, double total)>;

/// What starts programs; a test replaces it.
struct Programs {
  /// File of the program of that name; "" where there is none.
  std::function<std::string(const std::string& name)> find;
  /// Runs words[0] with the rest as its arguments, no shell between, and waits for its end; what it prints goes into
  /// `log`, anew. `tick` is called now and then. Returns the exit code, or 128 and the number of a signal. Throws
  /// where no process can be had, and whatever stops the work, when the program has ended.
  std::function<int(const std::vector<std::string>& words, const std::string& log, const std::function<void()>& tick)>
      run;
};

/// The program's file. Throws Error(unavailable) with the command that installs it.
std::string program_file(const Programs& programs, const std::string& name);

struct ProgramRun {
  std::vector<std::string> words;  ///< without the program
  std::string log;                 ///< file
  std::function<void()> tick = [] {};
  std::string remedy = "the log says more; COLMAP 3.8 is known to take these words";  ///< for one that fails
};
/// Runs the program `name`. Throws Error(failure) that quotes the last lines of its log where it does not end with 0,
/// and Error(io) where the disk is full, which some programs do not say by their end.
void run_program(const Programs& programs, const std::string& name, const ProgramRun& run);

/// The last lines of a log that say something, at most `most` of them, joined by " | ".
std::string last_lines(const std::string& log, std::size_t most);
/// All of a log; "" while there is none.
std::string log_text(const std::string& log);

}  // namespace semfield
