// Cast frames are kept and found again, and never in place of others.
#include "datasets/obj_room/cast_cache.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <filesystem>
#include <fstream>

#include "core/error.h"
#include "datasets/obj_room/obj_room.h"
#include "system/cache_folder.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;

class CastCacheTest : public testing::Test {
 protected:
  void SetUp() override {
    folder_ = fs::path(testing::TempDir()) / ("cast_cache_" + std::to_string(::getpid()));
    fs::remove_all(folder_);
    ::setenv("SEMFIELD_CACHE", folder_.c_str(), 1);
  }
  void TearDown() override {
    fs::remove_all(folder_);
    ::setenv("SEMFIELD_CACHE", "off", 1);
    ::unsetenv("SEMFIELD_CACHE_GB");
  }

  static ObjRoomParams params() {
    ObjRoomParams p;
    p.root = std::string(SEMFIELD_SOURCE_DIR) + "/scenes/room";
    p.width_px = 24;
    p.height_px = 18;
    p.frames = 2;
    p.test_frames = 1;
    p.supersample = 1;
    p.occlusion_rays = 1;
    p.shadow_rays = 1;
    return p;
  }
  static std::vector<FrameBuffer> frames(const ObjRoomParams& p) {
    ObjRoom room(p, {});
    Diagnostics diagnostics;
    const SceneInfo info = room.open(diagnostics);
    std::vector<FrameBuffer> all(info.frames.size());
    for (std::size_t i = 0; i < all.size(); ++i) room.read(static_cast<int>(i), all[i]);
    return all;
  }
  static void expect_equal(const std::vector<FrameBuffer>& a, const std::vector<FrameBuffer>& b) {
    ASSERT_EQ(a.size(), b.size());
    for (std::size_t i = 0; i < a.size(); ++i) {
      EXPECT_EQ(a[i].rgb, b[i].rgb);
      EXPECT_EQ(a[i].depth_m, b[i].depth_m);
      EXPECT_EQ(a[i].label, b[i].label);
      EXPECT_EQ(a[i].instance, b[i].instance);
    }
  }
  std::vector<fs::path> kept() const {
    std::vector<fs::path> files;
    if (!fs::exists(folder_)) return files;
    for (const auto& entry : fs::recursive_directory_iterator(folder_)) {
      if (entry.is_regular_file()) files.push_back(entry.path());
    }
    std::sort(files.begin(), files.end());
    return files;
  }

  fs::path folder_;
};

TEST_F(CastCacheTest, FramesComeBackBitForBit) {
  const auto cast = frames(params());
  ASSERT_EQ(kept().size(), 3U);
  const auto written = fs::last_write_time(kept()[0]);
  expect_equal(frames(params()), cast);
  EXPECT_EQ(kept().size(), 3U);
  EXPECT_EQ(fs::last_write_time(kept()[0]), written) << "was cast again";
}

// What is kept is what is read: pictures of one file in the place of another come back as they are.
TEST_F(CastCacheTest, AKeptFrameIsReadAndNotCast) {
  const auto cast = frames(params());
  const auto files = kept();
  ASSERT_EQ(files.size(), 3U);
  fs::copy_file(files[1], files[0], fs::copy_options::overwrite_existing);
  EXPECT_EQ(frames(params())[0].rgb, cast[1].rgb);
}

TEST_F(CastCacheTest, ADamagedFileIsCastAgainAndMended) {
  const auto cast = frames(params());
  for (const fs::path& file : kept()) {
    std::fstream stream(file, std::ios::in | std::ios::out | std::ios::binary);
    stream.seekp(200);
    stream.put('\x55');
    stream.put('\x55');
  }
  fs::resize_file(kept()[2], 100);
  expect_equal(frames(params()), cast);
  expect_equal(frames(params()), cast);
  EXPECT_GT(fs::file_size(kept()[2]), 100U);
}

TEST_F(CastCacheTest, WhateverChangesPicturesHasItsOwnPlace) {
  const auto cast = frames(params());
  int others = 0;
  const auto differs = [&](const auto& change) {
    ObjRoomParams p = params();
    change(p);
    const std::size_t before = kept().size();
    const auto changed = frames(p);
    EXPECT_EQ(kept().size(), before + 3);
    EXPECT_NE(changed[0].rgb, cast[0].rgb);
    ++others;
  };
  differs([](ObjRoomParams& p) { p.exposure = 1.1; });
  differs([](ObjRoomParams& p) { p.seed = 7; });
  differs([](ObjRoomParams& p) { p.daylight = 0; });
  differs([](ObjRoomParams& p) { p.hfov_deg = 70; });
  differs([](ObjRoomParams& p) { p.occlusion_rays = 4; });
  EXPECT_EQ(others, 5);
  expect_equal(frames(params()), cast);
}

TEST_F(CastCacheTest, ATextureThatChangesChangesTheKey) {
  fs::create_directories(folder_);
  const std::string texture = (folder_ / "map.png").string();
  std::ofstream(texture) << "one";
  TriangleMesh mesh;
  mesh.materials.resize(1);
  mesh.materials[0].diffuse_map = texture;
  const std::string before = cast_key(mesh, {}, {});
  EXPECT_EQ(cast_key(mesh, {}, {}), before);
  std::ofstream(texture) << "two";
  EXPECT_NE(cast_key(mesh, {}, {}), before);
}

TEST_F(CastCacheTest, RoomsUnusedForLongestGo) {
  ::setenv("SEMFIELD_CACHE_GB", "0.00000001", 1);  // 10 bytes: only the room in use stays
  (void)frames(params());
  ObjRoomParams other = params();
  other.exposure = 1;
  (void)frames(other);
  EXPECT_EQ(kept().size(), 3U);
  ::setenv("SEMFIELD_CACHE_GB", "0", 1);
  fs::remove_all(folder_);
  (void)frames(params());
  EXPECT_EQ(kept().size(), 0U);
}

TEST_F(CastCacheTest, NothingIsKeptWhereItIsOffOrCannotBe) {
  ::setenv("SEMFIELD_CACHE", "off", 1);
  EXPECT_EQ(cache_folder("rooms"), "");
  const auto cast = frames(params());
  EXPECT_EQ(kept().size(), 0U);
  ::setenv("SEMFIELD_CACHE", "/proc/none", 1);
  expect_equal(frames(params()), cast);
  ::setenv("SEMFIELD_CACHE", folder_.c_str(), 1);
  ::setenv("SEMFIELD_CACHE_GB", "two", 1);
  EXPECT_THROW((void)frames(params()), Error);
}

}  // namespace
}  // namespace semfield
