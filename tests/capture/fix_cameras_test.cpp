// Cameras of a scene with poses, fixed; a program stands for COLMAP that finds true corners in every photograph.
#include "scene/loading/capture/fix_cameras.h"

#include <sqlite3.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <functional>
#include <map>
#include <memory>
#include <random>

#include "tests/scene/bundle_error.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

struct Closer {
  void operator()(sqlite3* base) const { sqlite3_close(base); }
};

class Database {
 public:
  explicit Database(const std::string& file) {
    sqlite3* opened = nullptr;
    EXPECT_EQ(sqlite3_open(file.c_str(), &opened), SQLITE_OK);
    base_.reset(opened);
    run("CREATE TABLE IF NOT EXISTS images (image_id INTEGER PRIMARY KEY, name TEXT, camera_id INTEGER)");
    run("CREATE TABLE IF NOT EXISTS keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB)");
    run("CREATE TABLE IF NOT EXISTS two_view_geometries (pair_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data "
        "BLOB)");
  }
  void run(const std::string& sql) const {
    EXPECT_EQ(sqlite3_exec(base_.get(), sql.c_str(), nullptr, nullptr, nullptr), SQLITE_OK)
        << sqlite3_errmsg(base_.get());
  }
  template <class T>
  void blob(const std::string& table, std::int64_t id, const std::vector<T>& values, int cols) const {
    sqlite3_stmt* row = nullptr;
    ASSERT_EQ(sqlite3_prepare_v2(base_.get(), ("INSERT OR REPLACE INTO " + table + " VALUES (?, ?, ?, ?)").c_str(), -1,
                                 &row, nullptr),
              SQLITE_OK);
    sqlite3_bind_int64(row, 1, id);
    sqlite3_bind_int64(row, 2, std::ssize(values) / cols);
    sqlite3_bind_int64(row, 3, cols);
    sqlite3_bind_blob(row, 4, values.data(), static_cast<int>(values.size() * sizeof(T)), SQLITE_TRANSIENT);
    EXPECT_EQ(sqlite3_step(row), SQLITE_DONE);
    sqlite3_finalize(row);
  }

 private:
  std::unique_ptr<sqlite3, Closer> base_;
};

constexpr std::int64_t kPairBase = 2147483647;

TEST(FeatureTracks, MatchesBecomeTracksAndContradictionsAreDropped) {
  const std::string file = fresh_folder("tracks") + "/a.db";
  {
    const Database base(file);
    for (int i = 1; i <= 3; ++i) {
      base.run("INSERT INTO images VALUES (" + std::to_string(i) + ", '0/" + std::to_string(i) + ".png', 1)");
      base.blob("keypoints", i, std::vector<float>{10.5f * i, 1, 0, 0, 20, 2, 0, 0, 30, 3, 0, 0}, 4);
    }
    // 1-2: first to first, second to second, third to third. 2-3: the first. 1-3: the first of 1 to the second of 3,
    // which has the first of 3 already.
    base.blob("two_view_geometries", kPairBase * 1 + 2, std::vector<std::uint32_t>{0, 0, 1, 1, 2, 2}, 2);
    base.blob("two_view_geometries", kPairBase * 2 + 3, std::vector<std::uint32_t>{0, 0, 1, 2}, 2);
    base.blob("two_view_geometries", kPairBase * 1 + 3, std::vector<std::uint32_t>{0, 1}, 2);
  }
  const std::vector<Track> tracks = feature_tracks(file, {"0/1.png", "0/2.png", "0/3.png"});
  ASSERT_EQ(tracks.size(), 3u);
  ASSERT_EQ(tracks[0].seen.size(), 3u);
  EXPECT_EQ(tracks[0].seen[1].frame, 1);
  EXPECT_EQ(tracks[0].seen[2].u, 31.5);
  EXPECT_EQ(tracks[1].seen.size(), 3u);
  EXPECT_EQ(tracks[2].seen.size(), 2u);
  EXPECT_EQ(feature_tracks(file, {"0/2.png"}).size(), 0u) << "frames of others";
  std::ofstream(file) << "no database at all, though long enough to hold the header of one";
  EXPECT_THROW((void)feature_tracks(file, {"0/1.png"}), Error);
}

TEST(FeatureTracks, ADatabaseThatLiesIsReadWithoutHarm) {
  const std::string file = fresh_folder("lies") + "/a.db";
  {
    const Database base(file);
    for (int i = 1; i <= 2; ++i) {
      base.run("INSERT INTO images VALUES (" + std::to_string(i) + ", '" + std::to_string(i) + "', 1)");
      base.blob("keypoints", i, std::vector<float>{1, 2}, 2);
    }
    base.blob("two_view_geometries", kPairBase + 2, std::vector<std::uint32_t>{0, 7}, 2);
    base.run("UPDATE keypoints SET rows = 9000000000 WHERE image_id = 1");
  }
  EXPECT_EQ(feature_tracks(file, {"1", "2"}).size(), 0u);
}

// Twelve frames that look at two walls, with their true corners.
struct Capture {
  Camera camera{.width_px = 320, .height_px = 240, .fx = 260, .fy = 260, .cx = 161, .cy = 119};
  std::vector<Pose> poses;
  std::vector<Vec3d> points;
  PosedScene scene;
  int calls = 0;
  double noise_px = 0.15, rolling_px = 0;  // of the lowest row against the highest

  Capture() {
    std::mt19937 random(4);
    std::uniform_real_distribution<double> one(-1, 1);
    for (int i = 0; i < 12; ++i) {
      const double a = i / 12.0 - 0.5;
      poses.push_back(moved({}, {0.1 * std::sin(4 * a), 0.4 * a, 0.05 * a, 0, 0, 0}));
      poses.back().t = {0.8 * a, 0.15 * std::sin(5 * a), 0.1 * a};
    }
    for (int i = 0; i < 500; ++i)
      points.push_back({1.6 * one(random), one(random), i % 2 == 0 ? 3.5 : 2.6 + 0.5 * one(random)});
    scene.info.name = "capture";
    for (std::size_t i = 0; i < poses.size(); ++i)
      scene.info.frames.push_back({.name = std::to_string(i),
                                   .source = "frame " + std::to_string(i),
                                   .camera = camera,
                                   .world_from_camera = poses[i]});
    scene.read = [this](int, FrameBuffer& out) {
      out.width_px = camera.width_px;
      out.height_px = camera.height_px;
      out.rgb.assign(static_cast<std::size_t>(320 * 240 * 3), 90);
    };
  }

  // What a photograph shows of the points: their place where it is in the image.
  std::map<std::uint32_t, std::pair<float, float>> corners(std::size_t frame) const {
    std::map<std::uint32_t, std::pair<float, float>> out;
    std::mt19937 random(static_cast<unsigned>(frame));
    std::normal_distribution<double> noise(0, noise_px);
    for (std::uint32_t p = 0; p < points.size(); ++p) {
      double u = 0, v = 0;
      camera.project(poses[frame].apply_inverse(points[p]), u, v);
      u += rolling_px * (v / 240 - 0.5) * std::sin(0.9 * static_cast<double>(frame));
      if (u > 0 && v > 0 && u < 320 && v < 240)
        out[p] = {static_cast<float>(u + noise(random)), static_cast<float>(v + noise(random))};
    }
    return out;
  }
  static std::size_t frame_of(const std::string& name) {
    return static_cast<std::size_t>(std::stoul(fs::path(name).stem().string()));
  }

  int colmap(const std::vector<std::string>& words) {
    ++calls;
    const auto after = [&](const std::string& word) { return *(std::find(words.begin(), words.end(), word) + 1); };
    const Database base(after("--database_path"));
    if (words[1] == "feature_extractor") {
      for (const auto& file : fs::recursive_directory_iterator(after("--image_path"))) {
        if (!file.is_regular_file()) continue;
        const std::string name = fs::relative(file.path(), after("--image_path")).string();
        const std::string id = std::to_string(40 - frame_of(name));
        base.run("INSERT INTO images VALUES (" + id + ", '" + name + "', 1)");
        std::vector<float> rows;
        for (const auto& [point, at] : corners(frame_of(name))) rows.insert(rows.end(), {at.first, at.second, 1, 0});
        base.blob("keypoints", std::stol(id), rows, 4);
      }
      return 0;
    }
    std::ifstream list(after("--match_list_path"));
    for (std::string a, b; list >> a >> b;) {
      std::size_t i = frame_of(a), j = frame_of(b);
      if (i < j) std::swap(i, j);  // its id is the smaller one
      const auto x = corners(i), y = corners(j);
      std::vector<std::uint32_t> pairs;
      std::uint32_t row = 0;
      for (auto at = x.begin(); at != x.end(); ++at, ++row)
        if (y.contains(at->first))
          pairs.insert(pairs.end(), {row, static_cast<std::uint32_t>(std::distance(y.begin(), y.find(at->first)))});
      base.blob("two_view_geometries",
                kPairBase * static_cast<std::int64_t>(40 - i) + static_cast<std::int64_t>(40 - j), pairs, 2);
    }
    return 0;
  }

  FixedCameras fix(const std::string& out) {
    const Programs programs{[](const std::string& name) { return name; },
                            [this](const std::vector<std::string>& words, const std::string&,
                                   const std::function<void()>&) { return colmap(words); }};
    return fix_cameras(scene, out, 1, programs, [](const CaptureStep&, double, double) {});
  }
};

TEST(FixCameras, RightOnesAreKept) {
  Capture c;
  const FixedCameras found = c.fix(fresh_folder("right") + "/new");
  EXPECT_TRUE(found.kept);
  EXPECT_EQ(found.changes, std::vector<std::string>{});
  ASSERT_EQ(found.cameras.size(), 12u);
  EXPECT_TRUE(found.cameras[3] == c.camera);
  EXPECT_EQ(length(found.poses[3].t - c.poses[3].t), 0);
}

TEST(FixCameras, AWrongLensAndShakenPosesComeBackAndTheSameCallGoesOn) {
  Capture c;
  for (std::size_t i = 0; i < c.poses.size(); ++i) {
    FrameInfo& frame = c.scene.info.frames[i];
    frame.camera.fx = frame.camera.fy = 290;
    const auto k = static_cast<double>(i);
    frame.world_from_camera =
        moved(frame.world_from_camera, {0.01 * std::sin(k), 0.01 * std::cos(3 * k), 0, 0.02 * std::sin(2 * k), 0, 0});
  }
  const std::string out = fresh_folder("wrong") + "/new";
  const FixedCameras found = c.fix(out);
  EXPECT_FALSE(found.kept);
  EXPECT_GT(found.given_px, 3 * found.fixed_px);
  EXPECT_NEAR(found.cameras[0].fx, 260, 4);
  ASSERT_EQ(found.changes.size(), 2u);
  EXPECT_HAS(found.changes[0], "focal length 290.0 -> 2");
  EXPECT_HAS(found.changes[1], "poses by ", "degrees");
  const int calls = c.calls;
  EXPECT_EQ(c.fix(out).fixed_px, found.fixed_px);
  EXPECT_EQ(c.calls, calls) << "features and matches are there";
  c.scene.info.frames[0].camera.fx = 250;
  try {
    (void)c.fix(out);
    ADD_FAILURE() << "another scene's folder was taken";
  } catch (const Error& e) {
    EXPECT_TRUE(e.code() == "capture.scene.other");
  }
}

// The median error of the true corners under these cameras, pixels; noise of corners included.
double off_px(const Capture& c, const std::vector<Camera>& cameras, const std::vector<Pose>& poses) {
  Bundle bundle;
  bundle.stated = cameras;
  bundle.given = bundle.poses = poses;
  bundle.lens_of.assign(poses.size(), 0);
  bundle.lenses.resize(1);
  std::map<std::uint32_t, Track> tracks;
  for (std::size_t f = 0; f < poses.size(); ++f)
    for (const auto& [point, at] : c.corners(f))
      tracks[point].seen.push_back(
          {static_cast<std::int32_t>(f), static_cast<double>(at.first), static_cast<double>(at.second)});
  for (auto& [point, track] : tracks)
    if (track.seen.size() > 1 && settle_point(bundle, track)) bundle.tracks.push_back(track);
  return median_error_px(bundle);
}

// What is extreme is fixed, or kept; it is never made worse.
TEST(FixCameras, ExtremeCamerasAreFixedOrKept) {
  struct Case {
    const char* name;
    std::function<void(Capture&)> spoil;
    double most_px;  // that are left; 0: no more than before
  };
  const auto each = [](const std::function<void(FrameInfo&, std::size_t)>& change) {
    return [change](Capture& c) {
      for (std::size_t i = 0; i < c.scene.info.frames.size(); ++i) change(c.scene.info.frames[i], i);
    };
  };
  const std::vector<Case> cases{
      {"focal length off by 20 %", each([](FrameInfo& f, std::size_t) { f.camera.fx = f.camera.fy = 312; }), 0.3},
      {"principal point off by 30 pixels", each([](FrameInfo& f, std::size_t) { f.camera.cx += 30; }), 0.3},
      {"rolling shutter of 10 pixels", [](Capture& c) { c.rolling_px = 10; }, 0},
      {"delay of a frame",
       [](Capture& c) {
         for (std::size_t i = 0; i + 1 < c.poses.size(); ++i) c.scene.info.frames[i].world_from_camera = c.poses[i + 1];
       },
       0.3},
      {"five frames",
       [](Capture& c) {
         c.scene.info.frames.resize(5);
         c.poses.resize(5);
         for (FrameInfo& f : c.scene.info.frames) f.camera.fx = f.camera.fy = 280;
       },
       0},
      {"all frames blurred", [](Capture& c) { c.noise_px = 4; }, 0},
      {"a plane alone",
       [](Capture& c) {
         for (Vec3d& p : c.points) p.z = 3.5;
         for (FrameInfo& f : c.scene.info.frames) f.camera.fx = f.camera.fy = 290;
       },
       0},
      {"a pose far off",
       [](Capture& c) {
         c.scene.info.frames[4].world_from_camera = moved(c.poses[4], {0.3, 0, 0, 0.5, 0, 0});
       },
       0.3}};
  const std::string folder = fresh_folder("extreme");
  for (const Case& one : cases) {
    Capture c;
    one.spoil(c);
    std::vector<Camera> cameras;
    std::vector<Pose> poses;
    for (const FrameInfo& f : c.scene.info.frames) {
      cameras.push_back(f.camera);
      poses.push_back(f.world_from_camera);
    }
    const FixedCameras found = c.fix(folder + "/" + one.name);
    const double before = off_px(c, cameras, poses), after = off_px(c, found.cameras, found.poses);
    EXPECT_LE(after, one.most_px > 0 ? one.most_px : before + 1e-9) << one.name << ": " << before << " -> " << after;
    for (const Camera& camera : found.cameras) EXPECT_TRUE(camera.has_finite_lens()) << one.name;
  }
}

TEST(FixCameras, WhatCannotBeMendedIsRefused) {
  Capture c;
  const std::string folder = fresh_folder("refused");
  c.scene.info.frames.resize(2);
  EXPECT_THROW((void)c.fix(folder + "/a"), Error);
  Capture round;
  for (FrameInfo& frame : round.scene.info.frames) frame.camera.lens = LensKind::equirectangular;
  EXPECT_THROW((void)round.fix(folder + "/b"), Error);
  EXPECT_FALSE(fs::exists(folder + "/b"));
  // Photographs that share nothing leave cameras as they are.
  Capture blind;
  blind.points.clear();
  EXPECT_TRUE(blind.fix(folder + "/c").kept);
}

TEST(FixCameras, WhatMasksHideIsNotMatched) {
  Capture c;
  const std::size_t all = c.fix(fresh_folder("whole") + "/new").points;
  const auto read = c.scene.read;
  c.scene.read = [&](int frame, FrameBuffer& out) {
    read(frame, out);
    for (int y = 0; y < 240; ++y)
      for (int x = 0; x < 320; ++x) out.used.push_back(x < 160 ? 0 : 1);
  };
  const std::size_t half = c.fix(fresh_folder("half") + "/new").points;
  EXPECT_LT(half, 3 * all / 4);
  EXPECT_GT(half, all / 4);
}

TEST(FixCameras, PairsAreOfFramesThatLookAtTheSame) {
  std::vector<Pose> poses;
  for (int i = 0; i < 60; ++i) {
    poses.push_back(moved({}, {0, i < 30 ? 0 : M_PI, 0, 0, 0, 0}));
    poses.back().t = {0.1 * i, 0, 0};
  }
  const std::vector<Pair> pairs = pairs_by_pose(poses);
  EXPECT_LT(pairs.size(), 60u * 14);
  for (const auto& [i, j] : pairs) {
    EXPECT_LT(i, j);
    EXPECT_TRUE((i < 30) == (j < 30) || j - i <= 4) << i << " " << j;
  }
}

}  // namespace
}  // namespace semfield
