// A run's files say what was trained, and the program says what does not go with them.
#include <gtest/gtest.h>

#include <filesystem>

#include "core/files.h"
#include "tests/program.h"
#include "tests/train/train_testing.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using namespace testing_train;
using testing_program::Result;
using testing_program::semfield_run;

TEST(RunTruth, AFolderThatIsNoUtf8IsRefusedBeforeTraining) {
  const TempDir dir;
  const std::string folder = dir / "caf\xe9";
  fs::create_directory(folder);
  write_packed_config(dir, 5, 0);
  fs::copy(dir.path(), folder, fs::copy_options::none);  // files alone
  const Result r = semfield_run("train config.yaml --out run", folder);
  EXPECT_EQ(r.code, 78) << r.err;
  EXPECT_NE(r.err.find("it is no UTF-8; nothing was written; give the folder or file another name"), std::string::npos)
      << r.err;
  EXPECT_NE(r.err.find("caf\\xe9"), std::string::npos) << r.err;
  EXPECT_FALSE(fs::exists(folder + "/run"));
  // Where only the run folder's name is none, the run's files hold no part of it.
  const Result named = semfield_run("train config.yaml --threads 1 --out caf\xe9/run", dir.path());
  EXPECT_EQ(named.code, 0) << named.err;
  const Result json = semfield_run("--json eval caf\xe9/run", dir.path());
  EXPECT_EQ(json.code, 0) << json.err;
}

}  // namespace
}  // namespace semfield
