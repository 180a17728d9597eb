// The program as tests of verbs run it: its exit code and what it said.
#pragma once

#include <sys/wait.h>

#include <cstdlib>
#include <string>

#include "core/files.h"

namespace semfield::testing_program {

struct Result {
  int code = -1;  ///< -1: ended by a signal
  std::string out, err;
};

/// SEMFIELD_BINARY (a definition of the test's target) with `words`, in `folder`, where its output is kept too;
/// `before` is shell text in front of it.
inline Result semfield_run(const std::string& words, const std::string& folder, const std::string& before = "") {
  const std::string command = "cd '" + folder + "' && " + before + "'" + SEMFIELD_BINARY + "' " + words + " >'" +
                              folder + "/stdout' 2>'" + folder + "/stderr' </dev/null";
  const int status = std::system(command.c_str());  // NOLINT(cert-env33-c): words of a test
  return {WIFEXITED(status) ? WEXITSTATUS(status) : -1, read_text_file(folder + "/stdout"),
          read_text_file(folder + "/stderr")};
}

}  // namespace semfield::testing_program
