// F01 to F04: rays against boxes. Geometry is float64 throughout, so these cases have that row alone.

#include <algorithm>
#include <cstdlib>

#include "core/small_math.h"
#include "datasets/obj_room/obj_room.h"
#include "eval/evaluator.h"
#include "named_case.h"
#include "rooms.h"
#include "scene/camera.h"
#include "scene/loading/frame_source.h"
#include "surface/mesh/marching_cubes.h"
#include "surface/mesh/mesh_files.h"
#include "tests/scene/room_files.h"

namespace semfield::numerics {

namespace {

const Box kBox{{-1, -2, 0.5}, {3, 1, 2}};

double number(std::uint64_t index) {
  return static_cast<double>(uniform01({7, 0, stream_id("stiff geometry")}, index));
}

// Where a ray that starts in the closed box leaves it.
long double exit_of(const Box& box, Vec3d o, Vec3d d) {
  long double nearest = 1e300L;
  for (int i = 0; i < 3; ++i) {
    if (d[i] == 0) continue;
    const long double face = d[i] > 0 ? box.hi[i] : box.lo[i];
    nearest = std::min(nearest, (face - o[i]) / long_double(d[i]));
  }
  return nearest;
}

// A camera at `o` whose only pixel looks along the unit axis d exactly.
RayCamera looking_along(Vec3d o, int axis, double sign) {
  RayCamera camera{.camera = {.width_px = 1, .height_px = 1, .fx = 1, .fy = 1, .cx = 0.5, .cy = 0.5}};
  Vec3d columns[3];
  columns[2][axis] = sign;
  columns[0][(axis + 1) % 3] = 1;
  columns[1] = cross(columns[2], columns[0]);
  for (int row = 0; row < 3; ++row) {
    for (int col = 0; col < 3; ++col) camera.world_from_camera.r[row][col] = columns[col][row];
  }
  camera.world_from_camera.t = o;
  return camera;
}

RayLimits limits_of(const Box& box) { return RayLimits{.near_m = 0, .far_m = 1e9, .clip = true, .bounds = box}; }

}  // namespace

void box_on_face(CaseRun& run) {
  run.row("float64");
  int rays = 0;
  for (std::uint64_t n = 0; n < 3000; ++n) {
    // Bits of n choose the axes whose coordinate lies on a face (at least one), and on which.
    const unsigned on = 1 + static_cast<unsigned>(n % 7);
    Vec3d o, d;
    for (int i = 0; i < 3; ++i) {
      const bool upper = (n >> (4 + i) & 1) != 0;
      o[i] = kBox.lo[i] + (kBox.hi[i] - kBox.lo[i]) * (0.1 + 0.8 * number(8 * n + static_cast<unsigned>(i)));
      d[i] = 2 * number(8 * n + 3 + static_cast<unsigned>(i)) - 1;
      if ((on >> i & 1) == 0) continue;
      o[i] = upper ? kBox.hi[i] : kBox.lo[i];
      const unsigned kind = static_cast<unsigned>(n >> 7) % 4;  // along the face, -0, tiny, or inwards
      d[i] = kind == 0   ? 0.0
             : kind == 1 ? -0.0
             : kind == 2 ? (upper ? -1e-310 : 1e-310)
                         : (upper ? -1 : 1) * std::abs(d[i]);
    }
    if (d == Vec3d{0, 0, 0}) continue;
    double t_near = -1, t_far = -1;
    run.expect(intersect(kBox, o, d, t_near, t_far), "a ray that starts on a face and does not leave meets the box");
    run.measure(std::abs(t_near), 0, "t_near");
    const long double exit = std::min(exit_of(kBox, o, d), 1e300L);
    run.relative(t_far, exit, 3e-16, "t_far");  // one subtraction, one division
    ++rays;
  }
  // The same through a camera: directions along an axis are exact.
  for (int axis = 0; axis < 3; ++axis) {
    for (const double sign : {1.0, -1.0}) {
      Vec3d o = kBox.center();
      o[(axis + 1) % 3] = kBox.hi[(axis + 1) % 3];
      double origin[3], direction[3], near_far[2];
      cast_ray(looking_along(o, axis, sign), limits_of(kBox), 0, 0, origin, direction, near_far);
      run.near(near_far[1], 0.5 * kBox.size()[axis], 0, "length of a ray in a face");
      run.measure(std::abs(near_far[0]), 0, "its near end");
    }
  }
  run.note(std::to_string(rays) + " rays from faces, edges and corners");
}

void box_parallel_outside(CaseRun& run) {
  run.row("float64");
  for (int axis = 0; axis < 3; ++axis) {
    for (const bool upper : {false, true}) {
      const double face = upper ? kBox.hi[axis] : kBox.lo[axis];
      const double away = upper ? 1e300 : -1e300;
      for (const double place : {std::nextafter(face, away), face + (upper ? 1e-9 : -1e-9), face + (upper ? 1 : -1),
                                 face + (upper ? 1e6 : -1e6)}) {
        for (const double zero : {0.0, -0.0}) {
          for (std::uint64_t n = 0; n < 20; ++n) {
            Vec3d o = kBox.center(), d{2 * number(3 * n) - 1, 2 * number(3 * n + 1) - 1, 2 * number(3 * n + 2) - 1};
            o[axis] = place;
            d[axis] = zero;
            double t_near = 0, t_far = 0;
            run.expect(!intersect(kBox, o, d, t_near, t_far), "a ray beside the slab misses");
          }
        }
        Vec3d o = kBox.center();
        o[axis] = place;
        double origin[3], direction[3], near_far[2] = {1, 1};
        cast_ray(looking_along(o, (axis + 1) % 3, 1), limits_of(kBox), 0, 0, origin, direction, near_far);
        run.expect(near_far[0] == 0 && near_far[1] == 0, "its interval is empty");
      }
    }
  }
}

void box_every_place(CaseRun& run) {
  run.row("float64");
  const Box box{{-1, -1, -1}, {1, 1, 1}};
  struct Ratio {
    std::int64_t over = 0, under = 1;  // under > 0
    bool below(const Ratio& o) const { return over * o.under < o.over * under; }
    double value() const { return static_cast<double>(over) / static_cast<double>(under); }
  };
  int hits = 0, misses = 0;
  for (int place = 0; place < 125; ++place) {
    const std::array<int, 3> o{place % 5 - 2, place / 5 % 5 - 2, place / 25 - 2};
    for (int turn = 0; turn < 54; ++turn) {
      // Signs -1, 0, 1 per axis; the second half has components of 1, 2 and 3.
      const int signs = turn % 27, spread = turn / 27;
      const std::array<int, 3> d{signs % 3 - 1, (signs / 3 % 3 - 1) * (1 + spread), (signs / 9 - 1) * (1 + 2 * spread)};
      if (d == std::array<int, 3>{}) continue;
      bool expected = true;
      Ratio enter{0, 1}, leave{1'000'000, 1};
      for (std::size_t i = 0; i < 3; ++i) {
        if (d[i] == 0) {
          expected = expected && o[i] >= -1 && o[i] <= 1;
          continue;
        }
        const int s = d[i] > 0 ? 1 : -1;
        const Ratio in{(-s - o[i]) * s, std::abs(d[i])}, out{(s - o[i]) * s, std::abs(d[i])};
        if (enter.below(in)) enter = in;
        if (out.below(leave)) leave = out;
      }
      expected = expected && !leave.below(enter);
      double t_near = 0, t_far = 0;
      const bool hit = intersect(box, {double(o[0]), double(o[1]), double(o[2])},
                                 {double(d[0]), double(d[1]), double(d[2])}, t_near, t_far);
      run.expect(hit == expected, "hit or miss as rational numbers tell");
      (expected ? hits : misses) += 1;
      if (!hit || !expected) continue;
      run.near(t_near, enter.value(), 0, "t_near");
      run.near(t_far, leave.value(), 0, "t_far");
    }
  }
  run.note(std::to_string(hits) + " hits, " + std::to_string(misses) + " misses, every one as expected");
}

void box_thin(CaseRun& run) {
  run.row("float64");
  for (unsigned flat = 1; flat < 8; ++flat) {
    Box box{{-1, -1, -1}, {1, 1, 1}};
    for (int i = 0; i < 3; ++i) {
      if ((flat >> i & 1) != 0) box.lo[i] = box.hi[i] = 0.25;
    }
    for (int axis = 0; axis < 3; ++axis) {
      const bool across = (flat >> axis & 1) != 0;
      Vec3d o{0.25, 0.25, 0.25}, d;
      o[axis] = -3;
      d[axis] = 1;
      double t_near = 0, t_far = 0;
      run.expect(intersect(box, o, d, t_near, t_far), "a ray through the middle meets it");
      run.measure(std::abs(t_far - t_near - (across ? 0 : 2)), 0, "length inside");
      double origin[3], direction[3], near_far[2] = {1, 1};
      cast_ray(looking_along(o, axis, 1), limits_of(box), 0, 0, origin, direction, near_far);
      run.expect(across ? near_far[0] == 0 && near_far[1] == 0 : near_far[1] - near_far[0] == 2,
                 "a ray without length inside is an empty ray");
      Vec3d beside = o;
      beside[(axis + 1) % 3] = 1.5;
      run.expect(!intersect(box, beside, d, t_near, t_far), "a ray beside it misses");
    }
    double t_near = 0, t_far = 0;
    run.expect(intersect(box, {-0.75, -0.75, -0.75}, {1, 1, 1}, t_near, t_far), "a diagonal ray meets it");
    run.near(t_near, 1, 0, "its distance");
    run.near(t_far, 1, 0, "where it leaves");
  }
}

// F05 to F09: poses and cameras. They are float64 throughout, so these cases have that row alone.

namespace {

using Matrix = std::array<std::array<long double, 3>, 3>;

Matrix of_quaternion(long double w, long double x, long double y, long double z) {
  const long double size = std::sqrt(w * w + x * x + y * y + z * z);
  w /= size, x /= size, y /= size, z /= size;
  return {{{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
           {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
           {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}}};
}

double worst_difference(const Pose& pose, const Matrix& m, bool transposed = false) {
  double worst = 0;
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) {
      const double off = static_cast<double>(std::abs(pose.r[i][j] - (transposed ? m[j][i] : m[i][j])));
      if (!(off <= worst)) worst = off;
    }
  }
  return worst;
}

double off_orthonormal(const Pose& pose) {
  double worst = 0;
  for (int a = 0; a < 3; ++a) {
    for (int b = 0; b < 3; ++b)
      worst = std::max(worst, std::abs(dot(pose.axis(a), pose.axis(b)) - (a == b ? 1.0 : 0.0)));
  }
  return worst;
}

Pose pose_of(const Matrix& m) {
  Pose pose;
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) pose.r[i][j] = static_cast<double>(m[i][j]);
  }
  return pose;
}

// Every pixel of a radial lens k1, k2 against r_d = r (1 + k1 r^2 + k2 r^4), solved in long double up to the first
// fold.
void lens_fold(CaseRun& run, const Camera& lens, const char* warning) {
  Diagnostics found;
  run.expect(check_camera(lens, "frame 'x'", found) && told(found, Severity::warning, warning), warning);
  const long double k1 = lens.k1, k2 = lens.k2;
  const auto distorted = [&](long double r) { return r * (1 + r * r * (k1 + r * r * k2)); };
  const auto slope = [&](long double r) { return 1 + r * r * (3 * k1 + 5 * r * r * k2); };
  const auto bisected = [](long double low, long double high, const auto& below) {
    for (int i = 0; i < 80; ++i) (below((low + high) / 2) ? low : high) = (low + high) / 2;
    return low;
  };
  const long double fold = bisected(0, 1, [&](long double r) { return slope(r) > 0; }), farthest = distorted(fold);
  const RayCamera camera{lens, {}, true};
  int masked = 0, seen = 0;
  for (int row = 0; row < lens.height_px; ++row) {
    for (int column = 0; column < lens.width_px; ++column) {
      const long double x = (column + 0.5L - lens.cx) / lens.fx, y = (row + 0.5L - lens.cy) / lens.fy;
      const long double r_d = std::hypot(x, y);
      if (std::abs(r_d / farthest - 1) < 1e-5L) continue;  // on the fold the inverse is open
      double origin[3], direction[3], near_far[2] = {1, 1};
      const double cosine = cast_ray(camera, {}, column, row, origin, direction, near_far);
      if (r_d > farthest) {
        ++masked;
        run.expect(cosine == 0 && near_far[0] == 0 && near_far[1] == 0, "a pixel beyond the fold is an empty ray");
        run.expect(direction[2] == 1, "and its direction is still a unit vector");
        continue;
      }
      ++seen;
      const long double r = bisected(0, fold, [&](long double at) { return distorted(at) < r_d; });
      const long double scale = r / r_d, size = std::sqrt(1 + r * r);
      const long double truth[3] = {scale * x / size, scale * y / size, 1 / size};
      // The error of the inverse grows towards the fold as 1 / slope.
      for (std::size_t i = 0; i < 3; ++i)
        run.measure(static_cast<double>(std::abs(direction[i] - truth[i]) * slope(r)), 1e-12, "direction");
    }
  }
  run.expect(masked > 100 && seen > 500, "the image holds both kinds of pixel");
  run.note(std::to_string(masked) + " pixels have no ray, " + std::to_string(seen) + " have one");
}

}  // namespace

void quaternion_scales(CaseRun& run) {
  run.row("float64");
  const std::string root = run.folder();
  fs::create_directories(root + "/sparse");
  fs::create_directories(root + "/images");
  testing_room::plain_write(root + "/sparse/cameras.txt", "1 PINHOLE 4 4 4 4 2 2\n");
  constexpr double kBase[4] = {0.3, -0.5, 0.7, 0.41};
  const std::vector<double> factors{1, -1, 1e-3, 1e3, -1e-3, 1e-100, 1e100, 0};
  std::string images;
  for (std::size_t i = 0; i < factors.size(); ++i) {
    const std::string name = std::string(1, static_cast<char>('a' + i)) + ".png";
    images += std::to_string(i + 1);
    char text[40];
    for (const double q : kBase) {
      std::snprintf(text, sizeof text, " %.17g", q * factors[i]);
      images += text;
    }
    images += " 0.5 -2 3 1 " + name + "\n\n";
    if (i == 0) write_png_rgb(root + "/images/" + name, 4, 4, std::vector<std::uint8_t>(48));
    if (i > 0) fs::copy_file(root + "/images/a.png", root + "/images/" + name);
  }
  testing_room::plain_write(root + "/sparse/images.txt", images);
  const auto open = [&](Diagnostics& diagnostics) {
    return dataset_of(run, "colmap", {{"root", root}, {"test_every", "0"}})->open(diagnostics);
  };
  Diagnostics diagnostics;
  const SceneInfo info = open(diagnostics);
  const Matrix truth = of_quaternion(kBase[0], kBase[1], kBase[2], kBase[3]);
  run.expect(info.frames.size() == factors.size() - 1, "every quaternion but 0 gives a frame");
  for (const FrameInfo& frame : info.frames) {
    const Pose& pose = frame.world_from_camera;
    run.measure(worst_difference(pose, truth, true), 1e-14, "rotation");
    for (int i = 0; i < 3; ++i) {
      const auto c = static_cast<std::size_t>(i);
      const long double centre = -(truth[0][c] * 0.5L - truth[1][c] * 2 + truth[2][c] * 3);
      run.near(pose.t[i], centre, 1e-14, "camera centre");
    }
  }
  run.expect(!diagnostics.has_errors(), "no error for the others");
  run.expect(told(diagnostics, Severity::warning, "1 of 8 frames skipped: their poses are not finite (h)"),
             "the zero quaternion's frame is skipped and named");
  testing_room::plain_write(root + "/sparse/images.txt", "1 0 0 0 0 0 0 0 1 a.png\n\n");
  Diagnostics alone;
  open(alone);
  run.expect(told(alone, Severity::error, "all 1 poses are not finite"), "a model of nothing else is an error");
}

void rotation_check(CaseRun& run) {
  run.row("float64");
  const Matrix truth = of_quaternion(0.3L, -0.5L, 0.7L, 0.41L);
  const auto changed = [&](double skew, double scale, double mirror) {
    Pose pose = pose_of(truth);
    for (auto& row : pose.r) {
      row[0] = scale * mirror * (row[0] + skew * row[1]);
      row[1] *= scale;
      row[2] *= scale;
    }
    return pose;
  };
  const auto check = [&](Pose pose, PoseState state, int errors, int warnings, const char* words) {
    Diagnostics found;
    const double off = off_orthonormal(pose);
    run.expect(check_pose(pose, "frame 'x'", found) == state, std::string("state of: ") + words);
    run.expect(found.error_count() == errors && static_cast<int>(found.all().size()) == errors + warnings,
               std::string("number of findings of: ") + words);
    if (errors + warnings > 0)
      run.expect(found.all()[0].text().find(words) != std::string::npos && found.all()[0].where == "frame 'x'",
                 std::string("words: ") + words);
    if (state != PoseState::good) return;
    run.measure(off_orthonormal(pose), off > 1e-9 ? 1e-15 : 1e-9, "what is accepted is orthonormal");
    // Making it orthonormal moves no axis further than it was off.
    run.measure(worst_difference(pose, truth), 2 * off + 1e-15, "and near what was given");
  };
  check(changed(0, 1, 1), PoseState::good, 0, 0, "sound");
  check(changed(0, 1, -1), PoseState::refused, 1, 0, "mirrors the scene (determinant -1)");
  check(changed(0, 2, 1), PoseState::refused, 1, 0, "3 off orthonormal");
  check(changed(0, 0.5, 1), PoseState::refused, 1, 0, "0.75 off orthonormal");
  check(changed(0, 1e-200, 1), PoseState::refused, 1, 0, "1 off orthonormal");
  check(changed(0, 1e200, 1), PoseState::refused, 1, 0, "off orthonormal");
  check(changed(1.1e-3, 1, 1), PoseState::refused, 1, 0, "0.0011 off orthonormal");
  check(changed(0.9e-3, 1, 1), PoseState::good, 0, 1, "0.0009 off orthonormal and was made orthonormal");
  check(changed(1.1e-5, 1, 1), PoseState::good, 0, 1, "1.1e-05 off orthonormal and was made orthonormal");
  check(changed(0.9e-5, 1, 1), PoseState::good, 0, 0, "below the warning");
  Pose zeros{.r = {}};
  check(zeros, PoseState::refused, 1, 0, "1 off orthonormal");
  // A file of poses to render along holds to the same bound.
  const std::string path = run.folder() + "/path.txt";
  const auto written = [&](const Pose& pose) { testing_room::plain_write(path, testing_room::pose_line(pose)); };
  for (const Pose& bad : {changed(0, 2, 1), changed(0, 1, -1), changed(2e-3, 1, 1), zeros}) {
    written(bad);
    run.expect_error(ErrorKind::data, {"path.txt:1", "not a rotation"},
                     [&] { (void)read_camera_file(path, CameraAxes::right_down_forward); });
  }
  written(changed(1e-4, 1, 1));
  run.measure(off_orthonormal(read_camera_file(path, CameraAxes::right_down_forward).at(0)), 1e-15, "pose file");
}

void rotation_between(CaseRun& run) {
  run.row("float64");
  run.note(
      "poses are data, so there is no exponential map to optimise them by: what turns between rotations is the "
      "path of cameras");
  constexpr long double kPi = 3.14159265358979323846264338327950288L;
  const long double axes[][3] = {{1, 0, 0}, {0, 0, -1}, {0.6L, -0.8L, 0}, {-0.48L, 0.6L, 0.64L}};
  const auto turned = [](const long double(&n)[3], long double angle) {
    const long double s = std::sin(angle / 2);
    return of_quaternion(std::cos(angle / 2), s * n[0], s * n[1], s * n[2]);
  };
  for (const auto& axis : axes) {
    for (const long double angle : {0.0L, 1e-12L, 1e-8L, 1e-4L, 1.0L, kPi - 1e-4L, kPi - 1e-9L, kPi}) {
      const Pose begin = pose_of(turned(axis, 0)), end = pose_of(turned(axis, angle));
      const std::vector<Pose> path = make_smooth_path({begin, end}, 5);
      run.expect(path.size() == 5, "five poses");
      for (const Pose& pose : path) run.measure(off_orthonormal(pose), 1e-14, "off orthonormal");
      run.measure(worst_difference(path[0], turned(axis, 0)), 1e-14, "first pose");
      run.measure(worst_difference(path[4], turned(axis, angle)), 1e-14, "last pose");
      // Half way is half the turn; of half a turn both ways round are the shorter one.
      const double half = worst_difference(path[2], turned(axis, angle / 2));
      const double other = worst_difference(path[2], turned(axis, -angle / 2));
      run.measure(angle == kPi ? std::min(half, other) : half, 1e-14, "half way");
    }
  }
}

void intrinsics(CaseRun& run) {
  run.row("float64");
  Camera good{.width_px = 64, .height_px = 48, .fx = 60, .fy = 60, .cx = 32, .cy = 24};
  const auto check = [&](const Camera& camera, bool accepted, Severity severity, const char* words) {
    Diagnostics found;
    run.expect(check_camera(camera, "frame 'x'", found) == accepted, std::string("verdict on: ") + words);
    run.expect(*words == '\0' ? found.all().empty() : told(found, severity, words), std::string("words: ") + words);
  };
  check(good, true, Severity::note, "");
  const auto with = [&](double Camera::*member, double value) {
    Camera camera = good;
    camera.*member = value;
    return camera;
  };
  check(with(&Camera::fx, 0), false, Severity::error, "focal length is 0 x 60 pixels; it must be positive");
  check(with(&Camera::fy, -60), false, Severity::error, "focal length is 60 x -60 pixels");
  check(with(&Camera::fx, std::nan("")), false, Severity::error, "not finite");
  check(with(&Camera::k3, std::numeric_limits<double>::infinity()), false, Severity::error, "not finite");
  check(with(&Camera::cx, 129), false, Severity::error, "principal point (129, 24) lies far outside");
  check(with(&Camera::cy, -49), false, Severity::error, "lies far outside the image of 64 x 48 pixels");
  check(with(&Camera::cx, 70), true, Severity::note, "");  // outside, yet possible: a cropped image
  Camera empty = good;
  empty.width_px = 0;
  check(empty, false, Severity::error, "image size is 0 x 48");

  // Two lenses that fold. The first has no ray beyond its fold; the second has one again, on a branch that is not the
  // lens: such pixels are masked too.
  lens_fold(run, with(&Camera::k1, -1), "no inverse at 8 of 9 points of the image; such pixels are masked");
  Camera twice = with(&Camera::k1, -0.6);
  twice.k2 = 0.15;
  lens_fold(run, twice, "no inverse at 4 of 9 points of the image; such pixels are masked");
}

// F10 and F11: scenes far from the origin, slivers.

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
    run.near(hit.distance_m, 1, 1e-12, "distance");
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
  for (const Vec3d& n : with_normals.normals) run.near(length(n), 1, 1e-12, "normals are unit vectors");
  run.note(std::to_string(flat) + " of " + std::to_string(surface.triangles.size()) +
           " triangles of an octahedron through grid points have no area");
}

}  // namespace semfield::numerics
