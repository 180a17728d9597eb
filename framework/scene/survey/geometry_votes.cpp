// Pairs of neighbouring frames, and depth warped between them.
#include "scene/survey/geometry_votes.h"

#include <algorithm>
#include <cmath>
#include <set>

#include "compute/parallel.h"

namespace semfield {

namespace {

constexpr std::int32_t kDepthSide = 96;
constexpr std::size_t kPoints = 600;  // of a frame, warped into each neighbour
constexpr std::size_t kFewestLanded = 30;
constexpr int kAnchors = 24;
constexpr double kWidestAngle = 60;  // degrees; beyond it two frames show different sides of things
constexpr double kWidestOfFew = 85;  // and from a right angle on hardly the same ones

double angle_deg(const Pose& a, const Pose& b) {
  double trace = 0;
  for (int c = 0; c < 3; ++c) trace += dot(a.axis(c), b.axis(c));
  return std::acos(std::clamp(0.5 * (trace - 1), -1.0, 1.0)) * 180 / M_PI;
}

float median(std::vector<float>& values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

// Between four pixels of one surface; 0 at edges, where depth is invalid, and outside.
double depth_at(const SmallFrame& frame, double u, double v) {
  const double x = u - 0.5, y = v - 0.5;
  const std::int32_t width = frame.camera.width_px;
  if (!(x >= 0 && y >= 0 && x < width - 1 && y < frame.camera.height_px - 1)) return 0;
  const auto column = static_cast<std::int32_t>(x), row = static_cast<std::int32_t>(y);
  const float* p = frame.depth_m.data() + static_cast<std::ptrdiff_t>(row) * width + column;
  const auto [least, most] = std::minmax({p[0], p[1], p[width], p[width + 1]});
  if (!(least > 0) || most > 1.1f * least) return 0;
  const double a = x - column, b = y - row;
  return (1 - b) * ((1 - a) * p[0] + a * p[1]) + b * ((1 - a) * p[width] + a * p[width + 1]);
}

// Median of |depth - depth there| / max(depth, depth there) of the points of `a` that land on a surface of `b`; 2 where
// too few do. `scale` multiplies the depth of both.
float warp(const SmallFrame& a, const SmallFrame& b, const Pose& b_from_a, double scale, std::vector<float>& errors) {
  errors.clear();
  for (std::size_t i = 0; i < a.points.size(); ++i) {
    const Vec3d q = b_from_a.apply(a.points[i] * (a.point_depths[i] * scale));
    if (!b.camera.sees(q)) continue;
    const double own = b.camera.depth_of(q);
    double u = 0, v = 0;
    b.camera.project(q, u, v);
    const double there = depth_at(b, u, v) * scale;
    if (there > 0) errors.push_back(static_cast<float>(std::abs(own - there) / std::max(own, there)));
  }
  return errors.size() < std::max(kFewestLanded, a.points.size() / 20) ? 2.0f : median(errors);
}

}  // namespace

std::vector<PoseConvention> conventions(const PoseConvention& given) {
  std::vector<PoseConvention> out;
  for (const bool invert : {false, true}) {
    for (const bool flip : {false, true}) {
      PoseConvention convention = given;
      convention.flip_camera_axes = given.flip_camera_axes != flip;
      convention.invert_poses = given.invert_poses != invert;
      out.push_back(convention);
    }
  }
  return out;
}

Pose relative_pose(const SceneInfo& as_opened, const PoseConvention& convention, std::size_t to, std::size_t from) {
  const Pose a = converted_pose(as_opened.frames[from].world_from_camera, convention, as_opened.opengl_files);
  const Pose b = converted_pose(as_opened.frames[to].world_from_camera, convention, as_opened.opengl_files);
  Pose out;
  for (std::size_t col = 0; col < 3; ++col) {
    const Vec3d axis = b.unrotate(a.axis(static_cast<int>(col)));
    for (std::size_t row = 0; row < 3; ++row) out.r[row][col] = axis[static_cast<int>(row)];
  }
  out.t = b.apply_inverse(a.t);
  return out;
}

SmallFrame small_depth_frame(const Camera& camera, const FrameBuffer& frame) {
  SmallFrame out;
  const double scale = std::min(1.0, static_cast<double>(kDepthSide) / std::max(camera.width_px, camera.height_px));
  const auto width = static_cast<std::int32_t>(std::max(1L, std::lround(camera.width_px * scale)));
  const auto height = static_cast<std::int32_t>(std::max(1L, std::lround(camera.height_px * scale)));
  out.camera = camera.resized(width, height);
  std::vector<std::size_t> valid;
  for (std::int64_t y = 0; y < height; ++y) {
    const std::int64_t row = (2 * y + 1) * camera.height_px / (2 * std::int64_t{height});
    for (std::int64_t x = 0; x < width; ++x) {
      const std::int64_t column = (2 * x + 1) * camera.width_px / (2 * std::int64_t{width});
      const float depth = frame.depth_m[static_cast<std::size_t>(row * camera.width_px + column)];
      if (depth > 0 && std::isfinite(depth)) valid.push_back(out.depth_m.size());
      out.depth_m.push_back(depth > 0 && std::isfinite(depth) ? depth : 0);
    }
  }
  const std::size_t taken = std::min(valid.size(), kPoints);
  for (std::size_t k = 0; k < taken; ++k) {
    const std::size_t i = valid[k * valid.size() / taken];
    const auto at = static_cast<std::int64_t>(i);
    const Vec3d d = out.camera.direction(static_cast<double>(at % width) + 0.5, static_cast<double>(at / width) + 0.5);
    const double share = out.camera.depth_of(d);
    if (!(share > 0)) continue;
    out.points.push_back(d * (1 / share));
    out.point_depths.push_back(out.depth_m[i]);
  }
  return out;
}

FramePairs choose_pairs(const SceneInfo& as_opened, const std::vector<Camera>& cameras) {
  std::vector<int> usable;
  for (std::size_t i = 0; i < cameras.size(); ++i) {
    if (cameras[i].width_px > 0) usable.push_back(static_cast<int>(i));
  }
  const std::size_t count = usable.size(), anchors = std::min<std::size_t>(count, kAnchors);
  std::vector<Pose> poses[2];  // as given, and inverted
  double extent[2] = {};
  for (const int inverted : {0, 1}) {
    Box centres;
    PoseConvention convention;
    convention.invert_poses = inverted == 1;
    for (const int i : usable) {
      poses[inverted].push_back(converted_pose(as_opened.frames[static_cast<std::size_t>(i)].world_from_camera,
                                               convention, as_opened.opengl_files));
      centres.include(poses[inverted].back().t);
    }
    if (count > 0) extent[inverted] = std::max(1e-300, length(centres.size()));
  }
  std::set<std::pair<int, int>> pairs;
  for (std::size_t k = 0; k < anchors; ++k) {
    const std::size_t a = k * count / anchors;
    const auto angle = [&](std::size_t b) { return angle_deg(poses[0][a], poses[0][b]); };
    const auto add = [&](std::size_t b) {
      if (b < count && b != a && angle(b) <= kWidestAngle) pairs.insert(std::minmax(usable[a], usable[b]));
    };
    add(a + 1);
    // The next in order that has turned enough for the axes to show.
    std::size_t turned = a + 1;
    while (turned < std::min(count, a + 64) && angle(turned) < 5) ++turned;
    add(turned);
    // By pose: not the nearest, which shows nothing, but one some 6 degrees or a tenth of the walk away.
    for (const int inverted : {0, 1}) {
      std::size_t best = a;
      double least = 1e300;
      for (std::size_t b = 0; b < count; ++b) {
        if (b == a) continue;
        const double away = length(poses[inverted][a].t - poses[inverted][b].t) / extent[inverted];
        const double off = std::abs(angle(b) / 20 + 3 * away - 0.3);
        if (off < least) {
          least = off;
          best = b;
        }
      }
      add(best);
    }
  }
  return {pairs.begin(), pairs.end()};
}

FramePairs wide_pairs(const SceneInfo& as_opened, const std::vector<Camera>& cameras) {
  FramePairs pairs;
  if (cameras.size() > kAnchors) return pairs;
  for (std::size_t b = 0; b < cameras.size(); ++b) {
    for (std::size_t a = 0; a < b; ++a) {
      if (cameras[a].width_px == 0 || cameras[b].width_px == 0) continue;
      if (angle_deg(as_opened.frames[a].world_from_camera, as_opened.frames[b].world_from_camera) <= kWidestOfFew)
        pairs.emplace_back(static_cast<int>(a), static_cast<int>(b));
    }
  }
  return pairs;
}

DepthTallies vote_by_depth(const SceneInfo& as_opened, const std::vector<SmallFrame>& frames, const FramePairs& pairs,
                           const PoseConvention& given) {
  const std::vector<PoseConvention> turned = conventions(given);
  std::vector<Tally> all;
  const auto add = [&](std::size_t axes, double depth_scale) {
    PoseConvention convention = turned[axes];
    convention.depth_scale *= depth_scale;
    all.push_back({convention, axes, 0, 1});
  };
  for (const double scale : {1.0, 1000.0, 0.001}) {
    for (std::size_t c = 0; c < turned.size(); ++c) add(c, scale);
  }
  // 5000, 4000 and 6553.5 steps a metre, and tenths and hundredths.
  for (const double scale : {0.2, 0.25, 1 / 6.5535, 0.1, 0.01, 10.0, 100.0}) add(0, scale);
  const std::size_t read = all.size();
  for (std::size_t c = 0; c < turned.size(); ++c) add(c, 1e6);

  std::vector<std::vector<float>> votes(pairs.size());  // [pair][tally]
  parallel_for(std::ssize(pairs), [&](std::int64_t p) {
    const auto i = static_cast<std::size_t>(pairs[static_cast<std::size_t>(p)].first);
    const auto j = static_cast<std::size_t>(pairs[static_cast<std::size_t>(p)].second);
    std::vector<float> errors;
    for (const Tally& tally : all) {
      const double scale = tally.convention.depth_scale / given.depth_scale;
      const float forth = warp(frames[i], frames[j], relative_pose(as_opened, tally.convention, j, i), scale, errors);
      const float back = warp(frames[j], frames[i], relative_pose(as_opened, tally.convention, i, j), scale, errors);
      // Where one direction alone lands, it speaks for the pair.
      votes[static_cast<std::size_t>(p)].push_back(std::max(forth, back) <= 1 ? std::max(forth, back)
                                                                              : std::min(forth, back));
    }
  });
  for (std::size_t m = 0; m < all.size(); ++m) {
    std::vector<float> landed;
    for (const std::vector<float>& pair : votes) {
      if (pair[m] <= 1) landed.push_back(pair[m]);
    }
    all[m].pairs = static_cast<int>(landed.size());
    if (!landed.empty()) all[m].error = median(landed);
  }
  const auto end_of_read = all.begin() + static_cast<std::ptrdiff_t>(read);
  return {{all.begin(), end_of_read}, {end_of_read, all.end()}};
}

}  // namespace semfield
