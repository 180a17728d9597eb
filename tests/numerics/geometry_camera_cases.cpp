// F05 to F09: poses and cameras. They are float64 throughout, so these cases have that row alone.
#include <algorithm>

#include "eval/evaluator.h"
#include "input_parts.h"
#include "loading/frame_source.h"
#include "named_case.h"
#include "scene/camera_path.h"
#include "scene/scene_checks.h"
#include "tests/scene/room_files.h"

namespace semfield::numerics {

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
  namespace fs = std::filesystem;
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
      run.measure(static_cast<double>(std::abs(pose.t[i] - centre)), 1e-14, "camera centre");
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

void bad_pose(CaseRun& run) {
  run.row("float64");
  const std::string root = run.folder();
  testing_room::write_replica(root, 4, 8, 6);
  const auto load = [&](Diagnostics& diagnostics) {
    const auto data = dataset_of(run, "replica", {{"root", root}, {"train_step", "1"}, {"test_step", "0"}});
    return load_scene(*data, {}, diagnostics);
  };
  std::string lines;
  const auto bad = [](const char* word) {
    std::string line;
    for (int i = 0; i < 16; ++i) line += std::string(i < 12 ? word : i == 15 ? "1" : "0") + (i == 15 ? "\n" : " ");
    return line;
  };
  lines = testing_room::pose_line(testing_room::room_pose(0)) + bad("-inf") +
          testing_room::pose_line(testing_room::room_pose(2)) + bad("nan");
  testing_room::plain_write(root + "/traj_w_c.txt", lines);
  Diagnostics diagnostics;
  const LoadedScene scene = load(diagnostics);
  run.expect(!diagnostics.has_errors(), "the scene is loaded without them");
  run.expect(told(diagnostics, Severity::warning, "2 of 4 frames skipped: their poses are not finite (1, 3)"),
             "both are named");
  run.expect(scene.frames.size() == 2, "two frames stay");
  for (std::size_t i = 0; i < scene.info.frames.size(); ++i) {
    const Pose truth = testing_room::room_pose(2 * static_cast<int>(i));
    run.expect(scene.info.frames[i].name == "rgb_" + std::to_string(2 * i), "frames keep their numbers");
    run.measure(length(scene.info.frames[i].world_from_camera.t - truth.t), 1e-12, "camera centre");
  }
  run.expect(std::isfinite(scene.far_m) && std::isfinite(scene.bounds.lo.x) && std::isfinite(scene.bounds.hi.z),
             "bounds and distances are finite");
  testing_room::plain_write(root + "/traj_w_c.txt", bad("-inf") + bad("nan") + bad("inf") + bad("nan"));
  Diagnostics none;
  (void)load(none);
  run.expect(told(none, Severity::error, "all 4 poses are not finite"), "a scene of bad poses alone is an error");
  for (const double value : {std::nan(""), std::numeric_limits<double>::infinity()}) {
    Pose pose;
    pose.t.y = value;
    Diagnostics quiet;
    run.expect(check_pose(pose, "x", quiet) == PoseState::not_finite, "one bad coordinate of the centre is enough");
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

}  // namespace semfield::numerics
