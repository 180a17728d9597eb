#include "scene/survey/camera_check.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

#include "scene/survey/geometry_survey.h"

namespace semfield {

namespace {

constexpr double kOffPx = 1.5;     // of the small pictures: what corners of right cameras are found within
constexpr double kLikelyPx = 12;   // beyond: matched wrongly
constexpr int kFewestTracks = 60;  // that can speak
constexpr double kMoreShare = 0.03, kMoreTimes = 1.05;   // by which other cameras fit clearly more
constexpr double kDelays[] = {-2, -1, -0.5, 0.5, 1, 2};  // frames

double longer_side(const Camera& c) { return std::max(c.width_px, c.height_px); }

// Sum of the errors of a track's two sightings, in pixels of the small pictures; large where they do not meet.
double off_px(const Bundle& bundle, Track track, double side_px) {
  if (!settle_point(bundle, track)) return kLikelyPx;
  double sum = 0;
  for (const Sighting& s : track.seen)
    sum += error_px(bundle, track, s) * side_px / longer_side(bundle.stated[static_cast<std::size_t>(s.frame)]);
  return sum;
}

class Check {
 public:
  Check(const Bundle& bundle, std::vector<Track> tracks, double side_px)
      : bundle_(bundle), side_px_(side_px), tracks_(std::move(tracks)) {}

  double share(const Bundle& cameras) const { return fitting(cameras, 0) + fitting(cameras, 1); }
  // Each half of the corners judges cameras that the other was fitted by.
  double share_fitted(bool lens, bool poses, Bundle& fitted) const {
    double sum = 0;
    for (const std::size_t half : {0, 1}) {
      fitted = bundle_;
      fitted.tracks.clear();
      for (std::size_t i = 1 - half; i < tracks_.size(); i += 2)
        if (off_px(bundle_, tracks_[i], side_px_) < kLikelyPx) fitted.tracks.push_back(tracks_[i]);
      for (const bool rest : {false, true})
        adjust(fitted, {.outlier_px = longer_side(bundle_.stated.front()) / side_px_,
                        .move_poses = poses,
                        .move_focal = lens,
                        .move_lens = lens && rest,
                        .iterations = 8});
      sum += fitting(fitted, half);
    }
    return sum;
  }

 private:
  double fitting(const Bundle& cameras, std::size_t half) const {
    int fits = 0;
    for (std::size_t i = half; i < tracks_.size(); i += 2)
      fits += off_px(cameras, tracks_[i], side_px_) < kOffPx ? 1 : 0;
    return static_cast<double>(fits) / static_cast<double>(tracks_.size());
  }

  const Bundle& bundle_;
  double side_px_;
  std::vector<Track> tracks_;
};

// What moved by more than a hundredth of the image; the focal length, where nothing did.
std::string lens_text(const Bundle& given, const Bundle& fitted) {
  const Camera &a = given.stated[0], b = fitted.camera(0);
  const double least = 0.01 * longer_side(a);
  const bool centre = std::abs(b.cx - a.cx) > least || std::abs(b.cy - a.cy) > least;
  char text[160];
  std::string out;
  if (std::abs(b.fx - a.fx) > 0.01 * a.fx || !centre) {
    std::snprintf(text, sizeof text, "focal length %.4g for %.4g pixels", b.fx, a.fx);
    out = text;
  }
  if (centre) {
    std::snprintf(text, sizeof text, "%scentre (%.4g, %.4g) for (%.4g, %.4g)", out.empty() ? "" : ", ", b.cx, b.cy,
                  a.cx, a.cy);
    out += text;
  }
  return "another lens (" + out + ")";
}

std::string delay_text(double frames) {
  char text[64];
  std::snprintf(text, sizeof text, "poses of %g frame%s %s", std::abs(frames), std::abs(frames) > 1 ? "s" : "",
                frames > 0 ? "later" : "earlier");
  return text;
}

}  // namespace

CameraCheck check_cameras(Bundle bundle, double side_px, const DelayedPoses& delayed) {
  CameraCheck out;
  std::vector<Track> all;
  for (Track& track : bundle.tracks) {
    // Rays that hardly part meet anywhere; they say nothing.
    if (settle_point(bundle, track)) all.push_back(track);
  }
  if (std::ssize(all) < kFewestTracks) return out;
  out.corners = static_cast<int>(all.size());
  bundle.tracks = all;
  bundle.measure();
  const Check check(bundle, all, side_px);
  out.given = check.share(bundle);
  double best = out.given;
  const auto offer = [&](const std::string& what, double share) {
    if (share < kMoreTimes * best || share < best + kMoreShare) return;
    out.fits.emplace_back(what, share);
    best = share;
  };
  Bundle lens, poses, both;
  const double by_lens = check.share_fitted(true, false, lens);
  double later = 0, by_delay = 0;
  for (const double frames : kDelays) {
    Bundle moved = bundle;
    moved.poses = delayed(frames);
    if (moved.poses.empty()) break;
    const double share = check.share(moved);
    if (share > by_delay) {
      by_delay = share;
      later = frames;
    }
  }
  const double by_poses = check.share_fitted(false, true, poses), by_both = check.share_fitted(true, true, both);
  if (by_delay > by_lens)
    offer(delay_text(later), by_delay);
  else
    offer(lens_text(bundle, lens), by_lens);
  if (by_both >= kMoreTimes * by_poses)
    offer("corrected poses and " + lens_text(bundle, both), by_both);
  else
    offer("corrected poses", by_poses);
  out.off = !out.fits.empty();
  return out;
}

namespace {

constexpr float kJump = 1.1f;              // of depth, across an edge
constexpr std::size_t kFewestEdges = 100;  // of a frame
constexpr std::size_t kFewestFrames = 4;
constexpr int kSide = 2 * kEdgeReach + 1;

}  // namespace

EdgeScores edge_scores(const Camera& camera, const FrameBuffer& frame) {
  const std::int32_t step = photo_step(camera);
  const Grey grey = grey_of(frame, step);
  const auto depth = [&](std::int32_t x, std::int32_t y) {
    const auto row = static_cast<std::size_t>(y * step + step / 2) * static_cast<std::size_t>(camera.width_px);
    return frame.depth_m[row + static_cast<std::size_t>(x * step + step / 2)];
  };
  const auto jumps = [](float a, float b) { return a > 0 && b > 0 && std::max(a, b) > kJump * std::min(a, b); };
  // A strong edge counts little more than a plain one: patterns have the strongest.
  const auto strength = [](float a, float b) { return std::sqrt(std::abs(a - b)); };
  EdgeScores out(kSide * kSide);
  std::size_t edges = 0;
  for (std::int32_t y = kEdgeReach; y < grey.height - kEdgeReach - 1; ++y) {
    for (std::int32_t x = kEdgeReach; x < grey.width - kEdgeReach - 1; ++x) {
      const bool across = jumps(depth(x, y), depth(x + 1, y)), down = jumps(depth(x, y), depth(x, y + 1));
      edges += (across ? 1 : 0) + (down ? 1 : 0);
      for (std::int32_t dy = -kEdgeReach; (across || down) && dy <= kEdgeReach; ++dy) {
        for (std::int32_t dx = -kEdgeReach; dx <= kEdgeReach; ++dx) {
          const float here = grey.at(x + dx, y + dy);
          float& score = out[static_cast<std::size_t>((dy + kEdgeReach) * kSide + dx + kEdgeReach)];
          if (across) score += strength(here, grey.at(x + dx + 1, y + dy));
          if (down) score += strength(here, grey.at(x + dx, y + dy + 1));
        }
      }
    }
  }
  float sum = 0;
  for (const float score : out) sum += score;
  if (edges < kFewestEdges || !(sum > 0)) return {};
  for (float& score : out) score *= static_cast<float>(out.size()) / sum;
  return out;
}

std::optional<DepthShift> depth_shift(const std::vector<EdgeScores>& frames, const std::vector<Camera>& cameras) {
  std::vector<float> all(kSide * kSide);
  std::size_t found = 0, first = 0;
  for (std::size_t f = 0; f < frames.size(); ++f) {
    if (frames[f].empty()) continue;
    if (found++ == 0) first = f;
    for (std::size_t i = 0; i < all.size(); ++i) all[i] += frames[f][i];
  }
  if (found < kFewestFrames) return {};
  const auto best = static_cast<int>(std::max_element(all.begin(), all.end()) - all.begin());
  const int step = photo_step(cameras[first]);
  const int right = best % kSide - kEdgeReach, down = best / kSide - kEdgeReach;
  return DepthShift{static_cast<double>(right * step), static_cast<double>(down * step), std::hypot(right, down),
                    static_cast<double>(all[static_cast<std::size_t>(best)] / all[kSide * kSide / 2])};
}

}  // namespace semfield
