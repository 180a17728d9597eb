#include "loading/capture/programs.h"

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <filesystem>

#include "core/text.h"
#include "system/files.h"

namespace semfield {

namespace fs = std::filesystem;

std::string program_file(const Programs& programs, const std::string& name) {
  std::string file = programs.find(name);
  if (!file.empty()) return file;
  const std::string package = name == "colmap" ? "colmap" : "ffmpeg";
  throw Error(ErrorKind::unavailable, "capture.program.missing", "the program " + name + " is not in PATH",
              "install it: sudo apt install " + package);
}

std::string log_text(const std::string& log) {
  try {
    return read_text_file(log);
  } catch (const Error&) {
    return "";
  }
}

std::string last_lines(const std::string& log, std::size_t most) {
  const std::string text = log_text(log);
  std::vector<std::string> lines;
  std::string_view rest = text;
  for (std::string_view line; next_line(rest, line);) {
    const std::size_t first = line.find_first_not_of(" \t=");
    if (first != std::string_view::npos && is_line_of_text(line)) lines.emplace_back(line.substr(first));
  }
  if (lines.size() > most) lines.erase(lines.begin(), lines.end() - static_cast<std::ptrdiff_t>(most));
  return join(lines, " | ");
}

namespace {

// Where the disk is what a program failed for, it refuses us too, and then its words are ours.
void require_disk(const fs::path& folder) {
  AtomicFile file((folder / "room").string());
  file.append(std::vector<std::byte>(std::size_t{1} << 20));
}

}  // namespace

void run_program(const Programs& programs, const std::string& name, const ProgramRun& run) {
  std::vector<std::string> words{program_file(programs, name)};
  words.insert(words.end(), run.words.begin(), run.words.end());
  const int code = programs.run(words, run.log, run.tick);
  require_disk(fs::path(run.log).parent_path());
  if (code == 0) return;
  const std::string said = last_lines(run.log, 3);
  const std::string what = name == "colmap" && !run.words.empty() ? name + " " + run.words[0] : name;
  if (log_text(run.log).find(std::strerror(ENOSPC)) != std::string::npos)
    throw Error(ErrorKind::io, "files.write.failed",
                what + " found the disk full: " + said + "; its log is '" + run.log + "'",
                "free some space; the same command continues");
  throw Error(ErrorKind::failure, "capture.program.failed",
              what + " failed (" +
                  (code > 128 ? "signal " + std::to_string(code - 128) : "exit code " + std::to_string(code)) + ")" +
                  (said.empty() ? "" : ": " + said) + "; its log is '" + run.log + "'",
              run.remedy);
}

}  // namespace semfield
