// scripts/setup with a stand-in for CMake: one line of progress, the rest in a log.
#include <pty.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <filesystem>
#include <fstream>

#include "system/files.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;

class SetupScript : public testing::Test {
 protected:
  SetupScript() {
    fs::create_directories(root_ / "scripts");
    fs::create_directories(root_ / "bin");
    for (const char* name : {"setup", "help.sh"})
      fs::copy_file(fs::path(SEMFIELD_SOURCE_DIR) / "scripts" / name, root_ / "scripts" / name);
    stand_in("dpkg-query", "[ \"${!#}\" = \"$MISSING\" ] || echo 'install ok installed'");
    stand_in("nproc", "echo 2");
    stand_in("apt-get", "[ $1 = update ]");
    stand_in("cmake", R"(
      case $1 in
        --version) echo 'cmake version 3.0.0';;
        --preset) [ "$FAILS" != configure ] || { echo 'CMake Error: no presets'; exit 1; };;
        --build)
          for ((i = 1; i <= 200; ++i)); do
            echo "[$i/200] Building object_$i.o"
            [ $i != 7 ] || printf 'a.cpp:1: warning: odd\nmore of it\n'
            if [ $i = 150 ] && [ "$FAILS" = build ]; then
              printf 'FAILED: object_150.o\nc++ the whole command\nb.cpp:2: error: wrong\n    the line\n'
              echo '[151/200] Building object_151.o'
              echo 'ninja: build stopped'
              exit 1
            fi
          done;;
      esac)");
  }

  std::string command(const std::string& fails) const {
    return "cd " + shell_word(root_.string()) + " && FAILS=" + fails + " PATH=" + shell_word((root_ / "bin").string()) +
           ":\"$PATH\" scripts/setup";
  }
  /// What it prints into a file; `code_` is its exit code.
  std::string printed(const std::string& fails) {
    const std::string out = (root_ / "out").string();
    code_ = WEXITSTATUS(std::system((command(fails) + " >" + shell_word(out) + " 2>&1").c_str()));
    return read_text_file(out);
  }
  std::string log() const { return read_text_file((root_ / "build/setup.log").string()); }

  const TempDir dir_;
  const fs::path root_ = dir_.path();
  int code_ = -1;

 private:
  void stand_in(const std::string& name, const std::string& text) const {
    const fs::path file = root_ / "bin" / name;
    std::ofstream(file) << "#!/usr/bin/env bash\n" << text << '\n';
    fs::permissions(file, fs::perms::owner_all);
  }
};

TEST_F(SetupScript, SaysEveryTenthAndKeepsTheRestInALog) {
  const std::string out = printed("never");
  EXPECT_EQ(code_, 0);
  EXPECT_EQ(std::count(out.begin(), out.end(), '\n'), 13) << out;
  EXPECT_HAS(out, "about 5 min", " 1 of 200\n", " 20 of 200\n", " 200 of 200\n", "warnings: 1; log: build/setup.log\n");
  EXPECT_HAS(log(), "[200/200] Building object_200.o", "a.cpp:1: warning: odd\nmore of it");
}

TEST_F(SetupScript, RewritesOneLineOnATerminal) {
  int terminal = -1;
  const pid_t child = forkpty(&terminal, nullptr, nullptr, nullptr);
  if (child == 0) {
    execl("/bin/sh", "sh", "-c", command("never").c_str(), nullptr);
    _exit(127);
  }
  ASSERT_GT(child, 0);
  std::string out;
  char buffer[4096];
  for (ssize_t got = 0; (got = read(terminal, buffer, sizeof buffer)) > 0;)
    out.append(buffer, static_cast<std::size_t>(got));
  int status = -1;
  waitpid(child, &status, 0);
  close(terminal);
  EXPECT_EQ(status, 0);
  EXPECT_EQ(std::count(out.begin(), out.end(), '\n'), 2) << out;
  EXPECT_HAS(out, " 199 of 200 \r", " 200 of 200 \r");
}

TEST_F(SetupScript, ShowsTheLinesThatFailedAndNamesTheLog) {
  const std::string out = printed("build");
  EXPECT_EQ(code_, 1);
  EXPECT_HAS(out, "FAILED: object_150.o\nb.cpp:2: error: wrong\n    the line\n");
  EXPECT_LACKS(out, "the whole command");
  EXPECT_HAS(out, (root_ / "build/setup.log").string() + "\n");
}

TEST_F(SetupScript, ShowsWhyItCouldNotConfigure) {
  const std::string out = printed("configure");
  EXPECT_EQ(code_, 1);
  EXPECT_HAS(out, "CMake Error: no presets\n", "3.0.0");
}

TEST_F(SetupScript, DoesWithoutWhatIsOnlyWishedFor) {
  setenv("SEMFIELD_WISHED_PACKAGES", "here nowhere", 1);
  setenv("MISSING", "nowhere", 1);
  const std::string out = printed("never");
  EXPECT_EQ(code_, 0);
  EXPECT_HAS(out, "setup: nowhere ");
  EXPECT_LACKS(out, "setup: here");
  setenv("MISSING", "cmake", 1);  // needed, and the stand-in installs nothing
  (void)printed("never");
  EXPECT_EQ(code_, 69);
  unsetenv("SEMFIELD_WISHED_PACKAGES");
  unsetenv("MISSING");
}

}  // namespace
}  // namespace semfield
