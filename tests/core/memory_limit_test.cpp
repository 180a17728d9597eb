// Memory that is left, from texts as Linux writes them.
#include "system/memory_limit.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <vector>

namespace semfield {
namespace {

namespace fs = std::filesystem;

constexpr std::size_t kMB = std::size_t{1} << 20;

class MemoryLimit : public testing::Test {
 protected:
  void SetUp() override {
    root_ = testing::TempDir() + "memory_limit_" + std::to_string(::getpid());  // tests run beside each other
    fs::remove_all(root_);
  }
  void TearDown() override { fs::remove_all(root_); }
  void file(const std::string& path, const std::string& text) {
    fs::create_directories(fs::path(root_ + path).parent_path());
    std::ofstream(root_ + path) << text;
  }
  std::string root_;
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
  // Linux counts pages a processor at a time, and is off by up to a batch of them for each (lib/percpu_counter.c).
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
