// The program as tests of verbs run it: its exit code and what it said.
#pragma once

#include <fcntl.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <chrono>
#include <cstdlib>
#include <optional>
#include <stdexcept>
#include <thread>

#include "core/non_copyable.h"
#include "core/text.h"
#include "system/files.h"
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

/// program() with `words`, shell text in which a path is a shell_word, in `folder`, where its output is kept too;
/// `before` is shell text in front of it.
inline Result semfield_run(const std::string& words, const std::string& folder, const std::string& before = "") {
  const std::string command = "cd " + shell_word(folder) + " && " + before + shell_word(program()) + " " + words +
                              " >stdout 2>stderr </dev/null";
  const int status = std::system(command.c_str());  // NOLINT(cert-env33-c): words of a test
  return {WIFEXITED(status) ? WEXITSTATUS(status) : -1, read_text_file(folder + "/stdout"),
          read_text_file(folder + "/stderr")};
}

/// Of a program that has to end in 0; the test ends otherwise.
inline Result succeeded(Result result) {
  if (result.code != 0) throw std::runtime_error("it ended in " + std::to_string(result.code) + ": " + result.err);
  return result;
}

/// Tests of the program in a folder of their own.
struct ProgramInAFolder : ::testing::Test {
  const TempDir dir;
  Result semfield(const std::string& words, const std::string& before = "") const {
    return semfield_run(words, dir.path(), before);
  }
};

/// "" when it ended with that exit code, and its standard error is as unsaid() of `said` has it.
template <class... Said>
std::string unended(const Result& result, int exit_code, const Said&... said) {
  if (result.code != exit_code) return "exit code " + std::to_string(result.code) + ": " + result.err + result.out;
  return unsaid(result.err, said...);
}
using Parts = std::initializer_list<std::string_view>;

struct Limit {
  __rlimit_resource_t kind = RLIMIT_NOFILE;
  rlim_t most = 0;
};

/// A program that runs beside the test; its output goes to `folder`/stdout and `folder`/stderr. Killed when it is left.
/// `limit` of the kind RLIMIT_NOFILE, when given, holds for it alone.
class Process : NonCopyable {
 public:
  Process(const std::string& program, const std::vector<std::string>& words, const std::string& folder,
          const std::vector<std::string>& environment = {}, const std::optional<Limit>& limit = {})
      : out_(folder + "/stdout"), err_(folder + "/stderr") {
    std::vector<char*> argv{const_cast<char*>(program.c_str())};
    for (const std::string& word : words) argv.push_back(const_cast<char*>(word.c_str()));
    argv.push_back(nullptr);
    const int out = open(out_.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
    const int err = open(err_.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
    pid_ = fork();
    if (pid_ == 0) {
      dup2(out, 1);
      dup2(err, 2);
      for (const std::string& setting : environment) putenv(const_cast<char*>(setting.c_str()));
      if (limit) {
        const rlimit both{limit->most, limit->most};
        setrlimit(limit->kind, &both);
      }
      execv(program.c_str(), argv.data());
      _exit(127);
    }
    close(out);
    close(err);
  }
  ~Process() {
    if (pid_ <= 0) return;
    kill(pid_, SIGKILL);
    waitpid(pid_, nullptr, 0);
  }

  int pid() const { return pid_; }
  void send(int signal) const { kill(pid_, signal); }
  Result wait() {
    int status = 0;
    waitpid(pid_, &status, 0);
    return result(status);
  }
  /// None when it still runs after so long.
  std::optional<Result> wait_for(double seconds) {
    const auto end = std::chrono::steady_clock::now() + std::chrono::duration<double>(seconds);
    int status = 0;
    while (waitpid(pid_, &status, WNOHANG) == 0) {
      if (std::chrono::steady_clock::now() >= end) return std::nullopt;
      std::this_thread::sleep_for(std::chrono::milliseconds(5));
    }
    return result(status);
  }
  std::string err_so_far() const { return read_text_file(err_); }

 private:
  Result result(int status) {
    pid_ = -1;
    Result r;
    if (WIFEXITED(status)) r.code = WEXITSTATUS(status);
    if (WIFSIGNALED(status)) r.signal = WTERMSIG(status);
    r.out = read_text_file(out_);
    r.err = read_text_file(err_);
    return r;
  }
  std::string out_, err_;
  pid_t pid_ = -1;
};

}  // namespace semfield::testing_program

/// EXPECT_ENDED(run(words), 73, "'runs/demo' is there already"): a program's exit code, and what its standard error
/// holds.
#define EXPECT_ENDED(result, exit_code, ...)                                                                          \
  EXPECT_EQ(::semfield::testing_program::unended(result, exit_code, ::semfield::testing_program::Parts{__VA_ARGS__}), \
            "")
/// EXPECT_REFUSED(prepare(), 65, "capture.poses.none", "4 attempts"): the same, and the code of the line.
#define EXPECT_REFUSED(result, exit_code, code, ...)                                               \
  EXPECT_EQ(::semfield::testing_program::unended(result, exit_code, ::semfield::Code(code),        \
                                                 ::semfield::testing_program::Parts{__VA_ARGS__}), \
            "")
