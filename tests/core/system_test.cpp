// Folders and memory of the machine: locks, the order of names, limits.
#include <unistd.h>

#include <algorithm>
#include <cerrno>

#include "core/error.h"
#include "system/files.h"
#include "system/process.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

// Holds on a folder, alone and shared. Two locks of one process exclude each other as those of two processes do.

class FolderLocks : public testing::Test {
 protected:
  const TempDir dir_;
  const std::string& folder_ = dir_.path();
};

TEST_F(FolderLocks, OneHasItAloneAndIsNamed) {
  FolderLock mine, theirs;
  ASSERT_EQ(mine.take(folder_), 0);
  EXPECT_TRUE(mine.held());
  EXPECT_EQ(theirs.take(folder_), EWOULDBLOCK);
  EXPECT_FALSE(theirs.held());
  EXPECT_HAS(theirs.holder(), "process " + std::to_string(::getpid()));
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

// Folders are read in the order of names on every file system.

TEST(SortedFolder, NamesInOrderWhateverTheFileSystemGives) {
  const TempDir folder;
  std::vector<std::string> names;
  for (int i = 0; i < 100; ++i) names.push_back(std::to_string(37 * i % 100));
  for (const std::string& name : names) folder.write(name, "x");
  std::sort(names.begin(), names.end());
  std::vector<std::string> found;
  for (const auto& entry : sorted_folder(folder.path())) found.push_back(entry.path().filename().string());
  EXPECT_EQ(found, names);
}

TEST(SortedFolder, AFolderThatCannotBeReadIsNamed) {
  EXPECT_EQ(error_of(ErrorKind::no_input, [] { (void)sorted_folder("/no/such/folder"); }),
            "cannot read the folder '/no/such/folder': No such file or directory; check the path");
}

// Memory that is left, from texts as Linux writes them.

constexpr std::size_t kMB = std::size_t{1} << 20;

class MemoryLimit : public testing::Test {
 protected:
  void file(const std::string& path, const std::string& text) { dir_.write(path, text); }
  const TempDir dir_;
  const std::string& root_ = dir_.path();
  const std::string meminfo_ = "MemTotal:  8192000 kB\nMemFree: 100 kB\nMemAvailable:    4096000 kB\n";
};

TEST_F(MemoryLimit, SystemAlone) {
  EXPECT_EQ(available_memory(meminfo_, "", root_), 4096000u * 1024);
  EXPECT_EQ(available_memory("", "", root_), kNoMemoryLimit);
}

TEST_F(MemoryLimit, GroupsAboveCountToo) {
  file("/a/b/memory.max", "max\n");
  file("/a/b/memory.current", "1000\n");
  file("/a/memory.max", std::to_string(512 * kMB));
  file("/a/memory.current", std::to_string(200 * kMB));
  file("/a/memory.stat", "anon 5\ninactive_file " + std::to_string(50 * kMB) + "\n");
  EXPECT_EQ(available_memory(meminfo_, "0::/a/b\n", root_), 362 * kMB);
  EXPECT_EQ(available_memory(meminfo_, "0::/other\n", root_), 4096000u * 1024);
}

TEST_F(MemoryLimit, VersionOneAndAFullGroup) {
  file("/memory/box/memory.limit_in_bytes", std::to_string(100 * kMB));
  file("/memory/box/memory.usage_in_bytes", std::to_string(130 * kMB));
  EXPECT_EQ(available_memory(meminfo_, "7:cpu,memory:/box\n", root_), 0u);
  EXPECT_EQ(available_memory(meminfo_, "7:cpu:/box\n", root_), 4096000u * 1024);
}

TEST_F(MemoryLimit, ThisProcess) {
  const std::size_t before = resident_bytes();
  EXPECT_GT(before, 0u);
  std::vector<char> block(64 * kMB, 1);
  EXPECT_GT(resident_bytes(), before + 60 * kMB);
  // Linux counts pages one CPU at a time, and is off by up to a batch of them for each (lib/percpu_counter.c).
  const std::size_t cores = std::thread::hardware_concurrency();
  const std::size_t counting = cores * std::max<std::size_t>(32, 2 * cores) * 4096;
  EXPECT_GE(peak_resident_bytes() + std::max(kMB, counting), resident_bytes());
  EXPECT_EQ(block.back(), 1);
}

TEST_F(MemoryLimit, Words) {
  EXPECT_EQ(memory_text(812 * kMB), "812 MB");
  EXPECT_EQ(memory_text(6 * 1024 * kMB), "6.0 GB");
}

}  // namespace
}  // namespace semfield
