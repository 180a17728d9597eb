// What a loaded scene keeps of its frames: every value exactly, in the narrowest type.
#include "scene/stored_frame.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <limits>

#include "compute/parallel.h"
#include "loading/frame_files.h"
#include "loading/frame_source.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

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
    SceneInfo info;
    info.name = "files";
    info.classes = classes;
    for (int i = 0; i < 6; ++i) {
      FrameInfo f;
      f.name = std::to_string(i);
      f.camera = room_camera();
      f.world_from_camera = room_pose(i);
      f.split = i % 2 == 0 ? Split::train : Split::test;
      f.has_depth = f.has_labels = f.has_instances = true;
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
    read_frame_files(open(ignored).frames[static_cast<std::size_t>(i)], files, {}, classes, out);
  }
};

LoadedScene load_on(const FileDataset& files, int threads, DepthKept depth) {
  SceneLoadOptions options;
  options.depth = depth;
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

}  // namespace
}  // namespace semfield
