// Manual pages: one a verb, and nothing that their readers complain about.
#include <gtest/gtest.h>

#include <cstdlib>
#include <filesystem>

#include "tests/program.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using testing_program::Result;
using testing_program::semfield_run;
using testing_train::TempDir;

bool installed(const char* program) {
  return std::system(("command -v " + std::string(program) + " >/dev/null").c_str()) == 0;
}

TEST(Man, PageOfAVerbHasItsWords) {
  const TempDir dir;
  const Result page = semfield_run("help --man render", dir.path(), "SOURCE_DATE_EPOCH=86400 ");
  ASSERT_EQ(page.code, 0) << page.err;
  EXPECT_EQ(page.out.find(".TH SEMFIELD\\-RENDER 1 \"1970-01-02\" \"Semfield "), 0u) << page.out;
  for (const char* part :
       {".SH NAME\nsemfield\\-render \\-\nrender colour", ".SH SYNOPSIS\n.B semfield render\nRUN [OPTIONS]\n",
        ".SH OPERANDS\n.TP\n.I RUN\n", ".BI \\-\\-frames \" N\"\n", "(1 to 100000; default: 240)",
        ".SH SEE ALSO\n.BR semfield (1)\n"})
    EXPECT_NE(page.out.find(part), std::string::npos) << part << " in\n" << page.out;
  const Result whole = semfield_run("help --man", dir.path());
  EXPECT_NE(whole.out.find(".TP\n.BR semfield\\-render (1)\n"), std::string::npos) << whole.out;
  EXPECT_NE(whole.out.find(".SH EXIT STATUS\n.TP\n.B 0\ndone\n"), std::string::npos) << whole.out;
  EXPECT_EQ(semfield_run("help --man rendr", dir.path()).err,
            "semfield: there is no verb 'rendr'; did you mean `semfield render`? [usage.verb.unknown]\n");
  EXPECT_EQ(semfield_run("help --man render --out all", dir.path()).code, 2);
}

class ManPages : public ::testing::Test {
 protected:
  void SetUp() override {
    const Result r = semfield_run("help --man --out all", dir_.path());
    ASSERT_EQ(r.code, 0) << r.err;
    for (const auto& entry : fs::directory_iterator(dir_ / "all")) pages_.push_back(entry.path().string());
    EXPECT_GE(pages_.size(), 25u);
    EXPECT_TRUE(fs::exists(dir_ / "all/semfield.1"));
    EXPECT_TRUE(fs::exists(dir_ / "all/semfield-config-check.1"));
  }
  // What the command prints of any page; nothing is expected.
  void expect_silence(const std::string& command) {
    for (const std::string& page : pages_) {
      const std::string out = dir_ / "out";
      EXPECT_EQ(std::system((command + " " + shell_word(page) + " >" + shell_word(out) + " 2>&1").c_str()), 0) << page;
      EXPECT_EQ(read_text_file(out), "") << page;
    }
  }
  TempDir dir_;
  std::vector<std::string> pages_;
};

TEST_F(ManPages, ManHasNoWarnings) {
  if (!installed("man")) GTEST_SKIP() << "man is not installed: no page was formatted by it";
  for (const std::string& page : pages_) {
    const std::string out = dir_ / "out", err = dir_ / "err";
    const int status = std::system(
        ("man -l --warnings " + shell_word(page) + " >" + shell_word(out) + " 2>" + shell_word(err)).c_str());
    EXPECT_EQ(status, 0) << page;
    EXPECT_EQ(read_text_file(err), "") << page;
    EXPECT_GT(read_text_file(out).size(), 200u) << page;
  }
}

TEST_F(ManPages, MandocHasNothingToSay) {
  if (!installed("mandoc")) GTEST_SKIP() << "mandoc is not installed: no page was checked by it";
  expect_silence("mandoc -T lint");
}

}  // namespace
}  // namespace semfield
