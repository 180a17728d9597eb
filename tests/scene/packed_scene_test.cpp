// Packed scenes: round trip, damage of any byte, lies about sizes.
#include "loading/packed_scene.h"

#include <gtest/gtest.h>

#include "compute/parallel.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

SceneInfo room_info(int frames) {
  SceneInfo info;
  info.name = "room";
  info.metric = true;
  info.near_hint_m = 0.1;
  info.far_hint_m = 7;
  info.bounds.include({-2, -1.5, -2.5});
  info.bounds.include({2, 1.5, 2.5});
  info.classes = ClassTable({{0, "void", {}, true},
                             {1, "west", {1, 2, 3}, false},
                             {2, "east", {}, false},
                             {3, "up", {}, false},
                             {40, "down", {}, false},
                             {50, "south", {}, false},
                             {600, "north", {}, false}});
  for (int i = 0; i < frames; ++i) {
    FrameInfo f;
    f.name = "rgb_" + std::to_string(i);
    f.source = "somewhere/" + f.name;
    f.camera = room_camera(12, 9);
    f.camera.k1 = 0.01 * i;
    f.world_from_camera = room_pose(i);
    f.split = i % 2 == 0 ? Split::train : Split::test;
    info.frames.push_back(f);
  }
  return info;
}

void render(const SceneInfo& info, int i, FrameBuffer& out) {
  out = render_room(info.frames[static_cast<std::size_t>(i)].camera,
                    info.frames[static_cast<std::size_t>(i)].world_from_camera);
  if (i == 1) out.depth_m.clear();
  if (i == 2) out.label.clear();
  if (i == 0) out.label[5] = kVoid;
}

std::string packed_room(const std::string& folder, const PackOptions& options, int frames = 3) {
  const std::string path = folder + "/room.semfield";
  const SceneInfo info = room_info(frames);
  write_packed_scene(
      path, info, [&](int i, FrameBuffer& out) { render(info, i, out); }, options);
  return path;
}

TEST(PackedScene, ALimitIsKeptAndNoLimitTakesNoBytes) {
  const std::string path = fresh_folder("l") + "/room.semfield";
  SceneInfo info = room_info(2);
  const auto pack = [&] {
    write_packed_scene(path, info, [&](int i, FrameBuffer& out) { render(info, i, out); }, {});
    return std::filesystem::file_size(path);
  };
  const auto without = pack();
  EXPECT_TRUE(PackedScene(path).info().limit.empty());
  info.limit = {{-3, -2, -1}, {3, 2, 1}};
  EXPECT_EQ(pack(), without + 6 * sizeof(double));
  EXPECT_EQ(PackedScene(path).info().limit.lo, info.limit.lo);
  EXPECT_EQ(PackedScene(path).info().limit.hi, info.limit.hi);
}

TEST(PackedScene, RoundTripIsExact) {
  PackOptions options;
  options.depth_as_mm = false;
  const PackedScene scene(packed_room(fresh_folder("p"), options));
  const SceneInfo want = room_info(3);
  ASSERT_EQ(scene.info().frames.size(), 3u);
  EXPECT_EQ(scene.info().name, "room");
  EXPECT_EQ(scene.info().far_hint_m, 7.0);
  EXPECT_EQ(scene.info().bounds.hi, want.bounds.hi);
  EXPECT_EQ(scene.info().classes.to_yaml(), want.classes.to_yaml());
  for (int i = 0; i < 3; ++i) {
    const auto n = static_cast<std::size_t>(i);
    const FrameInfo& f = scene.info().frames[n];
    EXPECT_EQ(f.name, want.frames[n].name);
    EXPECT_EQ(f.camera.k1, want.frames[n].camera.k1);
    EXPECT_EQ(f.world_from_camera.r, want.frames[n].world_from_camera.r);
    EXPECT_EQ(f.split, want.frames[n].split);
    EXPECT_EQ(f.has_depth, i != 1);
    EXPECT_EQ(f.has_labels, i != 2);
    FrameBuffer a, b;
    render(want, i, a);
    scene.read(i, b);
    EXPECT_EQ(a.rgb, b.rgb);
    EXPECT_EQ(a.depth_m, b.depth_m);
    EXPECT_EQ(a.label, b.label);
    EXPECT_EQ(a.instance, b.instance);
  }
}

// A sweep packs a scene as its files are; what its cells say of the poses in the files holds for the packed scene too.
TEST(PackedScene, RemembersTheAxesOfTheFiles) {
  for (const bool metric : {false, true}) {
    for (const bool opengl : {false, true}) {
      SceneInfo info = room_info(1);
      info.metric = metric;
      info.opengl_files = opengl;
      const std::string path = fresh_folder("p") + "/room.semfield";
      write_packed_scene(path, info, [&](int i, FrameBuffer& out) { render(info, i, out); });
      const PackedScene scene(path);
      EXPECT_EQ(scene.info().metric, metric);
      EXPECT_EQ(scene.info().opengl_files, opengl);
    }
  }
}

TEST(PackedScene, MillimetresRoundToHalfAMillimetre) {
  const PackedScene scene(packed_room(fresh_folder("p"), {}));
  FrameBuffer a, b;
  render(room_info(3), 0, a);
  scene.read(0, b);
  ASSERT_EQ(a.depth_m.size(), b.depth_m.size());
  for (std::size_t i = 0; i < a.depth_m.size(); ++i) EXPECT_NEAR(a.depth_m[i], b.depth_m[i], 0.000501);
}

TEST(PackedScene, FlippedBitsAreRefused) {
  const std::string folder = fresh_folder("p");
  const std::string path = packed_room(folder, {}, 2);
  const std::string whole = read_text_file(path);
  // Every byte of the header, every fifth behind it.
  for (std::size_t at = 0; at < whole.size(); at += at < 64 ? 1 : 5) {
    std::string bad = whole;
    bad[at] = static_cast<char>(bad[at] ^ (1 << (at % 8)));
    plain_write(folder + "/bad", bad);
    const std::string message = error_of([&] {
      const PackedScene scene(folder + "/bad");
      FrameBuffer out;
      for (int i = 0; i < 2; ++i) scene.read(i, out);
    });
    EXPECT_NE(message.find(folder + "/bad"), std::string::npos) << "byte " << at;
  }
}

TEST(PackedScene, EveryTruncationIsRefused) {
  const std::string folder = fresh_folder("p");
  const std::string whole = read_text_file(packed_room(folder, {}, 2));
  for (std::size_t length = 0; length < whole.size(); length += 13) {
    plain_write(folder + "/bad", whole.substr(0, length));
    EXPECT_THROW(PackedScene(folder + "/bad"), Error) << length;
  }
}

TEST(PackedScene, MessagesAreExact) {
  const std::string folder = fresh_folder("p");
  const std::string path = packed_room(folder, {}, 2);
  std::string bytes = read_text_file(path);
  EXPECT_EQ(error_of([&] { PackedScene("nowhere.semfield"); }),
            "cannot open 'nowhere.semfield': No such file or directory; check the path");
  write_file_atomic(folder + "/text", std::string_view("no scene"));
  EXPECT_EQ(error_of([&] { PackedScene(folder + "/text"); }),
            "'" + folder + "/text': not a packed scene; give a file that 'semfield pack' wrote");
  const std::size_t size = bytes.size();
  bytes[70] = static_cast<char>(bytes[70] ^ 1);  // the first chunk, right behind the header
  write_file_atomic(path, bytes);
  const PackedScene scene(path);  // the manifest is whole; the chunk tells when it is read
  FrameBuffer out;
  EXPECT_EQ(error_of([&] { scene.read(0, out); }),
            "'" + path +
                "': frame 'rgb_0': colour is damaged (wrong checksum); copy the file again, or pack the scene again");
  cut(path, 10);
  EXPECT_EQ(error_of([&] { PackedScene{path}; }), "'" + path + "': holds " + std::to_string(size - 10) +
                                                      " bytes, its header says " + std::to_string(size) +
                                                      "; copy the file again");
}

TEST(PackedScene, ParallelReadsAgree) {
  const PackedScene scene(packed_room(fresh_folder("p"), {}, 8));
  std::vector<FrameBuffer> serial(8), parallel(8);
  for (int i = 0; i < 8; ++i) scene.read(i, serial[static_cast<std::size_t>(i)]);
  parallel_for(8, [&](std::int64_t i) { scene.read(static_cast<int>(i), parallel[static_cast<std::size_t>(i)]); });
  for (std::size_t i = 0; i < 8; ++i) {
    EXPECT_EQ(serial[i].rgb, parallel[i].rgb);
    EXPECT_EQ(serial[i].depth_m, parallel[i].depth_m);
  }
}

TEST(PackedScene, FailingSourceLeavesNoFile) {
  const std::string folder = fresh_folder("p");
  const SceneInfo info = room_info(2);
  EXPECT_THROW(
      write_packed_scene(folder + "/a", info,
                         [](int, FrameBuffer&) { throw Error(ErrorKind::data, "test.error.made", "broken frame"); }),
      Error);
  EXPECT_TRUE(std::filesystem::is_empty(folder));
}

}  // namespace
}  // namespace semfield
