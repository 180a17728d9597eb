// F10 to F12: scenes far from the origin, slivers, broken meshes.
#include <algorithm>

#include "box_room.h"
#include "datasets/obj_room/mesh_io.h"
#include "datasets/obj_room/raycast.h"
#include "named_case.h"
#include "surface/mesh/marching_cubes.h"
#include "surface/mesh/mesh_files.h"
#include "tests/scene/room_files.h"

namespace semfield::numerics {

namespace {

constexpr const char* kThree = "v 0 0 0\nv 1 0 0\nv 0 1 0\n";

bool finite(Vec3d v) { return std::isfinite(v.x) && std::isfinite(v.y) && std::isfinite(v.z); }

}  // namespace

void far_origin(CaseRun& run) {
  run.row("float64");
  // The bound: a step of single precision, 2^-24 |x|, against a thousandth of a pixel.
  const auto warned = [&](double shift_m, double& footprint_m, double& reach_m) {
    Diagnostics diagnostics;
    const auto room = shifted_room({shift_m, 0, 0});
    const LoadedScene scene = load_scene(*room, {}, diagnostics);
    footprint_m = scene.pixel_footprint_m;
    reach_m = std::max(std::abs(scene.bounds.hi.x), std::abs(scene.bounds.lo.x));
    run.expect(!diagnostics.has_errors(), "the scene is read");
    return std::any_of(diagnostics.all().begin(), diagnostics.all().end(), [](const Diagnostic& d) {
      return d.severity == Severity::warning && d.text().find("move the origin of the poses") != std::string::npos;
    });
  };
  double footprint = 0, reach = 0;
  run.expect(!warned(0, footprint, reach), "no warning at the origin");
  const double bound = 1e-3 * footprint * 0x1p24;
  run.note("warns beyond " + std::to_string(std::lround(bound)) + " m for pixels of " +
           std::to_string(footprint * 1000).substr(0, 4) + " mm");
  for (const double share : {0.1, 0.9, 1.1, 10.0, 1e6 / bound}) {
    const double shift = share * bound;
    const bool said = warned(shift, footprint, reach);
    run.expect(said == (0x1p-24 * reach > 1e-3 * footprint), "a warning exactly beyond the bound");
    run.expect(said == (share > 1), "as the distance of the scene tells");
  }
  // Rendering: positions are float64 up to the encoder, so a room 2^20 m away gives the picture of the room itself.
  for (const char* passes : {kHashPass, kFrequencyPass}) {
    const std::string yaml = std::string("scene: {type: box_room}\n") + passes;
    const std::vector<float> near = render_room_frame(run.registry(), yaml, {0, 0, 0});
    const std::vector<float> far = render_room_frame(run.registry(), yaml, {0x1p20, -0x1p20, 0x1p19});
    run.expect(near.size() == far.size() && !near.empty(), "two pictures");
    double worst = 0;
    for (std::size_t i = 0; i < near.size(); ++i)
      worst = std::max(worst, static_cast<double>(std::abs(near[i] - far[i])));
    run.measure(worst, 1e-6, "colour of a pixel");
  }
}

void slivers(CaseRun& run) {
  run.row("float64");
  if (!raycast_available()) return run.absent("this build reads no meshes");
  const std::string path = run.folder() + "/slivers.obj";
  Diagnostics diagnostics;
  const auto load = [&](const std::string& faces) {
    testing_room::plain_write(path, std::string(kThree) + faces);
    return load_obj(path, diagnostics);
  };
  // One good face; no area: a corner twice, all corners one, three in line, a line within rounding; and the good one
  // again, forwards and backwards, which has area and stays.
  const TriangleMesh mesh =
      load("v 2 0 0\nv 1 1e-12 0\nv 0.5 1e-12 0\nf 1 2 3\nf 1 1 2\nf 3 3 3\nf 1 2 4\nf 1 2 6\nf 1 2 3\nf 3 2 1\n");
  run.expect(mesh.zero_area_skipped == 4, "four faces without area are skipped");
  run.expect(mesh.size() == 3, "three with area stay");
  run.expect(!diagnostics.all().empty() &&
                 diagnostics.all().back().text().find("skipped 4 faces without area") != std::string::npos,
             "and are counted in a note");
  // An area of 1e-12 that is a small triangle, not a line, stays: the rule is relative to its size.
  const TriangleMesh tiny = load("v 1e-6 0 0\nv 0 2e-6 0\nf 1 4 5\n");
  run.expect(tiny.zero_area_skipped == 0 && tiny.size() == 1, "a tiny triangle of sound shape stays");
  run.expect_error(ErrorKind::data, {"holds no triangle"}, [&] { (void)load("f 1 1 2\nf 2 2 2\n"); });

  const Raycaster rays(mesh);
  int hits = 0;
  for (int i = 0; i < 200; ++i) {
    const double x = 0.005 * i, y = 0.003 * ((7 * i) % 200);
    const RayHit hit = rays.trace({x, y, 1}, {0, 0, -1});
    const bool inside = x + y < 1 - 1e-6 && x > 0 && y > 0;
    if (inside) run.expect(hit.hit(), "the face given three times is met");
    if (!hit.hit()) continue;
    ++hits;
    run.measure(std::abs(hit.distance_m - 1), 1e-12, "distance");
    run.expect(std::isfinite(hit.b1) && std::isfinite(hit.b2), "barycentric weights are finite");
  }
  run.expect(hits > 100, "rays were cast");

  // A surface that passes through grid points exactly: triangles shrink to points, normals stay unit vectors.
  const VoxelGrid grid{{-1, -1, -1}, 0.5, 5, 5, 5};
  const Surface surface = marching_cubes(grid, 1.0, [&](std::int64_t z, std::span<double> values) {
    for (std::size_t i = 0; i < values.size(); ++i) {
      const Vec3d p = grid.world({double(i % 5), double(i / 5), double(z)});
      values[i] = 2 - std::abs(p.x) - std::abs(p.y) - std::abs(p.z);  // 1 on the octahedron through grid points
    }
  });
  Surface with_normals = surface;
  set_vertex_normals(with_normals);
  int flat = 0;
  for (const Triangle& t : surface.triangles) {
    const Vec3d a = surface.positions[t[0]];
    if (length(cross(surface.positions[t[1]] - a, surface.positions[t[2]] - a)) < 1e-12) ++flat;
  }
  run.expect(!surface.triangles.empty(), "the octahedron has a surface");
  for (const Vec3d& p : surface.positions) {
    run.expect(finite(p), "vertices are finite");
    run.measure(std::abs(std::abs(p.x) + std::abs(p.y) + std::abs(p.z) - 1), 1e-12, "vertices lie on it");
  }
  for (const Vec3d& n : with_normals.normals) run.measure(std::abs(length(n) - 1), 1e-12, "normals are unit vectors");
  run.note(std::to_string(flat) + " of " + std::to_string(surface.triangles.size()) +
           " triangles of an octahedron through grid points have no area");
}

void bad_meshes(CaseRun& run) {
  run.row("-");
  if (!raycast_available()) return run.absent("this build reads no meshes");
  run.note("OBJ is what is read; a PLY is written, never read");
  const std::string path = run.folder() + "/bad.obj";
  const std::string three = kThree;
  const struct {
    std::string text;
    std::vector<std::string> words;
  } kBad[] = {
      {three + "o chair\nf 1 2 4\n", {":5: ", "object 'chair'", "vertex 4 of 3"}},
      {three + "f 1 2 -4\n", {":4: ", "vertex -4 of 3"}},
      {three + "f 0 1 2\n", {":4: ", "indices start at 1"}},
      {three + "f 1 2 2147483647\n", {":4: ", "vertex 2147483647 of 3"}},
      {three + "f 1 2 -2147483648\n", {":4: ", "vertex -2147483648 of 3"}},
      {three + "f 1 2 4294967297\n", {":4: ", "is not an index"}},
      {three + "vt 0 0\nf 1/1 2/2 3/1\n", {":5: ", "texture coordinate 2 of 1"}},
      {three + "vn 0 0 1\nf 1//1 2//1 3//-2\n", {":5: ", "normal -2 of 1"}},
      {"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", {":2: ", "'nan' is not a finite number"}},
      {"v 0 -inf 0\n", {":1: ", "'-inf' is not a finite number"}},
      {"v 1e39 0 0\n", {":1: ", "'1e39' is not a finite number"}},
      {three + "f 1 2\n", {":4: ", "face has 2 corners"}},
      {three, {"holds no triangle"}},
      {"", {"holds no triangle"}},
      {"ply\nformat ascii 1.0\nelement vertex 4294967295\nproperty list int int x\nend_header\n",
       {"holds no triangle"}},
  };
  for (const auto& bad : kBad) {
    testing_room::plain_write(path, bad.text);
    std::vector<std::string> words = bad.words;
    words.push_back(path);
    Diagnostics diagnostics;
    run.expect_error(ErrorKind::data, words, [&] { (void)load_obj(path, diagnostics); });
  }
  // A field that gives NaN has no surface.
  for (const double value : {std::nan(""), std::numeric_limits<double>::quiet_NaN()}) {
    run.expect_error(ErrorKind::data, {"not a number"}, [&] {
      (void)marching_cubes({{0, 0, 0}, 1, 3, 3, 3}, 0.5, [&](std::int64_t z, std::span<double> values) {
        std::fill(values.begin(), values.end(), 0.0);
        if (z == 1) values[4] = value;
      });
    });
  }
  run.expect_error(ErrorKind::usage, {}, [] { (void)VoxelGrid::covering({}, 0.1); });
  run.expect_error(ErrorKind::usage, {}, [] { (void)VoxelGrid::covering({{0, 0, 0}, {1, 1, 1}}, 0); });
  run.expect_error(ErrorKind::usage, {}, [] { (void)VoxelGrid::covering({{0, 0, 0}, {1, 1, 1}}, 1e-9); });
}

}  // namespace semfield::numerics
