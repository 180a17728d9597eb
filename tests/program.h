// The program as tests of verbs run it: its exit code and what it said.
#pragma once

#include <gtest/gtest.h>
#include <sys/wait.h>

#include <cstdlib>
#include <stdexcept>

#include "core/files.h"
#include "core/text.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield::testing_program {

struct Result {
  int code = -1;  ///< -1: ended by a signal
  std::string out, err;
  int signal = 0;  ///< that ended it
};

/// The program under test: SEMFIELD_BINARY, a definition of the test's target, or what the environment variable
/// SEMFIELD_PROGRAM names (a copy, for long runs beside rebuilds).
inline std::string program() {
  const char* other = std::getenv("SEMFIELD_PROGRAM");
  return other != nullptr ? other : SEMFIELD_BINARY;
}

/// Shell text in `folder`, where its output is kept too.
inline Result shell_run(const std::string& text, const std::string& folder) {
  const std::string command = "cd " + shell_word(folder) + " && " + text + " >stdout 2>stderr </dev/null";
  const int status = std::system(command.c_str());  // NOLINT(cert-env33-c): words of a test
  return {WIFEXITED(status) ? WEXITSTATUS(status) : -1, read_text_file(folder + "/stdout"),
          read_text_file(folder + "/stderr"), WIFSIGNALED(status) ? WTERMSIG(status) : 0};
}

/// program() with `words`, shell text in which a path is a shell_word; `before` is shell text in front of it.
inline Result semfield_run(const std::string& words, const std::string& folder, const std::string& before = "") {
  return shell_run(before + shell_word(program()) + " " + words, folder);
}

/// Of a program that has to end in 0; the test ends otherwise.
inline Result succeeded(Result result) {
  if (result.code != 0) throw std::runtime_error("it ended in " + std::to_string(result.code) + ": " + result.err);
  return result;
}

}  // namespace semfield::testing_program
