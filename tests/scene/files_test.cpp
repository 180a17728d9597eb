// Whole files, atomically.
#include "core/files.h"

#include <gtest/gtest.h>
#include <sys/resource.h>

#include <csignal>

#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using testing_room::error_of;
using testing_room::fresh_folder;

std::size_t entries(const std::string& folder) {
  std::size_t count = 0;
  for ([[maybe_unused]] const auto& e : fs::directory_iterator(folder)) ++count;
  return count;
}

TEST(Files, WritesReplacesAndLeavesNothingBehind) {
  const std::string folder = fresh_folder("f");
  const std::string path = folder + "/a.txt";
  write_file_atomic(path, std::string_view("one"));
  write_file_atomic(path, std::string_view("two, longer"));
  EXPECT_EQ(read_text_file(path), "two, longer");
  EXPECT_EQ(read_file_start(path, 3), "two");
  EXPECT_EQ(entries(folder), 1u);
}

TEST(Files, AbandonedFileKeepsTheOldOne) {
  const std::string folder = fresh_folder("f");
  const std::string path = folder + "/a.bin";
  write_file_atomic(path, std::string_view("old"));
  {
    AtomicFile file(path);
    const std::vector<std::byte> bytes(100000);
    file.append(bytes);
    EXPECT_EQ(file.size(), 100000u);
    EXPECT_EQ(read_text_file(path), "old");
    EXPECT_EQ(entries(folder), 2u);
  }
  EXPECT_EQ(read_text_file(path), "old");
  EXPECT_EQ(entries(folder), 1u);
}

TEST(Files, OverwriteChangesBytesInPlace) {
  const std::string path = fresh_folder("f") + "/a.bin";
  AtomicFile file(path);
  file.append(std::as_bytes(std::span<const char>("hello", 5)));
  file.overwrite(1, std::as_bytes(std::span<const char>("a", 1)));
  file.commit();
  EXPECT_EQ(read_text_file(path), "hallo");
}

TEST(Files, ErrorsNamePathCauseAndRemedy) {
  const std::string folder = fresh_folder("f");
  EXPECT_EQ(error_of([&] { (void)read_text_file(folder + "/none"); }),
            "cannot open '" + folder + "/none': No such file or directory; check the path");
  EXPECT_EQ(error_of([&] { (void)read_text_file(folder); }),
            "cannot read '" + folder + "': Is a directory; check the path");
  EXPECT_EQ(error_of([&] { write_file_atomic(folder + "/no/a.txt", std::string_view("x")); }),
            "cannot create '" + folder + "/no/a.txt': No such file or directory; create the folder first");
  write_file_atomic(folder + "/big", std::string(101, 'x'));
  EXPECT_EQ(error_of([&] { (void)read_text_file(folder + "/big", 100); }),
            "'" + folder + "/big' is larger than 100 bytes; check that it is the right file");
  fs::create_directories(folder + "/taken/inside");
  EXPECT_EQ(error_of([&] { write_file_atomic(folder + "/taken", std::string_view("x")); }),
            "cannot replace '" + folder + "/taken': Is a directory");
  EXPECT_EQ(entries(folder), 2u);
}

TEST(Files, FailedWriteKeepsTheOldFileAndCleansUp) {
  const std::string folder = fresh_folder("f");
  write_file_atomic(folder + "/a", std::string_view("old"));
  // The file size limit of the process makes the second half of the write fail, as a full disk would.
  rlimit before{};
  ASSERT_EQ(::getrlimit(RLIMIT_FSIZE, &before), 0);
  const rlimit small{65536, before.rlim_max};
  const auto old_handler = std::signal(SIGXFSZ, SIG_IGN);
  ASSERT_EQ(::setrlimit(RLIMIT_FSIZE, &small), 0);
  const std::string message = error_of([&] { write_file_atomic(folder + "/a", std::string(100000, 'x')); });
  ASSERT_EQ(::setrlimit(RLIMIT_FSIZE, &before), 0);
  std::signal(SIGXFSZ, old_handler);
  EXPECT_EQ(message, "cannot write '" + folder + "/a': File too large");
  EXPECT_EQ(read_text_file(folder + "/a"), "old");
  EXPECT_EQ(entries(folder), 1u);
}

}  // namespace
}  // namespace semfield
