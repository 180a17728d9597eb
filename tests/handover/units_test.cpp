// One scene in several units: what is found in it, and what files hold of it, is the same but for the unit.
#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <nlohmann/json.hpp>
#include <sstream>

#include "core/small_math.h"
#include "eval/image_output.h"
#include "formats/image_io.h"
#include "handover/point_files.h"
#include "handover/splats.h"
#include "handover/voxel_map.h"
#include "loading/frame_source.h"
#include "loading/packed_scene.h"
#include "objects/object_set.h"
#include "surface/fuse/fusion.h"
#include "surface/fuse/propagation.h"
#include "surface/mesh/score/mesh_score.h"
#include "surface/mesh/shape/simplify.h"
#include "surface/mesh/sights.h"
#include "system/files.h"
#include "testkit/analytic_scene.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

constexpr double kUnits[] = {1e-4, 1e6};
constexpr double kFloat = 1e-6;  // relative, of numbers of 32 bits and what is added to them

// The analytic room, `unit` times as large, whose unit nobody knows.
struct Room {
  double unit;
  LoadedScene scene;
  std::vector<DepthView> views;
  RayLimits limits;

  explicit Room(double unit_of, bool metric = false) : unit(unit_of) {
    Diagnostics diagnostics;
    scene = load_scene(*testkit::make_analytic_scene({.frames = 16}), {}, diagnostics);
    scene.info.metric = metric;
    scene.near_m *= unit;
    scene.far_m *= unit;
    scene.pixel_footprint_m *= unit;
    scene.bounds = {scene.bounds.lo * unit, scene.bounds.hi * unit};
    for (FrameInfo& frame : scene.info.frames) frame.world_from_camera.t = frame.world_from_camera.t * unit;
    for (StoredFrame& frame : scene.frames) {
      std::vector<float> depth = frame.depth_m.expand();
      for (float& z : depth) z = static_cast<float>(z * unit);
      frame.depth_m = DepthMap(std::move(depth));
    }
    limits.near_m = scene.near_m;
    limits.far_m = scene.far_m;
    for (const int f : scene.frames_of(Split::train)) {
      const auto n = static_cast<std::size_t>(f);
      views.push_back(measured_view({scene.info.frames[n].camera, scene.info.frames[n].world_from_camera, false},
                                    scene.frames[n].depth_m));
    }
  }
  Vec3d size() const { return scene.bounds.size(); }
  double longest() const { return std::max({size().x, size().y, size().z}); }
  Surface surface() const { return fused_surface(views, limits, VoxelGrid::covering(scene.bounds, longest() / 40.3)); }
  PointSet points() const {
    PointSet out;
    for (const DepthView& view : views)
      for (std::int64_t i = 0; i < std::ssize(view.map.distance_m); i += 7) {
        const PixelPlace at = strided_place(i, view.map.width_px, view.map.stride);
        out.positions.push_back(point_at(view.camera, {}, at, view.map.distance_m[static_cast<std::size_t>(i)]));
        out.attributes.color.push_back({1, 2, 3});
      }
    return out;
  }
};

const Room& metres() {
  static const Room room(1);
  return room;
}

// The same places, but for the unit.
void expect_same(const std::vector<Vec3d>& found, double unit, const std::vector<Vec3d>& meant, double off) {
  ASSERT_EQ(found.size(), meant.size()) << unit;
  ASSERT_FALSE(found.empty());
  for (std::size_t i = 0; i < found.size(); ++i)
    for (int axis = 0; axis < 3; ++axis) ASSERT_NEAR(found[i][axis] / unit, meant[i][axis], off) << unit << " " << i;
}

TEST(Units, ASurfaceAndItsFilters) {
  Surface meant = metres().surface();
  const Surface whole = meant;
  ASSERT_GT(meant.triangles.size(), 1000U);
  const auto filtered = [](Surface& surface, double unit) {
    const std::size_t holes = close_holes(surface, 2 * unit);
    simplify(surface, surface.triangles.size() / 2);
    return holes;
  };
  const std::size_t holes = filtered(meant, 1);
  for (const double unit : kUnits) {
    const Room room(unit);
    Surface surface = room.surface();
    EXPECT_EQ(surface.triangles, whole.triangles) << unit;
    expect_same(surface.positions, unit, whole.positions, 1e-4);
    std::vector<RayCamera> cameras;
    for (const DepthView& view : room.views) cameras.push_back(view.camera);
    std::size_t seen = 0, wanted = 0;
    const double cell = 1 / 40.3;
    for (const Sights& one : sights_of(surface, cameras, room.limits, cell * room.longest())) seen += one.any();
    cameras.clear();
    for (const DepthView& view : metres().views) cameras.push_back(view.camera);
    for (const Sights& one : sights_of(whole, cameras, metres().limits, cell * metres().longest())) wanted += one.any();
    EXPECT_NEAR(static_cast<double>(seen), static_cast<double>(wanted), 0.002 * static_cast<double>(wanted)) << unit;
    EXPECT_EQ(filtered(surface, unit), holes) << unit;
    EXPECT_EQ(surface.triangles.size(), meant.triangles.size()) << unit;
  }
}

TEST(Units, AMeshIsJudgedWithinTheSameSharesOfAScene) {
  const auto judged = [](const Room& room) {
    const DepthReference reference(room.views, {}, usual_metre(room.scene.info.metric, room.size()));
    return std::pair(reference.points(), reference.score(room.surface()));
  };
  const auto meant = judged(metres());
  EXPECT_GT(meant.second.complete[2], 0.5);
  EXPECT_LT(meant.second.complete[0], meant.second.complete[2]);
  for (const double unit : kUnits) {
    const auto found = judged(Room(unit));
    EXPECT_NEAR(static_cast<double>(found.first), static_cast<double>(meant.first), 0.01 * meant.first) << unit;
    for (std::size_t k = 0; k < 3; ++k) {
      EXPECT_NEAR(found.second.complete[k], meant.second.complete[k], 0.005) << unit;
      EXPECT_NEAR(found.second.accurate[k], meant.second.accurate[k], 0.005) << unit;
    }
  }
}

TEST(Units, AMetreIsOneInARoomAndAShareElsewhere) {
  EXPECT_EQ(usual_metre(true, {4, 3, 2}), 1);
  EXPECT_EQ(usual_metre(true, {40, 3, 2}), 1);
  EXPECT_EQ(usual_metre(true, {0.6, 0.3, 0.3}), 1) << "a shelf";
  EXPECT_EQ(usual_metre(false, {4, 3, 2}), 0.8);
  EXPECT_EQ(usual_metre(true, {4000, 3000, 2000}), 800) << "millimetres that are told as metres";
  EXPECT_EQ(usual_metre(true, {}), 1);
}

template <class T>
T number_at(const std::string& bytes, std::size_t at) {
  T value;
  std::memcpy(&value, bytes.data() + at, sizeof value);
  return value;
}

std::vector<Vec3d> in_las(const std::string& file) {
  std::vector<Vec3d> out;
  const auto at = number_at<std::uint32_t>(file, 96);
  const auto bytes = number_at<std::uint16_t>(file, 105);
  for (std::size_t row = at; row < file.size(); row += bytes) {
    Vec3d p;
    for (int k = 0; k < 3; ++k) {
      const auto n = static_cast<std::size_t>(k);
      p[k] = number_at<std::int32_t>(file, row + 4 * n) * number_at<double>(file, 131 + 8 * n) +
             number_at<double>(file, 155 + 8 * n);
    }
    out.push_back(p);
  }
  return out;
}

// Rows of `bytes` behind a header, which begin with three numbers of kind T.
template <class T>
std::vector<Vec3d> in_rows(const std::string& file, const std::string& end, std::size_t bytes, Vec3d offset) {
  std::vector<Vec3d> out;
  for (std::size_t row = end.empty() ? 0 : file.find(end) + end.size(); row + bytes <= file.size(); row += bytes)
    out.push_back(offset + Vec3d{static_cast<double>(number_at<T>(file, row)),
                                 static_cast<double>(number_at<T>(file, row + sizeof(T))),
                                 static_cast<double>(number_at<T>(file, row + 2 * sizeof(T)))});
  return out;
}

// At its place, and a million sides away from 0, where 32 bits know no place.
TEST(Units, FilesGiveThePointsBack) {
  const TempDir dir;
  const PointSet meant = metres().points();
  for (const double unit : kUnits)
    for (const double away : {0.0, 4012345.0}) {  // no multiple of what offsets are rounded to
      PointSet points = Room(unit).points();
      for (Vec3d& p : points.positions) p = p + Vec3d{away * unit, 0, 0};
      std::vector<Vec3d> places = meant.positions;
      for (Vec3d& p : places) p = p + Vec3d{away, 0, 0};
      const Vec3d offset = offset_of_floats(box_around(points.positions));
      const double off = away > 0 ? 1e-3 : 4 * kFloat;  // doubles so far from 0 are added, and residual offsets
      EXPECT_EQ(length(offset) > 0, away > 0) << unit;
      EXPECT_NEAR(offset.x / unit, away, 1000) << "what is left is small";
      write_las(dir / "a.las", points, {});
      expect_same(in_las(read_text_file(dir / "a.las")), unit, places, off);
      write_pcd(dir / "a.pcd", points, {}, offset);
      expect_same(in_rows<float>(read_text_file(dir / "a.pcd"), "DATA binary\n", 16, offset), unit, places, off);
      write_ply(dir / "a.ply", points, {});
      expect_same(in_rows<double>(read_text_file(dir / "a.ply"), "end_header\n", 27, {}), unit, places, off);
      Splats splats{points, std::vector<float>(points.positions.size(), 0.5F), 0.02 * unit};
      write_splat_ply(dir / "a.splats.ply", splats, {}, offset);
      expect_same(in_rows<float>(read_text_file(dir / "a.splats.ply"), "end_header\n", 68, offset), unit, places, off);
      write_splat(dir / "a.splat", splats, offset);
      expect_same(in_rows<float>(read_text_file(dir / "a.splat"), "", 32, offset), unit, places, off);
    }
}

TEST(Units, FilesGiveTheMeshBack) {
  const TempDir dir;
  for (const double unit : kUnits) {
    Surface surface = Room(unit).surface();
    surface.attributes.color.assign(surface.positions.size(), {9, 9, 9});
    const std::vector<Vec3d> meant = metres().surface().positions;
    write_obj(dir / "a.obj", surface, {});
    std::istringstream lines(read_text_file(dir / "a.obj"));
    std::vector<Vec3d> places;
    for (std::string line; std::getline(lines, line);) {
      Vec3d p;
      if (std::sscanf(line.c_str(), "v %lf %lf %lf", &p.x, &p.y, &p.z) == 3) places.push_back(p);
    }
    expect_same(places, unit, meant, 1e-4);
    write_glb(dir / "a.glb", surface, {}, {});
    const std::string glb = read_text_file(dir / "a.glb");
    const auto json_bytes = number_at<std::uint32_t>(glb, 12);
    const auto accessors = nlohmann::json::parse(glb.substr(20, json_bytes))["accessors"];
    const Box box = box_around(meant);
    for (const auto& accessor : accessors) {
      if (!accessor.contains("min")) continue;
      for (int k = 0; k < 3; ++k) {
        EXPECT_NEAR(accessor["min"][static_cast<std::size_t>(k)].get<double>() / unit, box.lo[k], 1e-4);
        EXPECT_NEAR(accessor["max"][static_cast<std::size_t>(k)].get<double>() / unit, box.hi[k], 1e-4);
      }
    }
  }
}

// The room's depth, rendered.
RenderedFrame rendered(const Room& room, std::size_t view) {
  RenderedFrame frame;
  const auto n = static_cast<std::size_t>(room.scene.frames_of(Split::train)[view]);
  frame.width_px = room.views[view].map.width_px;
  frame.height_px = room.views[view].map.height_px;
  frame.depth_m = room.scene.frames[n].depth_m.expand();
  frame.opacity.assign(frame.depth_m.size(), 1);
  frame.rgb.assign(3 * frame.depth_m.size(), 0.5F);
  frame.label = room.scene.frames[n].label.expand();
  frame.entropy.assign(frame.depth_m.size(), 0);
  return frame;
}

TEST(Units, MapsOfRobotsAndThinnedPoints) {
  const TempDir dir;
  const auto made = [&](const Room& room) {
    const double edge = room.longest() / 30.7, metre = usual_metre(false, room.size());
    VoxelMap map(VoxelGridPlace::covering(
        {room.scene.bounds.lo - Vec3d{edge, edge, edge}, room.scene.bounds.hi + Vec3d{edge, edge, edge}}, edge));
    PointCloud cloud(edge);
    for (std::size_t v = 0; v < room.views.size(); ++v) {
      const RenderedFrame frame = rendered(room, v);
      const SeenPixels seen = seen_pixels(room.views[v].camera, frame);
      map.add(room.views[v].camera, frame, seen);
      cloud.add(frame, seen);
    }
    std::array<std::size_t, 3> states{};
    for (std::size_t cell = 0; cell < map.place().cells(); ++cell) ++states[static_cast<std::size_t>(map.state(cell))];
    write_octomap(dir / "a.bt", map, room.scene.info.classes, false);
    const std::string tree = read_text_file(dir / "a.bt");
    const Costmap costs = costmap_of(map, {0, 0, 1}, {0.1 * metre, metre});
    return std::tuple(states, map.place().count, cloud.points().positions.size(), tree.substr(tree.find("data\n")),
                      costs.cells);
  };
  const auto meant = made(metres());
  EXPECT_GT(std::get<0>(meant)[2], 500U);
  for (const double unit : kUnits) {
    const auto found = made(Room(unit));
    EXPECT_EQ(std::get<0>(found), std::get<0>(meant)) << unit;
    EXPECT_EQ(std::get<1>(found), std::get<1>(meant)) << unit;
    EXPECT_EQ(std::get<2>(found), std::get<2>(meant)) << unit;
    EXPECT_EQ(std::get<3>(found), std::get<3>(meant)) << unit;
    EXPECT_EQ(std::get<4>(found), std::get<4>(meant)) << unit;
  }
}

TEST(Units, SplatsLookTheSame) {
  const auto drawn = [](const Room& room) {
    Splats splats{room.points(), {}, 0.05 * room.unit};
    splats.opacity.assign(splats.points.positions.size(), 0.6F);
    return draw_splats(splats, room.views[0].camera, {0.2, 0.4, 0.6});
  };
  const std::vector<float> meant = drawn(metres());
  for (const double unit : kUnits) {
    const std::vector<float> found = drawn(Room(unit));
    ASSERT_EQ(found.size(), meant.size());
    for (std::size_t i = 0; i < found.size(); ++i) ASSERT_NEAR(found[i], meant[i], 0.01) << unit << " " << i;
  }
}

TEST(Units, LabelsSpreadAndFuse) {
  const auto worth = [](const Room& room) {
    TrainingLabels labels;
    labels.frames.resize(room.scene.frames.size());
    labels.class_pixels.resize(room.scene.frames.size());
    const FrameMaps maps = true_depth(room.scene);
    for (const int f : maps.frames) {
      const auto n = static_cast<std::size_t>(f);
      std::vector<std::int16_t> given = room.scene.frames[n].label.expand();
      for (std::size_t p = 0; p < given.size(); ++p)
        if (p % 17 != 0) given[p] = kVoid;
      labels.class_pixels[n] = {1, 1, 1, 1, 1, 0};
      labels.frames[n].hard = LabelMap(std::move(given));
    }
    std::vector<double> out;
    for (const PropagationMethod method : {PropagationMethod::surface, PropagationMethod::vote}) {
      const TrainingLabels spread = propagate_labels(room.scene, labels, maps, {.method = method}, {});
      for (const int f : maps.frames) {
        std::int64_t labelled = 0;
        for (std::size_t p = 0; p < spread.frames[static_cast<std::size_t>(f)].size(); ++p)
          labelled += spread.frames[static_cast<std::size_t>(f)][p] != kVoid;
        out.push_back(static_cast<double>(labelled));
      }
      for (const auto& [name, value] : spread.steps.back().facts)
        if (name.find("pixels by") == 0 || name == "cells" || name == "connected parts")
          out.push_back(std::stod(value));
    }
    const SceneFusion fused = fuse_scene(room.scene, labels, maps, settled({}, room.scene), {});
    for (const FusionScore& score : fused.scores) {
      out.push_back(1000 * score.confusion.total_accuracy().value());
      out.push_back(1000 * score.views_mean.value());
    }
    return out;
  };
  const std::vector<double> meant = worth(metres());
  for (const double unit : kUnits) {
    const std::vector<double> found = worth(Room(unit));
    ASSERT_EQ(found.size(), meant.size());
    for (std::size_t i = 0; i < found.size(); ++i)
      EXPECT_NEAR(found[i], meant[i], 2 + 0.005 * meant[i]) << unit << " " << i;
  }
  EXPECT_EQ(settled({}, Room(1, true).scene).tolerance, 0.01) << "a centimetre in metres";
  EXPECT_EQ(settled({.tolerance = 0.3}, metres().scene).tolerance, 0.3);
}

TEST(Units, CellsOfASurfaceAndObjects) {
  const auto pooled = [](const Room& room, double away) {
    std::vector<PoolView> views;
    for (std::size_t v = 0; v < room.views.size(); ++v) {
      const int f = room.scene.frames_of(Split::train)[v];
      views.push_back({f, room.views[v].camera, &room.scene.frames[static_cast<std::size_t>(f)], room.views[v].map});
      views.back().camera.world_from_camera.t.x += away * room.unit;
    }
    const SurfacePool pool = make_surface_pool(views, room.limits, 2000);
    std::vector<ObjectRow> rows(1);
    std::vector<Vec3d> position;
    for (const PoolPoint& point : pool.points) position.push_back(point.position);
    const std::vector<std::int32_t> id(position.size(), 1);
    measure_objects(rows, position, id, pool.cell_m());
    return std::pair(static_cast<double>(rows[0].points), rows[0].area / room.unit / room.unit);
  };
  const auto meant = pooled(metres(), 0);
  EXPECT_GT(meant.first, 1000);
  for (const double unit : kUnits) {
    EXPECT_NEAR(pooled(Room(unit), 0).first, meant.first, 0.01 * meant.first) << unit;
    EXPECT_NEAR(pooled(Room(unit), 0).second, meant.second, 0.01 * meant.second) << unit;
  }
  EXPECT_NEAR(pooled(metres(), 5e5).first, meant.first, 0.08 * meant.first) << "far from 0, on another grid";
}

TEST(Units, DepthPictures) {
  const TempDir dir;
  for (const double unit : {1e-4, 1.0, 30.0, 1e6}) {
    const Room room(unit);
    const double step = depth_step(false, room.size());
    const std::vector<float> depth = rendered(room, 0).depth_m;
    EXPECT_EQ(write_depth(dir / "d.png", {48, 36}, depth, step), 0) << unit;
    const auto steps = read_ids(dir / "d.png").pixels;
    for (std::size_t i = 0; i < depth.size(); ++i)
      ASSERT_NEAR(steps[i] * step / unit, static_cast<double>(depth[i]) / unit, 0.00201) << unit;
    EXPECT_NEAR(step / unit, unit == 30 ? 1e-3 / 3 : 1e-3, 1e-12);
  }
  EXPECT_EQ(depth_step(true, {40, 3, 3}), 1e-3) << "millimetres, where metres are known";
  EXPECT_EQ(depth_step(false, {}), 1e-3);
}

TEST(Units, APackedSceneKeepsItsDepth) {
  const TempDir dir;
  for (const double unit : {1e-4, 1.0, 1e6}) {
    const Room room(unit);
    const auto frame_of = [&](int f, FrameBuffer& out) {
      const StoredFrame& frame = room.scene.frames[static_cast<std::size_t>(f)];
      out.width_px = frame.width_px;
      out.height_px = frame.height_px;
      out.rgb = frame.rgb;
      out.depth_m = frame.depth_m.expand();
      out.label = frame.label.expand();
    };
    write_packed_scene(dir / "a.pack", room.scene.info, frame_of);
    FrameBuffer meant, found;
    frame_of(0, meant);
    PackedScene(dir / "a.pack").read(0, found);
    ASSERT_EQ(found.depth_m.size(), meant.depth_m.size());
    for (std::size_t i = 0; i < meant.depth_m.size(); ++i)
      ASSERT_NEAR(found.depth_m[i], meant.depth_m[i], 5.1e-4 * unit) << unit;
  }
}

}  // namespace
}  // namespace semfield
