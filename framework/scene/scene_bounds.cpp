// Bounds, near, far and pixel footprint of a scene, from what it holds.
#include <algorithm>
#include <cmath>
#include <cstdio>

#include "core/parallel.h"
#include "scene/ray_check.h"

namespace semfield {

namespace {

struct DepthSurvey {
  Box box;                       ///< of the back-projected points, metres
  std::vector<float> distances;  ///< along the ray
  std::int64_t looked_at = 0, valid = 0;
};

float quantile(std::vector<float>& values, double q) {
  const auto at = static_cast<std::ptrdiff_t>(q * static_cast<double>(values.size() - 1));
  std::nth_element(values.begin(), values.begin() + at, values.end());
  return values[static_cast<std::size_t>(at)];
}

// The outermost 0.1 % of a coordinate over all frames are dropped. `parts` is emptied.
DepthSurvey survey_depth(std::vector<SurveyPoints>& parts) {
  DepthSurvey out;
  for (const SurveyPoints& p : parts) out.looked_at += p.looked_at;
  std::vector<float> SurveyPoints::*const columns[4] = {&SurveyPoints::x, &SurveyPoints::y, &SurveyPoints::z,
                                                        &SurveyPoints::distance};
  parallel_for(4, [&](std::int64_t column) {
    std::vector<float> all;
    for (SurveyPoints& p : parts) {
      std::vector<float>& part = p.*columns[column];
      all.insert(all.end(), part.begin(), part.end());
      part = std::vector<float>();
    }
    if (column == 3) {
      out.distances = std::move(all);
    } else if (!all.empty()) {
      out.box.lo[static_cast<int>(column)] = quantile(all, 0.001);
      out.box.hi[static_cast<int>(column)] = quantile(all, 0.999);
    }
  });
  out.valid = static_cast<std::int64_t>(out.distances.size());
  return out;
}

void include_frustum(Box& box, const FrameInfo& frame, double distance_m) {
  box.include(frame.world_from_camera.t);
  for (int corner = 0; corner < 5; ++corner) {
    const double u = corner == 4 ? 0.5 : corner % 2, v = corner == 4 ? 0.5 : corner / 2;
    const Vec3d d = frame.camera.direction(u * frame.camera.width_px, v * frame.camera.height_px);
    box.include(frame.world_from_camera.apply(d * distance_m));
  }
}

void grow(Box& box, double share) {
  const Vec3d size = box.size();
  const double least = 0.01 * std::max({size.x, size.y, size.z, 1e-6});  // a flat scene still gets a thickness
  for (int a = 0; a < 3; ++a) {
    const double margin = std::max(size[a] * share, least);
    box.lo[a] -= margin;
    box.hi[a] += margin;
  }
}

// What the training frames show: the points of their depth, or their view cones up to far. `from` says which.
Box box_of_data(const LoadedScene& scene, const std::vector<int>& usable, DepthSurvey& survey, std::string& from) {
  const auto include_cones = [&](Box& box, double reach) {
    for (const int i : usable) include_frustum(box, scene.info.frames[static_cast<std::size_t>(i)], reach);
  };
  Box box = survey.box;
  if (survey.valid > 0) {
    from = "depth of " + std::to_string(usable.size()) + " training frames";
    const double covered = static_cast<double>(survey.valid) / static_cast<double>(survey.looked_at);
    if (covered < 0.5) {
      // Too much of the picture has no depth for the points to stand for the scene: what the cameras see counts as
      // well.
      include_cones(box, quantile(survey.distances, 0.98));
      from += " (valid on " + std::to_string(std::lround(covered * 100)) + " % of pixels) and the view cones";
    }
  } else {
    include_cones(box, scene.far_m);
    from = "the view cones of " + std::to_string(usable.size()) + " training cameras up to far";
  }
  grow(box, 0.02);
  return box;
}

std::string short_number(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%.3g", value);
  return text;
}

}  // namespace

Box box_of(const std::vector<double>& corners) {
  Box box;
  box.lo = {corners[0], corners[1], corners[2]};
  box.hi = {corners[3], corners[4], corners[5]};
  return box;
}

std::int32_t survey_step(std::int64_t pixels) {
  constexpr std::int64_t kMostPoints = std::int64_t{1} << 20;
  std::int32_t step = 4;
  while (pixels / (std::int64_t{step} * step) > kMostPoints) step *= 2;
  return step;
}

SurveyPoints survey_frame(const Camera& camera, const Pose& world_from_camera, const FrameBuffer& frame,
                          std::int32_t step) {
  SurveyPoints out;
  for (std::int32_t y = step / 2; y < frame.height_px; y += step) {
    for (std::int32_t x = step / 2; x < frame.width_px; x += step) {
      ++out.looked_at;
      const float depth = frame.depth_m[static_cast<std::size_t>(y) * static_cast<std::size_t>(frame.width_px) +
                                        static_cast<std::size_t>(x)];
      if (!(depth > 0) || !std::isfinite(depth)) continue;
      const Vec3d d = camera.direction(x + 0.5, y + 0.5);
      if (!(d.z > 0)) continue;
      const double t = depth / d.z;
      const Vec3d p = world_from_camera.apply(d * t);
      out.x.push_back(static_cast<float>(p.x));
      out.y.push_back(static_cast<float>(p.y));
      out.z.push_back(static_cast<float>(p.z));
      out.distance.push_back(static_cast<float>(t));
    }
  }
  return out;
}

void derive_extent(LoadedScene& scene, std::vector<SurveyPoints> surveyed, const SceneLoadOptions& options,
                   Diagnostics& diagnostics) {
  std::vector<int> usable;
  for (const int i : scene.frames_of(Split::train)) {
    if (scene.frames[static_cast<std::size_t>(i)].width_px > 0) usable.push_back(i);
  }
  if (usable.empty()) {
    if (!diagnostics.has_errors())
      diagnostics.error(scene.info.name, "no training frame", "check the split parameters of the dataset");
    return;
  }
  DepthSurvey survey = survey_depth(surveyed);
  const bool has_depth = survey.valid > 0;
  Box cameras;
  for (const int i : usable) cameras.include(scene.info.frames[static_cast<std::size_t>(i)].world_from_camera.t);

  // Far: asked for, told by the dataset, seen in depth, or twice the walk of the camera.
  scene.near_m = options.near_m > 0 ? options.near_m : scene.info.near_hint_m;
  scene.far_m = options.far_m > 0 ? options.far_m : scene.info.far_hint_m;
  scene.near_far_from = options.near_m > 0 && options.far_m > 0 ? "the configuration"
                        : scene.near_m > 0 && scene.far_m > 0   ? "the dataset"
                                                                : "";
  if (scene.far_m <= 0) {
    const double walk = length(cameras.size());
    scene.far_m = has_depth ? 1.05 * quantile(survey.distances, 0.999) : walk > 0 ? 2 * walk : 10.0;
    scene.near_far_from = has_depth  ? "depth of the training frames"
                          : walk > 0 ? "twice the extent of the cameras"
                                     : "a guess (one camera place, no depth)";
    if (!has_depth) {
      diagnostics.warning(
          "scene.load.far_m",
          "no depth and no far distance given; far is " + short_number(scene.far_m) + " (" + scene.near_far_from + ")",
          "set scene.load.far_m if parts of the scene are missing");
    }
  }
  if (scene.near_m <= 0) {
    scene.near_m =
        has_depth ? std::min(0.5 * quantile(survey.distances, 0.001), 0.5 * scene.far_m) : 0.01 * scene.far_m;
    if (scene.near_far_from.empty()) scene.near_far_from = has_depth ? "depth of the training frames" : "1 % of far";
  }
  // Where both are asked for, validate() compares them. Where one is, it may lie beyond what the other was derived to
  // be.
  const bool both_given = options.near_m > 0 && options.far_m > 0;
  if (!both_given && (!(scene.near_m < scene.far_m) || !std::isfinite(scene.far_m))) {
    diagnostics.error("scene.load.near_m",
                      "near is " + short_number(scene.near_m) + " m and far is " + short_number(scene.far_m) +
                          " m: no part of a ray lies between them",
                      "set scene.load.near_m below scene.load.far_m");
  }

  std::string seen_in;
  const Box seen = box_of_data(scene, usable, survey, seen_in);
  if (options.bounds.size() == 6) {
    scene.bounds = box_of(options.bounds);
    scene.bounds_from = "the configuration";
  } else if (!scene.info.bounds.empty()) {
    scene.bounds = scene.info.bounds;
    scene.bounds_from = "the dataset";
  } else {
    scene.bounds = seen;
    scene.bounds_from = seen_in;
  }
  if (options.check_geometry && scene.near_m < scene.far_m)
    check_rays(scene, usable, {seen, survey.distances, scene.bounds_from == seen_in}, diagnostics);

  std::vector<float> focal;
  for (const int i : usable)
    focal.push_back(static_cast<float>(scene.info.frames[static_cast<std::size_t>(i)].camera.fx));
  const double middle = has_depth ? quantile(survey.distances, 0.5) : 0.5 * (scene.near_m + scene.far_m);
  scene.pixel_footprint_m = middle / quantile(focal, 0.5);
  // Float positions have a step of 2^-24 of their size: far from the origin that step eats into a pixel.
  double largest = 0;
  for (int a = 0; a < 3; ++a) largest = std::max({largest, std::abs(scene.bounds.lo[a]), std::abs(scene.bounds.hi[a])});
  if (largest * 0x1p-24 > 1e-3 * scene.pixel_footprint_m) {
    diagnostics.warning("scene",
                        "coordinates reach " + short_number(largest) + ", where single precision steps by " +
                            short_number(largest * 0x1p-23) + " against a pixel of " +
                            short_number(scene.pixel_footprint_m),
                        "move the origin of the poses near the scene");
  }
}

}  // namespace semfield
