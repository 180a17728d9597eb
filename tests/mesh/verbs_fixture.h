// The program run with words, and a short run of a small scene that all tests of verbs share.
#pragma once

#include <fcntl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cstdio>
#include <cstdlib>

#include "core/text.h"
#include "loading/packed_scene.h"
#include "system/files.h"
#include "testkit/analytic_scene.h"
#include "tests/session/train_testing.h"

namespace semfield::testing_verbs {

struct Result {
  int code = -1;
  std::string out, err;
};

// `path`: the PATH that it sees; "" leaves it.
inline Result run(const TempDir& dir, std::vector<std::string> words, const std::string& path = "") {
  words.insert(words.begin(), SEMFIELD_BINARY);
  std::vector<char*> argv;
  for (const std::string& word : words) argv.push_back(const_cast<char*>(word.c_str()));
  argv.push_back(nullptr);
  const std::string out = dir / "stdout", err = dir / "stderr";
  const pid_t pid = fork();
  if (pid == 0) {
    dup2(open(out.c_str(), O_WRONLY | O_CREAT | O_TRUNC, 0600), 1);
    dup2(open(err.c_str(), O_WRONLY | O_CREAT | O_TRUNC, 0600), 2);
    if (!path.empty()) setenv("PATH", path.c_str(), 1);
    alarm(120);  // a hang is a failure, not a wait
    execv(argv[0], argv.data());
    _exit(127);
  }
  int status = 0;
  waitpid(pid, &status, 0);
  return {WIFEXITED(status) ? WEXITSTATUS(status) : -1, read_text_file(out), read_text_file(err)};
}

inline std::string answer_of(const std::string& command) {
  std::string text;
  FILE* const pipe = popen(command.c_str(), "r");
  char buffer[256];
  while (std::fgets(buffer, sizeof buffer, pipe) != nullptr) text += buffer;
  pclose(pipe);
  return text;
}

inline bool found(const std::string& program) { return !answer_of("command -v " + program).empty(); }

// One short run for all tests.
class Verbs : public ::testing::Test {
 protected:
  static void SetUpTestSuite() {
    dir_ = new TempDir;
    const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene();
    Diagnostics diagnostics;
    const SceneInfo info = scene->open(diagnostics);
    write_packed_scene(*dir_ / "room.sfpack", info,
                       [&](int frame, FrameBuffer& buffer) { scene->read(frame, buffer); });
    std::string yaml = testing_train::with_scene(testing_train::hash_config("report: {eval_every_s: 0, strips: 0}\n"),
                                                 "{type: packed, file: room.sfpack}");
    write_file_atomic(*dir_ / "config.yaml", yaml);
    const Result trained = run(*dir_, {"train", *dir_ / "config.yaml", "--out", *dir_ / "run"});
    ASSERT_EQ(trained.code, 0) << trained.err;
  }
  static void TearDownTestSuite() {
    delete dir_;
    dir_ = nullptr;
  }
  static std::string run_dir() { return *dir_ / "run"; }
  static inline TempDir* dir_ = nullptr;
};

}  // namespace semfield::testing_verbs
