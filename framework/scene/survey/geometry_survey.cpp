// The verdict on the convention of poses, in words.
#include "scene/survey/geometry_survey.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

#include "scene/rotation.h"

namespace semfield {

namespace {

constexpr double kFits = 0.03;        // relative error of depth that sensors and small pictures account for
constexpr double kContradicts = 0.1;  // where nothing fits: more than noise and things that move
constexpr double kFitsRounded = 0.25;
constexpr int kRounded = 32;        // different values of depth that is rounded to large steps
constexpr double kClearly = 4;      // times better than the convention given
constexpr int kFewestCorners = 60;  // matches of photographs that can speak
constexpr double kFewFit = 0.25;    // of them; matches by chance fit 2 to 10 %
constexpr double kByChance = 0.1;
constexpr int kManyCorners = 300;  // so many cannot all be found wrongly
constexpr double kPhotosClearly = 1.5;
constexpr std::size_t kFewPairs = 3;

constexpr double kInOrder = 0.25;        // of the way between any two, at most, between neighbours of a recording
constexpr double kEdgesStronger = 1.02;  // times, where edges of depth lie elsewhere
constexpr double kEdgesBeside = 2;       // pixels of the small picture
constexpr const char* kFixRemedy = "`semfield prepare SCENE --out NEW` fixes them";

std::string percent(double share) {
  char text[32];
  std::snprintf(text, sizeof text, share < 0.1 ? "%.2g %%" : "%.0f %%", 100 * share);
  return text;
}

std::string plain_number(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%.6g", value);
  return text;
}

std::string pairs_text(int pairs) {
  return std::to_string(pairs) + (pairs == 1 ? " pair of frames" : " pairs of frames");
}

// What the files are, where `fits` is their convention and `given` was taken, and the keys that say so.
struct Finding {
  std::vector<std::string> what, set;
};

Finding compare(const PoseConvention& fits, const PoseConvention& given, bool opengl_files) {
  Finding out;
  const auto set = [&](const char* key, const std::string& value) {
    out.set.push_back(std::string("--set scene.load.") + key + "=" + value);
  };
  if (fits.invert_poses != given.invert_poses) {
    out.what.push_back(fits.invert_poses
                           ? "poses are inverse: world-to-camera matrices for camera-to-world, or the reverse"
                           : "poses should not be inverted");
    set("invert_poses", fits.invert_poses ? "true" : "false");
  }
  if (fits.flip_camera_axes != given.flip_camera_axes) {
    out.what.push_back(!fits.flip_camera_axes ? "camera axes should not be flipped"
                       : opengl_files ? "poses have OpenCV axes (y down, z forward) where OpenGL axes are expected"
                                      : "poses have OpenGL axes (y up, z backward) where OpenCV axes are expected");
    set("flip_camera_axes", fits.flip_camera_axes ? "true" : "false");
  }
  if (fits.pose_scale != given.pose_scale) {
    const double large = given.pose_scale / fits.pose_scale;
    out.what.push_back(fits.pose_scale == 1 ? "camera centres should not be scaled"
                       : large == 1000      ? "camera centres are in millimetres where depth is in metres"
                       : large < 1 ? "camera centres are " + plain_number(1 / large) + " times too small for the depth"
                                   : "camera centres are " + plain_number(large) + " times too large for the depth");
    set("pose_scale", plain_number(fits.pose_scale));
  }
  if (fits.depth_scale != given.depth_scale) {
    const double large = given.depth_scale / fits.depth_scale;
    out.what.push_back(fits.depth_scale == 1 ? "depth should not be scaled"
                       : large == 0.001      ? "depth in metres was read as millimetres"
                       : large == 1000       ? "depth in millimetres was read as metres"
                       : large < 1 ? "depth is " + plain_number(1 / large) + " times too small for the camera centres"
                                   : "depth is " + plain_number(large) + " times too large for the camera centres");
    set("depth_scale", plain_number(fits.depth_scale));
  }
  return out;
}

Pose between(const Pose& a, const Pose& b, double share) {
  const Quaternion p = quaternion_of(a), q = quaternion_of(b);
  double cosine = 0;
  for (std::size_t k = 0; k < 4; ++k) cosine += p[k] * q[k];
  Quaternion mixed{};
  for (std::size_t k = 0; k < 4; ++k) mixed[k] = (1 - share) * p[k] + share * (cosine < 0 ? -q[k] : q[k]);
  Pose out;
  set_rotation(out, mixed);
  out.t = a.t * (1 - share) + b.t * share;
  return out;
}

void report(const PoseConvention& fits, const PoseConvention& given, const SceneInfo& as_opened,
            const std::string& evidence, Diagnostics& diagnostics) {
  const Finding finding = compare(fits, given, as_opened.opengl_files);
  diagnostics.error("scene.pose.convention", as_opened.name, join(finding.what, "; ") + ": " + evidence,
                    "add " + join(finding.set, " ") + " (scene.load.check_geometry: false takes the scene as it is)");
}

// A ratio of depth to poses can be corrected on either side: that which makes depth the more usual distance of things.
PoseConvention by_plausible_unit(PoseConvention fits, const PoseConvention& given, double median_depth) {
  const double scale = fits.depth_scale / given.depth_scale;
  const auto unusual = [](double metres) { return std::abs(std::log10(metres / 2)); };
  if (scale == 1 || unusual(median_depth * scale) < unusual(median_depth)) return fits;
  fits.depth_scale = given.depth_scale;
  fits.pose_scale = given.pose_scale / scale;
  return fits;
}

}  // namespace

std::string judge_depth(const DepthTallies& tallies, const SceneInfo& as_opened, const DepthRange& range, bool wide,
                        Diagnostics& diagnostics) {
  const Tally& given = tallies.read.front();
  const Tally* best = &given;
  bool tells = false;
  // Depth in whole metres, read as millimetres, fits nothing well: that it fits at all with 1000 is enough.
  const bool rounded = range.values <= kRounded && (given.pairs == 0 || given.error > 0.5);
  for (const Tally& t : tallies.read) {
    const double ratio = t.convention.depth_scale / given.convention.depth_scale;
    const Tally& still = tallies.still[t.axes];
    tells = tells || t.pairs < (given.pairs + 1) / 2 || t.error > 2 * given.error + 0.002;
    const bool seen = ratio == 1 || still.pairs == 0 || t.error < 0.5 * still.error;
    const bool clear = given.pairs < (t.pairs + 3) / 4 || t.error * kClearly < given.error;
    const bool fits =
        (t.error < kFits && seen && clear) || (rounded && ratio == 1000 && t.axes == 0 && t.error < kFitsRounded);
    if (t.pairs >= 2 && t.pairs >= given.pairs / 2 && fits && (best == &given || t.error < 0.8 * best->error))
      best = &t;
  }
  if (best != &given) {
    const PoseConvention fits = by_plausible_unit(best->convention, given.convention, range.median);
    const std::string as_given =
        given.pairs == 0 ? "neighbouring frames do not meet as given"
                         : "depth warped between neighbouring frames is off by " + percent(given.error) + " as given";
    report(fits, given.convention, as_opened,
           as_given + ", by " + percent(best->error) + " so read (median over " + pairs_text(best->pairs) + ")",
           diagnostics);
    return "poses contradict depth";
  }
  if (given.pairs == 0) return "could not be checked: no two frames with depth overlap";
  const std::string numbers = "median error " + percent(given.error) + " over " + pairs_text(given.pairs);
  if (given.error > kContradicts && wide) return "could not be checked: few frames, far apart (" + numbers + ")";
  if (given.error > kContradicts && given.pairs >= 3) {
    diagnostics.warning("scene.depth.disagrees", as_opened.name,
                        "poses and depth do not agree: depth warped between neighbouring frames is off by " +
                            percent(given.error) + " (median over " + pairs_text(given.pairs) +
                            "), and neither other axes, nor inverse poses, nor another unit explain it",
                        range.values <= kRounded ? "depth has " + std::to_string(range.values) +
                                                       " different values: export it in millimetres"
                                                 : "check poses, intrinsics and the unit of depth");
    return "poses do not agree with depth: " + numbers;
  }
  if (!tells) return "could not be checked: the camera hardly moves (" + numbers + ")";
  return "poses agree with depth: " + numbers;
}

std::string judge_photos(const PhotoTallies& found, const SceneInfo& as_opened, Diagnostics& diagnostics) {
  const PhotoTally& given = found.tallies.front();
  const auto fewer = [](const auto& a, const auto& b) { return a.fits < b.fits; };
  const PhotoTally& best = *std::max_element(found.tallies.begin(), found.tallies.end(), fewer);
  const FocalTally& focal = *std::max_element(found.focal.begin(), found.focal.end(), fewer);
  const auto share = [&](const auto& t) { return static_cast<double>(t.fits) / std::max(1, found.matches); };
  const auto clearly_better = [&](const auto& t) {
    return share(t) > kPhotosClearly * share(given) && 2 * (t.better_pairs - t.worse_pairs) > found.pairs;
  };
  const std::string seen = std::to_string(found.matches) + " corners found again over " + pairs_text(found.pairs);
  if (found.matches < kFewestCorners || found.pairs < 3) return "could not be checked: no depth, and only " + seen;
  if (share(focal) >= kFewFit && clearly_better(focal) && focal.fits > best.fits) {
    const bool large = focal.factor > 1;
    const std::string factor = plain_number(large ? focal.factor : 1 / focal.factor);
    diagnostics.error(
        "scene.camera.size", as_opened.name,
        "intrinsics are of images " + factor + (large ? " times as large: of " : " times as small: of ") + seen + ", " +
            percent(share(given)) + " lie where the poses put them as given, " + percent(share(focal)) +
            " with focal lengths " + (large ? "divided" : "multiplied") + " by " + factor,
        (large ? "divide focal lengths and centre by " : "multiply focal lengths and centre by ") + factor +
            ", or state the size of the images that they belong to (scene.load.check_geometry: false "
            "takes the scene as it is)");
    return "the intrinsics contradict the photographs";
  }
  if (share(best) < kFewFit) {
    const std::string only = "of " + seen + " only " + percent(share(best)) + " lie where any convention puts them";
    const std::string remedy =
        "check that the poses are in the order of the images, were made from them, and that the intrinsics are theirs";
    if (share(given) < kByChance && found.matches >= kManyCorners) {
      diagnostics.error("scene.pose.photographs", as_opened.name, "the poses are not those of the photographs: " + only,
                        remedy + " (scene.load.check_geometry: false takes the scene as it is)");
      return "poses contradict the photographs";
    }
    diagnostics.warning("scene.pose.photographs", as_opened.name, "poses and photographs do not agree: " + only,
                        remedy);
    return "poses do not agree with the photographs: " + only;
  }
  if (clearly_better(best)) {
    report(best.convention, given.convention, as_opened,
           "of " + seen + ", " + percent(share(given)) + " lie where the poses put them as given, " +
               percent(share(best)) + " so read",
           diagnostics);
    return "poses contradict the photographs";
  }
  const std::string numbers = percent(share(given)) + " of " + seen + " lie where the poses put them";
  int second = 0;
  for (std::size_t i = 1; i < found.tallies.size(); ++i) second = std::max(second, found.tallies[i].fits);
  if (given.fits < kPhotosClearly * second)
    return "could not be checked: the camera hardly moves (" + numbers + ", and as many under another convention)";
  return "poses agree with the photographs: " + numbers;
}

GeometrySurvey::GeometrySurvey(const SceneInfo& as_opened, const std::vector<Camera>& cameras,
                               const PoseConvention& given, bool exposure)
    : as_opened_(as_opened),
      cameras_(cameras),
      given_(given),
      exposure_(exposure),
      pairs_(choose_pairs(as_opened, cameras)),
      wanted_(as_opened.frames.size()),
      frames_(as_opened.frames.size()),
      edges_(as_opened.frames.size()),
      photos_(as_opened.frames.size()) {
  const bool has_depth =
      std::any_of(as_opened.frames.begin(), as_opened.frames.end(), [](const FrameInfo& f) { return f.has_depth; });
  if (has_depth && pairs_.size() < kFewPairs) wide_ = wide_pairs(as_opened, cameras);
  for (const auto& [a, b] : wide_) wanted_[static_cast<std::size_t>(a)] = wanted_[static_cast<std::size_t>(b)] = true;
  for (const auto& [a, b] : pairs_) wanted_[static_cast<std::size_t>(a)] = wanted_[static_cast<std::size_t>(b)] = true;
}

void GeometrySurvey::look_at(std::size_t frame, const Camera& camera, const FrameBuffer& pixels) {
  if (!wanted_[frame]) return;
  photos_[frame] = photo_frame(camera, pixels);
  if (!pixels.depth_m.empty()) edges_[frame] = edge_scores(camera, pixels);
  if (!pixels.depth_m.empty()) frames_[frame] = small_depth_frame(camera, pixels);
}

// The frames that tracks are of, as given.
Bundle GeometrySurvey::bundle_of(const PhotoTallies& found) const {
  Bundle out;
  std::vector<std::int32_t> place(frames_.size(), -1);
  for (const Track& track : found.tracks) {
    out.tracks.push_back(track);
    for (Sighting& s : out.tracks.back().seen) {
      const auto frame = static_cast<std::size_t>(s.frame);
      std::int32_t& at = place[frame];
      if (at < 0) {
        at = static_cast<std::int32_t>(out.stated.size());
        out.stated.push_back(cameras_[frame]);
        out.given.push_back(
            converted_pose(as_opened_.frames[frame].world_from_camera, given_, as_opened_.opengl_files));
        out.lens_of.push_back(0);
      }
      s.frame = at;
    }
  }
  out.poses = out.given;
  out.lenses.resize(1);
  return out;
}

// Of the frames of bundle_of(), in its order. Empty where frames are in no order of time.
std::vector<Pose> GeometrySurvey::delayed_poses(const PhotoTallies& found, double frames) const {
  const std::vector<FrameInfo>& all = as_opened_.frames;
  const auto pose = [&](std::size_t i) {
    return converted_pose(all[i].world_from_camera, given_, as_opened_.opengl_files);
  };
  double step = 0, reach = 0;
  for (std::size_t i = 1; i < all.size(); ++i) {
    step += length(pose(i).t - pose(i - 1).t);
    reach += length(pose(i).t - pose((i * 7919) % all.size()).t);
  }
  if (step > kInOrder * reach) return {};
  std::vector<Pose> out;
  std::vector<bool> taken(all.size());
  for (const Track& track : found.tracks) {
    for (const Sighting& s : track.seen) {
      const auto i = static_cast<std::size_t>(s.frame);
      if (taken[i]) continue;
      taken[i] = true;
      const double at = std::clamp(static_cast<double>(i) + frames, 0.0, static_cast<double>(all.size() - 1));
      const auto before = static_cast<std::size_t>(at), after = std::min(before + 1, all.size() - 1);
      out.push_back(between(pose(before), pose(after), at - static_cast<double>(before)));
    }
  }
  return out;
}

void GeometrySurvey::judge_cameras(GeometryVerdict& verdict, bool with_depth, Diagnostics& diagnostics) const {
  const CameraCheck& c = verdict.cameras;
  const std::string corners = std::to_string(c.corners) + " corners";
  if (c.off) {
    std::string text =
        "cameras do not fit the photographs: " + percent(c.given) + " of " + corners + " lie where they put them";
    for (const auto& [what, share] : c.fits) text += ", " + percent(share) + " with " + what;
    diagnostics.warning("scene.camera.off", as_opened_.name, text, kFixRemedy);
    verdict.text = "cameras do not fit the photographs (" + percent(c.given) + " of " + corners + "); " + verdict.text;
  } else if (c.corners > 0 && with_depth) {  // else the text is of corners already
    verdict.text += "; " + percent(c.given) + " of " + corners + " found again lie where the cameras put them";
  }
  const std::optional<DepthShift> shift = depth_shift(edges_, cameras_);
  verdict.depth_beside = shift && shift->gain > kEdgesStronger && shift->steps >= kEdgesBeside;
  if (!verdict.depth_beside) return;
  const auto side = [](double px, const char* more, const char* less) {
    return px == 0 ? std::string() : plain_number(std::abs(px)) + " pixels " + (px > 0 ? more : less);
  };
  const std::string right = side(shift->right_px, "right", "left"), down = side(shift->down_px, "below", "above");
  const std::string text = "depth does not lie on the photographs: their edges are " + right +
                           (right.empty() || down.empty() ? "" : " and ") + down + " of those of depth";
  diagnostics.warning("scene.depth.beside", as_opened_.name, text, kFixRemedy);
  verdict.text += "; depth does not lie on the photographs";
}

GeometryVerdict GeometrySurvey::conclude(Diagnostics& diagnostics) const {
  GeometryVerdict out;
  if (pairs_.empty() && wide_.empty()) {
    out.text = "could not be checked: no two frames look in a similar direction";
    return out;
  }
  std::vector<float> depths;
  for (const SmallFrame& frame : frames_)
    depths.insert(depths.end(), frame.point_depths.begin(), frame.point_depths.end());
  PhotoTallies found = vote_by_photos(as_opened_, photos_, pairs_, given_);
  if (exposure_) out.exposure = found.exposure;
  out.cameras =
      check_cameras(bundle_of(found), kPhotoSide, [&](double frames) { return delayed_poses(found, frames); });
  if (depths.empty()) {
    const int before = diagnostics.error_count();
    out.text = judge_photos(found, as_opened_, diagnostics);
    if (diagnostics.error_count() == before) judge_cameras(out, false, diagnostics);
    if (found.tallies.front().fits >= kFewFit * found.matches) out.corners = std::move(found.corners);
    return out;
  }
  const int before = diagnostics.error_count();
  std::sort(depths.begin(), depths.end());
  DepthRange range{depths[depths.size() / 2], 0};
  range.values = static_cast<int>(std::unique(depths.begin(), depths.end()) - depths.begin());
  const bool wide = wide_.size() > pairs_.size();
  out.text = judge_depth(vote_by_depth(as_opened_, frames_, wide ? wide_ : pairs_, given_), as_opened_, range, wide,
                         diagnostics);
  if (diagnostics.error_count() == before) judge_cameras(out, true, diagnostics);
  return out;
}

}  // namespace semfield
