// Whole files, atomically; frames as they are kept in memory; which frames are held out.
#include "system/files.h"

#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <sys/wait.h>

#include <csignal>
#include <cstring>

#include "compute/parallel.h"
#include "formats/image_io.h"
#include "loading/frame_files.h"
#include "loading/frame_source.h"
#include "loading/packed_scene.h"
#include "scene/scene.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using namespace testing_room;

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
  EXPECT_HAS(message, "'" + folder + "/a'", "100000 bytes", "65536", "`ulimit -f`");
  EXPECT_EQ(read_text_file(folder + "/a"), "old");
  EXPECT_EQ(entries(folder), 1u);
}

// A process that is killed between append and commit leaves its file; one that lives keeps it.
TEST(Files, TemporariesOfTheDeadGoAndThoseOfTheLivingStay) {
  const std::string folder = fresh_folder("f");
  AtomicFile living(folder + "/b.bin");
  const pid_t child = ::fork();
  if (child == 0) {
    AtomicFile file(folder + "/a.bin");
    file.append(std::vector<std::byte>(10));
    ::raise(SIGKILL);
  }
  ASSERT_EQ(::waitpid(child, nullptr, 0), child);
  EXPECT_EQ(entries(folder), 2u) << "the child left nothing: the test tries nothing";
  plain_write(folder + "/.notes.tmp", "no number, so not ours");
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

// Names of that form are not this program's alone, and what lies in the folder of a user is not known.
TEST(Files, AWriteRemovesNothingOfOtherTargets) {
  const std::string folder = fresh_folder("others");
  for (const char* name : {"/.mesh.ply.0.tmp", "/.syncthing.frame.0001.tmp"}) plain_write(folder + name, "not ours");
  write_file_atomic(folder + "/mesh.glb", std::string_view("new"));
  EXPECT_EQ(entries(folder), 3u);
  EXPECT_EQ(remove_stale_temporaries(folder), 2) << "as in a folder of its own";
}

// What a handler of signals does: own files go, those of another writer and of a process that was forked do not.
TEST(Files, AProcessThatEndsBySignalRemovesItsOwn) {
  const std::string folder = fresh_folder("ends");
  AtomicFile other(folder + "/other");
  const pid_t child = ::fork();
  if (child == 0) {
    AtomicFile first(folder + "/first"), done(folder + "/done");
    done.commit();
    remove_own_temporaries();
    ::raise(SIGKILL);
  }
  ASSERT_EQ(::waitpid(child, nullptr, 0), child);
  EXPECT_EQ(entries(folder), 2u);
  EXPECT_TRUE(fs::exists(folder + "/done"));
  other.commit();
  EXPECT_TRUE(fs::exists(folder + "/other"));
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

// What a loaded scene keeps of its frames: every value exactly, in the narrowest type.

constexpr std::size_t kPixels = 40 * 30;

TEST(LabelMap, OneByteUpToIndex254) {
  std::vector<std::int16_t> labels{kVoid, 0, 1, 253, 254};
  const LabelMap narrow(labels);
  EXPECT_EQ(narrow.expand(), labels);
  EXPECT_EQ(narrow.bytes(), labels.size());
  for (std::size_t i = 0; i < labels.size(); ++i) EXPECT_EQ(narrow[i], labels[i]);
  labels.push_back(255);
  const LabelMap wide(labels);
  EXPECT_EQ(wide.expand(), labels);
  for (std::size_t i = 0; i < labels.size(); ++i) EXPECT_EQ(wide[i], labels[i]);
  EXPECT_TRUE(LabelMap().empty());
}

TEST(DepthMap, WholeMillimetresTakeTwoBytesAndOthersStayAsTheyAre) {
  std::vector<float> depth;
  for (int mm = 0; mm <= 65535; ++mm) depth.push_back(static_cast<float>(mm * 0.001));
  const DepthMap packed(depth);
  EXPECT_EQ(packed.expand(), depth);
  EXPECT_EQ(packed.bytes(), 2 * depth.size());
  for (const float odd : {1.00049f, 65.536f, -0.001f, std::numeric_limits<float>::quiet_NaN(),
                          std::numeric_limits<float>::infinity(), 1e30f}) {
    std::vector<float> with = depth;
    with[7000] = odd;
    const DepthMap kept(with);
    const std::vector<float> back = kept.expand();
    ASSERT_EQ(back.size(), with.size());
    EXPECT_EQ(std::memcmp(back.data(), with.data(), with.size() * sizeof(float)), 0) << odd;
    EXPECT_GE(kept.bytes(), 4 * depth.size());
  }
}

// Frames of a Replica folder, read as the datasets read them.
struct FileDataset {
  explicit FileDataset(std::string written_here) : folder(std::move(written_here)) {
    write_replica(folder, 6);
    classes = ClassTable::load(folder + "/classes.yaml");
  }
  std::string folder;
  ClassTable classes;

  SceneInfo open(Diagnostics&) const {
    SceneInfo info{.name = "files", .classes = classes};
    for (int i = 0; i < 6; ++i) {
      FrameInfo f{.name = std::to_string(i),
                  .camera = room_camera(),
                  .world_from_camera = room_pose(i),
                  .split = i % 2 == 0 ? Split::train : Split::test,
                  .has_depth = true,
                  .has_labels = true,
                  .has_instances = true};
      info.frames.push_back(f);
    }
    return info;
  }
  void read(int i, FrameBuffer& out) const {
    const std::string n = "_" + std::to_string(i) + ".png";
    const FrameFiles files{folder + "/rgb/rgb" + n, folder + "/depth/depth" + n,
                           folder + "/semantic_class/semantic_class" + n,
                           folder + "/semantic_instance/semantic_instance" + n};
    Diagnostics ignored;
    read_frame_files(open(ignored).frames[i], files, {}, classes, out);
  }
};

LoadedScene load_on(const FileDataset& files, int threads, DepthKept depth) {
  SceneLoadOptions options{.depth = depth};
  Diagnostics d;
  set_thread_count(threads);
  LoadedScene scene = load_scene(files, options, d);
  set_thread_count(0);
  EXPECT_TRUE(d.all().empty());
  return scene;
}

TEST(StoredFrame, ParallelDecodingGivesTheBytesOfTheFiles) {
  const FileDataset files(fresh_folder("files"));
  const LoadedScene serial = load_on(files, 1, DepthKept::all), parallel = load_on(files, 3, DepthKept::all);
  for (std::size_t i = 0; i < 6; ++i) {
    FrameBuffer read;
    files.read(static_cast<int>(i), read);
    for (const LoadedScene* scene : {&serial, &parallel}) {
      EXPECT_EQ(scene->frames[i].rgb, read.rgb);
      EXPECT_EQ(scene->frames[i].label.expand(), read.label);
      EXPECT_EQ(scene->frames[i].depth_m.expand(), read.depth_m);
    }
  }
  EXPECT_EQ(serial.class_pixels, parallel.class_pixels);
}

TEST(StoredFrame, KeepsThreeBytesOfColourOneOfLabelAndTwoOfDepthAPixel) {
  const FileDataset files(fresh_folder("files"));
  const std::size_t rows = 30;  // a decoded PNG may keep the room of its filter bytes, one per row
  for (const StoredFrame& frame : load_on(files, 2, DepthKept::all).frames) {
    EXPECT_GE(frame.bytes(), kPixels * (3 + 1 + 2));
    EXPECT_LE(frame.bytes(), kPixels * (3 + 1 + 2) + rows);
  }
  const LoadedScene tests = load_on(files, 2, DepthKept::test);
  for (std::size_t i = 0; i < 6; ++i) {
    EXPECT_LE(tests.frames[i].bytes(), kPixels * (i % 2 == 0 ? 4 : 6) + rows);
    EXPECT_EQ(tests.frames[i].depth_m.empty(), i % 2 == 0);
  }
  EXPECT_EQ(tests.bounds_from, "depth of 3 training frames") << "dropped after it was surveyed";
}

// Which frames are held out.

std::string splits(HoldOut rule, std::size_t frames) {
  std::string out;
  for (std::size_t i = 0; i < frames; ++i) out += rule.split_of(i, frames) == Split::test ? 'T' : '.';
  return out;
}

TEST(HoldOut, EveryNthFromTheFirst) {
  EXPECT_EQ(splits({8}, 10), "T.......T.");
  EXPECT_EQ(splits({2, 1}, 5), ".T.T.");
  EXPECT_EQ(splits({0}, 3), "...");
  EXPECT_EQ(splits({0, -1}, 3), "...");
  EXPECT_EQ(splits({8}, 1), ".");
}

TEST(HoldOut, OneInOneIsRefused) {
  Diagnostics d;
  check_test_every(1, d);
  ASSERT_EQ(d.error_count(), 1);
  EXPECT_EQ(d.all()[0].text(), "test_every: 1 leaves no frame to train on; take 2 or more, or 0 for no test frames");
  check_test_every(0, d);
  check_test_every(2, d);
  EXPECT_EQ(d.error_count(), 1);
}

}  // namespace
}  // namespace semfield
