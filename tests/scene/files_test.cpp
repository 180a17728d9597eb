// Whole files, atomically.
#include "system/files.h"

#include <gtest/gtest.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <sys/wait.h>
#include <unistd.h>

#include <csignal>

#include "formats/image_io.h"
#include "loading/packed_scene.h"
#include "tests/says.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using testing_room::error_of;
using testing_room::fresh_folder;
using testing_room::plain_write;

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
            "'" + folder + "' is a folder, not a file; check the path");
  EXPECT_EQ(error_of([&] { write_file_atomic(folder + "/no/a.txt", std::string_view("x")); }),
            "cannot create '" + folder + "/no/a.txt': No such file or directory; create the folder first");
  write_file_atomic(folder + "/big", std::string(101, 'x'));
  EXPECT_EQ(error_of([&] { (void)read_text_file(folder + "/big", 100); }),
            "'" + folder + "/big' is larger than 100 bytes; check that it is the right file");
  fs::create_directories(folder + "/taken/inside");
  EXPECT_EQ(error_of([&] { write_file_atomic(folder + "/taken", std::string_view("x")); }),
            "cannot replace '" + folder + "/taken': Is a directory; choose another name");
  EXPECT_EQ(entries(folder), 2u);
}

// A pipe without a writer, and a device that never ends, would otherwise be waited for.
TEST(Files, OnlyRegularFilesAreRead) {
  const std::string folder = fresh_folder("f"), pipe = folder + "/pipe.png";
  ASSERT_EQ(::mkfifo(pipe.c_str(), 0600), 0);
  const auto why = [](const std::string& path) { return error_of([&] { (void)read_file_start(path, 1); }); };
  EXPECT_EQ(why(pipe), "'" + pipe + "' is a pipe, not a file; check the path");
  EXPECT_EQ(error_of([&] { (void)read_text_file(pipe); }), why(pipe));
  EXPECT_EQ(error_of([&] { (void)image_size(pipe); }), why(pipe));
  EXPECT_EQ(error_of([&] { (void)read_float(pipe); }), why(pipe));
  EXPECT_EQ(error_of([&] { PackedScene scene(pipe); }), why(pipe));
  EXPECT_EQ(why("/dev/zero"), "'/dev/zero' is a device, not a file; check the path");

  const int server = ::socket(AF_UNIX, SOCK_STREAM, 0);
  sockaddr_un address{AF_UNIX, "semfield_test_socket"};
  const fs::path back = fs::current_path();
  fs::current_path(folder);  // a socket's path has room for 107 bytes
  EXPECT_EQ(::bind(server, reinterpret_cast<const sockaddr*>(&address), sizeof address), 0);
  EXPECT_EQ(why(address.sun_path), "'semfield_test_socket' is a socket, not a file; check the path");
  fs::current_path(back);
  ::close(server);
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
  EXPECT_EQ(unsaid(message, {"'" + folder + "/a'", "100000 bytes", "65536", "`ulimit -f`"}), "");
  EXPECT_EQ(read_text_file(folder + "/a"), "old");
  EXPECT_EQ(entries(folder), 1u);
}

// A process that is killed between append and commit leaves its file; one that lives keeps it.
TEST(Files, TemporariesOfTheDeadGoAndThoseOfTheLivingStay) {
  const std::string folder = fresh_folder("f");
  const pid_t child = ::fork();
  if (child == 0) {
    AtomicFile file(folder + "/a.bin");
    file.append(std::vector<std::byte>(10));
    ::raise(SIGKILL);
  }
  ASSERT_EQ(::waitpid(child, nullptr, 0), child);
  EXPECT_EQ(entries(folder), 1u) << "the child left nothing: the test tries nothing";
  plain_write(folder + "/.notes.tmp", "no number, so not ours");
  AtomicFile living(folder + "/b.bin");
  EXPECT_EQ(remove_stale_temporaries(folder), 1);
  EXPECT_EQ(remove_stale_temporaries(folder), 0);
  living.commit();
  EXPECT_TRUE(fs::exists(folder + "/b.bin"));
  EXPECT_TRUE(fs::exists(folder + "/.notes.tmp"));
  EXPECT_EQ(entries(folder), 2u);
  EXPECT_EQ(remove_stale_temporaries(folder + "/none"), 0);
}

TEST(Files, TheNextWriteOfATargetRemovesWhatTheLastOneLeft) {
  const std::string folder = fresh_folder("f");
  plain_write(folder + "/.a.bin.0.tmp", "left by a killed writer");
  write_file_atomic(folder + "/a.bin", std::string_view("new"));
  EXPECT_EQ(entries(folder), 1u);
  // Two writers of one target at a time: each has its own file, the last to commit wins.
  AtomicFile first(folder + "/a.bin"), second(folder + "/a.bin");
  EXPECT_EQ(entries(folder), 3u);
  second.append(std::as_bytes(std::span<const char>("second", 6)));
  second.commit();
  first.append(std::as_bytes(std::span<const char>("first", 5)));
  first.commit();
  EXPECT_EQ(read_text_file(folder + "/a.bin"), "first");
  EXPECT_EQ(entries(folder), 1u);
}

TEST(Files, WhatDoesNotVerifyTakesNoName) {
  const std::string folder = fresh_folder("f");
  write_file_atomic(folder + "/a", std::string_view("old"));
  EXPECT_EQ(error_of([&] {
              AtomicFile file(folder + "/a");
              file.append(std::as_bytes(std::span<const char>("bad", 3)));
              file.commit([](const std::string& written) {
                EXPECT_EQ(read_text_file(written), "bad");
                throw Error(ErrorKind::io, "test.error.made", "it is bad");
              });
            }),
            "it is bad");
  EXPECT_EQ(read_text_file(folder + "/a"), "old");
  EXPECT_EQ(entries(folder), 1u);
}

TEST(Files, FoldersAreMadeWithThoseAbove) {
  const std::string folder = fresh_folder("f");
  create_folders(folder + "/a/b/c/");
  create_folders(folder + "/a/b");
  EXPECT_TRUE(fs::is_directory(folder + "/a/b/c"));
  write_file_atomic(folder + "/file", std::string_view("x"));
  EXPECT_EQ(error_of([&] { create_folders(folder + "/file/under"); }),
            "cannot create the folder '" + folder + "/file/under': Not a directory; choose another name");
}

}  // namespace
}  // namespace semfield
