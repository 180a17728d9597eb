// Holds on a folder, alone and shared. Two locks of one process exclude each other as those of two processes do.
#include "system/folder_lock.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <cerrno>
#include <filesystem>
#include <string>

namespace semfield {
namespace {

namespace fs = std::filesystem;

class FolderLocks : public testing::Test {
 protected:
  void SetUp() override {
    folder_ = (fs::temp_directory_path() / ("semfield_locks_" + std::to_string(::getpid()))).string();
    fs::create_directories(folder_);
  }
  void TearDown() override { fs::remove_all(folder_); }
  std::string folder_;
};

TEST_F(FolderLocks, OneHasItAloneAndIsNamed) {
  FolderLock mine, theirs;
  ASSERT_EQ(mine.take(folder_), 0);
  EXPECT_TRUE(mine.held());
  EXPECT_EQ(theirs.take(folder_), EWOULDBLOCK);
  EXPECT_FALSE(theirs.held());
  EXPECT_NE(theirs.holder().find("process " + std::to_string(::getpid())), std::string::npos) << theirs.holder();
  EXPECT_EQ(theirs.share(folder_), EWOULDBLOCK);
  mine = {};
  EXPECT_EQ(theirs.take(folder_), 0);
}

TEST_F(FolderLocks, SeveralShareItAndThenNobodyHasItAlone) {
  FolderLock first, second, alone;
  ASSERT_EQ(first.share(folder_), 0);
  ASSERT_EQ(second.share(folder_), 0);
  EXPECT_EQ(alone.take(folder_), EWOULDBLOCK);
  first = {};
  EXPECT_EQ(alone.take(folder_), EWOULDBLOCK);
  second = {};
  EXPECT_EQ(alone.take(folder_), 0);
}

TEST_F(FolderLocks, OfAFolderThatIsNotThereTheCauseIsTold) {
  FolderLock lock;
  EXPECT_EQ(lock.take(folder_, false), ENOENT);
  EXPECT_EQ(lock.take(folder_ + "/none"), ENOENT);
  EXPECT_EQ(lock.share(folder_ + "/none"), ENOENT);
  EXPECT_FALSE(lock.held());
}

}  // namespace
}  // namespace semfield
