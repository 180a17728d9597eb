// Bounds, near, far and pixel footprint of a scene, from what it holds.
#include <algorithm>
#include <cmath>
#include <cstdio>

#include "compute/parallel.h"
#include "loading/frame_source.h"
#include "loading/posed_photographs.h"

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

// The outermost `lost` of a coordinate over all frames are dropped. `parts` is emptied.
DepthSurvey survey_depth(std::vector<SurveyPoints>& parts, double lost = 0.001) {
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
      out.box.lo[static_cast<int>(column)] = quantile(all, lost);
      out.box.hi[static_cast<int>(column)] = quantile(all, 1 - lost);
    }
  });
  out.valid = static_cast<std::int64_t>(out.distances.size());
  return out;
}

void include_frustum(Box& box, const FrameInfo& frame, double distance_m) {
  box.include(frame.world_from_camera.t);
  if (frame.camera.is_wide()) {  // it may see all around
    for (const double side : {-distance_m, distance_m})
      box.include(frame.world_from_camera.t + Vec3d{side, side, side});
    return;
  }
  for (int corner = 0; corner < 5; ++corner) {
    const double u = corner == 4 ? 0.5 : corner % 2, v = corner == 4 ? 0.5 : corner / 2;
    const Vec3d d = frame.camera.direction(u * frame.camera.width_px, v * frame.camera.height_px);
    box.include(frame.world_from_camera.apply(d * distance_m));
  }
}

// `away`: how far off it is seen, which stands for the size of a single point.
void grow(Box& box, double share, double away) {
  const Vec3d size = box.size();
  const double longest = std::max({size.x, size.y, size.z});
  const double least = 0.01 * (longest > 0 ? longest : away);  // a flat scene still gets a thickness
  for (int a = 0; a < 3; ++a) {
    const double margin = std::max(size[a] * share, least);
    box.lo[a] -= margin;
    box.hi[a] += margin;
  }
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
      const double share = camera.depth_of(d);
      if (!(share > 0)) continue;
      const double t = depth / share;
      const Vec3d p = world_from_camera.apply(d * t);
      out.x.push_back(static_cast<float>(p.x));
      out.y.push_back(static_cast<float>(p.y));
      out.z.push_back(static_cast<float>(p.z));
      out.distance.push_back(static_cast<float>(t));
    }
  }
  return out;
}

namespace {

constexpr std::size_t kFewestCorners = 100;
constexpr double kCornerMargin = 0.15;  // they are sparse: too small costs more than too large
constexpr const char* kCornersFrom = "corners found again in training frames";

double middle_of(const SurveyPoints& points) {
  std::vector<float> distances = points.distance;
  return quantile(distances, 0.5);
}

// What the derivation of one scene knows.
struct Evidence {
  std::vector<int> usable;  ///< training frames that could be read
  Cameras cameras;          ///< theirs
  DepthSurvey survey;
  bool has_depth = false;
  double covered = 0;                     ///< share of the pixels looked at that have depth
  std::optional<SurveyedExtent> corners;  ///< of scenes that neither depth nor a plain background tells of
};

Box box_of_cameras(const Cameras& cameras) {
  Box box;
  for (const FrameInfo* camera : cameras) box.include(camera->world_from_camera.t);
  return box;
}

// Least and greatest distance from a camera to the box; 0 where one stands in it.
void distances_to(const Box& box, const Cameras& cameras, double& nearest, double& farthest) {
  nearest = 1e300;
  farthest = 0;
  for (const FrameInfo* camera : cameras) {
    const Vec3d eye = camera->world_from_camera.t;
    Vec3d out, across;
    for (int a = 0; a < 3; ++a) {
      out[a] = std::max({box.lo[a] - eye[a], eye[a] - box.hi[a], 0.0});
      across[a] = std::max(eye[a] - box.lo[a], box.hi[a] - eye[a]);
    }
    nearest = std::min(nearest, length(out));
    farthest = std::max(farthest, length(across));
  }
}

// With space outside contracted: about what the cameras see together or, where they look outward, where they stand.
Box cube_of_subject(const CameraRig& rig, const Cameras& cameras) {
  const Box around = rig.inward ? rig.seen : box_of_cameras(cameras);
  const Vec3d size = around.size();
  const double widest = std::max({size.x, size.y, size.z});
  const double half = widest > 0 ? 0.5 * widest : 1;
  return {around.center() - Vec3d{half, half, half}, around.center() + Vec3d{half, half, half}};
}

// Far: asked for, told by the dataset, seen in depth, behind the object, or a multiple of the cameras' walk: too far
// costs less than too near, which cuts the scene.
void derive_distances(LoadedScene& scene, Evidence& seen, const SceneLoadOptions& options) {
  constexpr double kWalks = 4, kReach = 64;
  scene.near_m = options.near_m > 0 ? options.near_m : scene.info.near_hint_m;
  scene.far_m = options.far_m > 0 ? options.far_m : scene.info.far_hint_m;
  if (options.contracted && !(options.far_m > 0)) {
    const Vec3d size = cube_of_subject(scene.rig, seen.cameras).size();
    scene.far_m = kReach * size.x;
    if (scene.near_m <= 0) scene.near_m = 0.05 * (scene.rig.inward ? scene.rig.distance_m : size.x);
    scene.near_far_from = "contraction: far is " + short_number(kReach) + " times the bounds";
    return;
  }
  scene.near_far_from = options.near_m > 0 && options.far_m > 0 ? "the configuration"
                        : scene.near_m > 0 && scene.far_m > 0   ? "the dataset"
                                                                : "";
  double to_object = 0, behind_object = 0;
  if (scene.plain_background) distances_to(scene.plain_background->object, seen.cameras, to_object, behind_object);
  if (scene.far_m <= 0) {
    const double walk = length(box_of_cameras(seen.cameras).size());
    const bool object = scene.plain_background.has_value();
    scene.far_m = seen.has_depth ? 1.05 * quantile(seen.survey.distances, 0.999)
                  : object       ? 1.05 * behind_object
                  : seen.corners ? seen.corners->far_m
                  : walk > 0     ? kWalks * walk
                                 : 10.0;
    scene.near_far_from = seen.has_depth ? "depth of the training frames"
                          : object       ? "the object's silhouettes"
                          : seen.corners ? kCornersFrom
                          : walk > 0     ? "four times the extent of the cameras"
                                         : "a guess (one camera place, no depth)";
  }
  if (scene.near_m <= 0) {
    scene.near_m = seen.has_depth  ? std::min(0.5 * quantile(seen.survey.distances, 0.001), 0.5 * scene.far_m)
                   : to_object > 0 ? std::min(0.8 * to_object, 0.5 * scene.far_m)
                   : seen.corners  ? std::min(seen.corners->near_m, 0.5 * scene.far_m)
                                   : 0.01 * scene.far_m;
    if (scene.near_far_from.empty())
      scene.near_far_from = seen.has_depth ? "depth of the training frames"
                            : seen.corners ? kCornersFrom
                                           : "1 % of far";
  }
}

// All that the cameras may see up to far, inside what the dataset says holds it all.
Box box_of_cones(const LoadedScene& scene, const Cameras& cameras, std::string& from) {
  Box box;
  for (const FrameInfo* camera : cameras) include_frustum(box, *camera, scene.far_m);
  from = "the view cones of " + std::to_string(cameras.size()) + " training cameras up to far";
  grow(box, 0.02, scene.far_m);
  if (scene.info.limit.empty()) return box;
  Box cut = box;
  for (int a = 0; a < 3; ++a) {
    cut.lo[a] = std::max(cut.lo[a], scene.info.limit.lo[a]);
    cut.hi[a] = std::min(cut.hi[a], scene.info.limit.hi[a]);
    if (!(cut.lo[a] < cut.hi[a])) return box;  // another frame of reference than that of the poses
  }
  if (cut.lo == box.lo && cut.hi == box.hi) return box;
  from += ", inside the scene's own limit (aabb_scale)";
  return cut;
}

// What the training frames show: the points of their depth, the object before a plain background, or their view cones
// up to far. `from` says which.
Box box_of_data(const LoadedScene& scene, Evidence& seen, std::string& from) {
  const std::string frames = std::to_string(seen.cameras.size()) + " training frames";
  if (seen.has_depth) {
    Box box = seen.survey.box;
    from = "depth of " + frames;
    if (seen.covered < 0.5) {
      // Too much of the picture has no depth for the points to stand for the scene: what the cameras see counts as
      // well.
      const double reach = quantile(seen.survey.distances, 0.98);
      for (const FrameInfo* camera : seen.cameras) include_frustum(box, *camera, reach);
      from += " (valid on " + std::to_string(std::lround(seen.covered * 100)) + " % of pixels) and the view cones";
    }
    grow(box, 0.02, quantile(seen.survey.distances, 0.5));
    return box;
  }
  if (seen.corners) {
    from = std::to_string(seen.corners->points) + " corners found again in " + frames;
    Box box = box_of_cameras(seen.cameras);
    box.include(seen.corners->bounds.lo);
    box.include(seen.corners->bounds.hi);
    return box;
  }
  if (!scene.plain_background) return box_of_cones(scene, seen.cameras, from);
  from = "the object's silhouettes in " + frames;
  Box box = scene.plain_background->object;
  grow(box, 0.02, scene.far_m);
  return box;
}

// The configuration, the subject under contraction, the dataset, or what the data show: the first that there is.
void derive_bounds(LoadedScene& scene, Evidence& seen, const SceneLoadOptions& options, Diagnostics& diagnostics) {
  std::string seen_in;
  const Box data = box_of_data(scene, seen, seen_in);
  bool from_data = false;
  if (options.bounds.size() == 6) {
    scene.bounds = box_of(options.bounds);
    scene.bounds_from = "the configuration";
  } else if (options.contracted) {
    scene.bounds = cube_of_subject(scene.rig, seen.cameras);
    scene.bounds_from = scene.rig.inward ? "what nine in ten cameras see together" : "where the cameras stand";
  } else if (!scene.info.bounds.empty()) {
    scene.bounds = scene.info.bounds;
    scene.bounds_from = "the dataset";
  } else {
    scene.bounds = data;
    scene.bounds_from = seen_in;
    from_data = true;
  }
  scene.extent_is_guessed = from_data && !seen.has_depth && !scene.plain_background && !seen.corners;
  // Where space goes on beyond the bounds, rays may miss them.
  if (options.check_geometry && !options.contracted && scene.near_m < scene.far_m)
    check_rays(scene, seen.usable, {data, seen.survey.distances, from_data}, diagnostics);
}

void warn_of_coarse_positions(const LoadedScene& scene, Diagnostics& diagnostics) {
  // Float positions have a step of 2^-24 of their size: far from the origin that step eats into a pixel.
  double largest = 0;
  for (int a = 0; a < 3; ++a) largest = std::max({largest, std::abs(scene.bounds.lo[a]), std::abs(scene.bounds.hi[a])});
  if (largest * 0x1p-24 <= 1e-3 * scene.pixel_footprint_m) return;
  diagnostics.warning("scene.coordinates.precision", "scene",
                      "coordinates reach " + short_number(largest) + ", where single precision steps by " +
                          short_number(largest * 0x1p-23) + " against a pixel of " +
                          short_number(scene.pixel_footprint_m),
                      "move the origin of the poses near the scene");
}

std::string list_text(const Box& box) {
  std::string out = "[";
  for (int i = 0; i < 6; ++i) out += (i > 0 ? ", " : "") + short_number(i < 3 ? box.lo[i] : box.hi[i - 3]);
  return out + "]";
}

// What a guess costs, and what to do about it here.
void tell_of_guess(const LoadedScene& scene, const SceneLoadOptions& options, Diagnostics& diagnostics) {
  const Vec3d size = scene.bounds.size();
  const std::string guess = "bounds of " + short_number(size.x) + " x " + short_number(size.y) + " x " +
                            short_number(size.z) + " and far " + short_number(scene.far_m) +
                            " are a guess: no depth, no points, no plain background";
  if (scene.rig.inward) {
    diagnostics.warning(
        "scene.bounds.guessed", "scene.load.bounds",
        guess + "; the cameras stand around one place and see it together within " + list_text(scene.rig.seen),
        "where the background matters include presets/unbounded.yaml; where only the subject does, set "
        "scene.load.bounds to that box");
  } else if (options.probe_steps == 0) {
    diagnostics.warning("scene.bounds.guessed", "scene.load.bounds", guess,
                        "let a probe find them with scene.load.probe_steps: 128, or set scene.load.bounds and far_m: "
                        "smaller where space is wasted, larger where parts of the scene are missing");
  }
}

}  // namespace

std::optional<SurveyedExtent> extent_of_points(std::vector<SurveyPoints> parts, double margin) {
  constexpr double kLost = 0.005;
  DepthSurvey survey = survey_depth(parts, kLost);
  if (survey.valid == 0) return std::nullopt;
  grow(survey.box, margin, quantile(survey.distances, 0.5));
  return SurveyedExtent{survey.box, 0.5 * quantile(survey.distances, kLost),
                        1.1 * quantile(survey.distances, 1 - kLost), survey.valid};
}

void derive_extent(LoadedScene& scene, std::vector<SurveyPoints> surveyed, const SceneLoadOptions& options,
                   Diagnostics& diagnostics) {
  Evidence seen;
  std::vector<const StoredFrame*> pixels;
  for (const int i : scene.frames_of(Split::train)) {
    const auto f = static_cast<std::size_t>(i);
    if (scene.frames[f].width_px == 0) continue;
    seen.usable.push_back(i);
    seen.cameras.push_back(&scene.info.frames[f]);
    pixels.push_back(&scene.frames[f]);
  }
  if (seen.cameras.empty()) {
    if (!diagnostics.has_errors())
      diagnostics.error("scene.split.empty", scene.info.name, "no training frame",
                        "check the split parameters of the dataset");
    return;
  }
  seen.survey = survey_depth(surveyed);
  seen.has_depth = seen.survey.valid > 0;
  if (seen.has_depth) {
    seen.covered = static_cast<double>(seen.survey.valid) / static_cast<double>(seen.survey.looked_at);
  }
  if (!seen.has_depth || options.contracted) scene.rig = find_rig(seen.cameras);
  if (!seen.has_depth && !options.contracted) {
    scene.plain_background = find_plain_background(seen.cameras, pixels, scene.rig);
  }
  if (!seen.has_depth && !scene.plain_background && scene.corners.x.size() >= kFewestCorners)
    seen.corners = extent_of_points({scene.corners}, kCornerMargin);
  derive_distances(scene, seen, options);
  // Where both are asked for, validate() compares them. Where one is, it may lie beyond what the other was derived to
  // be.
  const bool both_given = options.near_m > 0 && options.far_m > 0;
  if (!both_given && (!(scene.near_m < scene.far_m) || !std::isfinite(scene.far_m))) {
    diagnostics.error("scene.bounds.near_far", "scene.load.near_m",
                      "near is " + short_number(scene.near_m) + " m and far is " + short_number(scene.far_m) +
                          " m: no part of a ray lies between them",
                      "set scene.load.near_m below scene.load.far_m");
  }
  derive_bounds(scene, seen, options, diagnostics);
  std::vector<float> focal;
  for (const FrameInfo* camera : seen.cameras) focal.push_back(static_cast<float>(camera->camera.fx));
  const Vec3d size = scene.bounds.empty() ? Vec3d{} : scene.bounds.size();
  const double longest = std::max({size.x, size.y, size.z});
  const double middle = seen.has_depth     ? quantile(seen.survey.distances, 0.5)
                        : seen.corners     ? middle_of(scene.corners)
                        : scene.rig.inward ? scene.rig.distance_m
                        // Of contracted space far is as good as infinity, and tells nothing of where things are.
                        : options.contracted ? 0.5 * longest
                                             : 0.5 * (scene.near_m + scene.far_m);
  scene.pixel_footprint_m = middle / quantile(focal, 0.5);
  // docs/decisions.md, 0043: an object fills less than what lies between it and its cameras.
  const double unit_m = options.contracted ? middle : std::min(middle / 2, longest / 4);
  scene.unit_m = unit_m > 0 ? unit_m : 1;
  warn_of_coarse_positions(scene, diagnostics);
  if (scene.extent_is_guessed) tell_of_guess(scene, options, diagnostics);
}

}  // namespace semfield
