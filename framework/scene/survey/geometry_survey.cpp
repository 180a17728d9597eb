// Whether poses, lens and depth fit the pixels, and the verdict in words.
#include "scene/survey/geometry_survey.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <set>

#include "compute/parallel.h"
#include "formats/image_io.h"
#include "scene/camera.h"

namespace semfield {

/// A corner and what it looks like: 8 x 8 means of grey around it, mean 0 and length 1.
struct PhotoCorner {
  Vec3d ray;            ///< in camera axes, z = 1
  double u = 0, v = 0;  ///< in the photograph as loaded, pixels
  float grey = 0;       ///< mean around it, 0 to 255
  std::array<float, 64> patch;
};

/// What the check keeps of a photograph.
struct PhotoFrame {
  Camera camera;  ///< its focal lengths are those of the small picture
  std::vector<PhotoCorner> corners;
};

/// A frame's depth as the check keeps it, at most 96 pixels wide or high; empty where it keeps none.
struct SmallFrame {
  Camera camera;                    ///< at the small size
  std::vector<float> depth_m;       ///< [H * W], 0 = invalid
  std::vector<Vec3d> points;        ///< some of its pixels as points in camera axes, divided by their z
  std::vector<float> point_depths;  ///< their z
};

// Corners after Shi and Tomasi [Shi94], patches compared by zero-mean normalised cross-correlation, and how far from
// its epipolar line each is found.

namespace {

constexpr std::int32_t kPhotoSide = 320;  // longer side of the small pictures in which corners are found, pixels, about
constexpr std::int32_t kCell = 16;        // pixels; one corner each
constexpr std::size_t kCorners = 300;
constexpr int kReach = 8;           // half the side of a patch, pixels
constexpr float kWeakest = 500;     // strength of a corner, grey steps squared
constexpr float kAlike = 0.75f;     // correlation of a match
constexpr float kAmbiguous = 0.9f;  // of (1 - best) / (1 - second)
constexpr double kOff = 1.5;        // pixels of the small picture: what corners of right cameras are found within
constexpr int kFewestMatches = 12;
constexpr double kLeastParallax = 0.02;  // radians between two rays that meet; a pixel of the small picture is 0.004
constexpr int kFewestGreys = 8, kFewestPairs = 8;
constexpr double kDark = 4;  // grey steps: darker ones say little of a factor

// A small picture in grey, 0 to 255, or what is worked out of its pixels.
using Grey = Image<float>;

// The smaller eigenvalue of the sum of gradient products over 5 x 5 pixels [Shi94].
Grey corner_strength(const Grey& g) {
  const std::int32_t width = g.width_px, height = g.height_px;
  // Of a product of gradients, by running sums; the outermost two rows and columns stay 0.
  const auto sums_of = [&](const auto& product) {
    Grey in{width, height, 1, std::vector<float>(g.pixels.size())}, rows = in;
    std::vector<float> out(g.pixels.size());
    for (std::int32_t y = 1; y < height - 1; ++y) {
      for (std::int32_t x = 1; x < width - 1; ++x)
        in.pixels[pixel_at(x, y, width)] = product(g.at(x + 1, y) - g.at(x - 1, y), g.at(x, y + 1) - g.at(x, y - 1));
    }
    for (std::int32_t y = 0; y < height; ++y) {
      for (std::int32_t x = 2; x < width - 2; ++x) {
        const float* p = in.pixels.data() + pixel_at(x, y, width);
        rows.pixels[pixel_at(x, y, width)] = p[-2] + p[-1] + p[0] + p[1] + p[2];
      }
    }
    for (std::int32_t y = 2; y < height - 2; ++y) {
      for (std::int32_t x = 2; x < width - 2; ++x)
        out[pixel_at(x, y, width)] =
            rows.at(x, y - 2) + rows.at(x, y - 1) + rows.at(x, y) + rows.at(x, y + 1) + rows.at(x, y + 2);
    }
    return out;
  };
  const std::vector<float> yy = sums_of([](float, float dy) { return dy * dy; }),
                           xy = sums_of([](float dx, float dy) { return dx * dy; });
  Grey out{width, height, 1, sums_of([](float dx, float) { return dx * dx; })};
  for (std::size_t i = 0; i < xy.size(); ++i) {
    const float sum = out.pixels[i] + yy[i], off = out.pixels[i] - yy[i];
    out.pixels[i] = 0.5f * (sum - std::sqrt(off * off + 4 * xy[i] * xy[i]));
  }
  return out;
}

// Whether a mask hides a part of the patch about (x, y) of the small picture, or of the pixels that its strength is of.
bool touches_mask(const FrameBuffer& frame, std::int32_t side, std::int32_t x, std::int32_t y) {
  if (frame.used.empty()) return false;
  const auto first = [&](std::int32_t at) { return std::max(0, (at - kReach - 1) * side); };
  const auto end = [&](std::int32_t at, std::int32_t size) { return std::min(size, (at + kReach + 2) * side); };
  for (std::int32_t row = first(y); row < end(y, frame.height_px); ++row) {
    const auto begin = frame.used.begin() + std::ptrdiff_t{row} * frame.width_px;
    if (std::find(begin + first(x), begin + end(x, frame.width_px), std::uint8_t{0}) != begin + end(x, frame.width_px))
      return true;
  }
  return false;
}

PhotoCorner corner_at(const Grey& g, Vec3d direction, std::int32_t x, std::int32_t y) {
  PhotoCorner out;
  out.ray = direction * (1 / direction.z);
  float mean = 0;
  for (int j = 0; j < 8; ++j) {
    for (int i = 0; i < 8; ++i) {
      const std::int32_t px = x + 2 * i - kReach, py = y + 2 * j - kReach;
      const float value = g.at(px, py) + g.at(px + 1, py) + g.at(px, py + 1) + g.at(px + 1, py + 1);
      out.patch[static_cast<std::size_t>(8 * j + i)] = value;
      mean += value / 64;
    }
  }
  out.grey = mean / 4;
  float squares = 1e-6f;
  for (float& v : out.patch) {
    v -= mean;
    squares += v * v;
  }
  for (float& v : out.patch) v /= std::sqrt(squares);
  return out;
}

struct Best {
  std::size_t at = 0;
  float first = -1, second = -1;
  void offer(std::size_t i, float score) {
    if (score > first) {
      second = first;
      first = score;
      at = i;
    } else if (score > second) {
      second = score;
    }
  }
};

// Corners that are each other's best, and clearly better than the second best.
std::vector<std::pair<std::size_t, std::size_t>> matches_of(const std::vector<PhotoCorner>& a,
                                                            const std::vector<PhotoCorner>& b) {
  std::vector<Best> of_a(a.size()), of_b(b.size());
  for (std::size_t i = 0; i < a.size(); ++i) {
    for (std::size_t j = 0; j < b.size(); ++j) {
      float score = 0;
      for (std::size_t k = 0; k < a[i].patch.size(); ++k) score += a[i].patch[k] * b[j].patch[k];
      of_a[i].offer(j, score);
      of_b[j].offer(i, score);
    }
  }
  std::vector<std::pair<std::size_t, std::size_t>> out;
  for (std::size_t i = 0; i < a.size(); ++i) {
    const Best& best = of_a[i];
    if (best.first < kAlike || of_b[best.at].at != i || 1 - best.first > kAmbiguous * (1 - best.second)) continue;
    out.emplace_back(i, best.at);
  }
  return out;
}

// The same for a wide lens, whose pixels are angles: between `seen` and the arc from `a` to `b`, times the focal
// length.
double off_epipolar_arc(Vec3d a, Vec3d b, Vec3d seen, const Camera& camera) {
  const auto between = [](Vec3d v, Vec3d w) { return std::atan2(length(cross(v, w)), dot(v, w)); };
  const Vec3d normal = cross(a, b);
  const double size = length(normal);
  const bool beside = size > 0 && dot(cross(a, seen), normal) >= 0 && dot(cross(seen, b), normal) >= 0;
  const double ends = std::min(between(seen, a), between(seen, b));
  return camera.fx * (beside ? std::asin(std::min(1.0, std::abs(dot(seen, normal)) / (size * length(seen)))) : ends);
}

// Pixels between `seen` and the half line where the other camera's ray shows: from its direction (a point at infinity)
// to the other's centre, as far as both are in front.
double off_epipolar_line(Vec3d ray, const Pose& pose, Vec3d seen, const Camera& camera) {
  Vec3d a = pose.rotate(ray), b = pose.t;
  if (const double away = length(b); away > 0) b = b * (1 / away);  // a direction as well: no unit of length counts
  if (camera.is_wide()) return off_epipolar_arc(a, b, seen, camera);
  if (!(a.z > 0) && !(b.z > 0)) return 1e300;
  const auto clip = [](Vec3d& behind, Vec3d front) {
    const double z = 1e-3 * front.z;
    if (behind.z < z) behind = behind + (front - behind) * ((z - behind.z) / (front.z - behind.z));
  };
  if (a.z > 0) clip(b, a);
  if (b.z > 0) clip(a, b);
  const double u = camera.fx * a.x / a.z, v = camera.fy * a.y / a.z;
  const double du = camera.fx * b.x / b.z - u, dv = camera.fy * b.y / b.z - v;
  const double wu = camera.fx * seen.x - u, wv = camera.fy * seen.y - v;
  const double along = du * du + dv * dv > 0 ? std::clamp((wu * du + wv * dv) / (du * du + dv * dv), 0.0, 1.0) : 0.0;
  return std::hypot(wu - along * du, wv - along * dv);
}

// From a pixel of greatest strength to the peak of the parabola through it and its neighbours along (dx, dy).
double to_peak(const Grey& strengths, std::int32_t x, std::int32_t y, std::int32_t dx, std::int32_t dy) {
  const double before = std::sqrt(std::max(0.0f, strengths.at(x - dx, y - dy))), here = std::sqrt(strengths.at(x, y)),
               after = std::sqrt(std::max(0.0f, strengths.at(x + dx, y + dy)));
  const double bend = before - 2 * here + after;
  return bend < 0 ? std::clamp(0.5 * (before - after) / bend, -0.5, 0.5) : 0.0;
}

// Pixels of a photograph along a side of one of its small picture.
std::int32_t photo_step(const Camera& camera) {
  return std::max(1, (std::max(camera.width_px, camera.height_px) + kPhotoSide / 2) / kPhotoSide);
}

// Means of blocks of `side` x `side` pixels.
Grey grey_of(const FrameBuffer& frame, std::int32_t side) {
  Grey out{frame.width_px / side, frame.height_px / side, 1, {}};
  out.pixels.resize(pixel_at(0, out.height_px, out.width_px));
  for (std::int32_t y = 0; y < out.height_px * side; ++y) {
    const std::uint8_t* p = &frame.rgb[3 * pixel_at(0, y, frame.width_px)];
    float* row = &out.pixels[pixel_at(0, y / side, out.width_px)];
    for (std::int32_t x = 0; x < out.width_px * side; ++x, p += 3)
      row[x / side] += static_cast<float>(77 * p[0] + 150 * p[1] + 29 * p[2]);  // of 256
  }
  for (float& v : out.pixels) v /= static_cast<float>(256 * side * side);
  return out;
}

// The strongest corners of a frame, spread over it.
PhotoFrame photo_frame(const Camera& camera, const FrameBuffer& frame) {
  const std::int32_t side = photo_step(camera);
  const Grey g = grey_of(frame, side);
  const Grey strengths = corner_strength(g);
  struct Found {
    float strength;
    std::int32_t x, y;
  };
  std::vector<Found> found;
  for (std::int32_t cy = kReach; cy + kReach < g.height_px; cy += kCell) {
    for (std::int32_t cx = kReach; cx + kReach < g.width_px; cx += kCell) {
      Found best{kWeakest, 0, 0};
      for (std::int32_t y = cy; y < std::min(cy + kCell, g.height_px - kReach); ++y)
        for (std::int32_t x = cx; x < std::min(cx + kCell, g.width_px - kReach); ++x)
          if (strengths.at(x, y) > best.strength) best = {strengths.at(x, y), x, y};
      if (best.strength > kWeakest) found.push_back(best);
    }
  }
  std::stable_sort(found.begin(), found.end(), [](const Found& a, const Found& b) { return a.strength > b.strength; });
  if (found.size() > kCorners) found.resize(kCorners);
  PhotoFrame out;
  out.camera = camera;
  out.camera.fx /= side;
  out.camera.fy /= side;
  for (const Found& f : found) {
    if (touches_mask(frame, side, f.x, f.y)) continue;
    const double u = (f.x + 0.5 + to_peak(strengths, f.x, f.y, 1, 0)) * side,
                 v = (f.y + 0.5 + to_peak(strengths, f.x, f.y, 0, 1)) * side;
    const Vec3d direction = camera.direction(u, v);
    if (!(direction.z > 0)) continue;
    out.corners.push_back(corner_at(g, direction, f.x, f.y));
    out.corners.back().u = u;
    out.corners.back().v = v;
  }
  return out;
}

// Cameras against corners, in pixels.

constexpr double kLikelyPx = 12;                         // beyond: matched wrongly
constexpr int kFewestTracks = 60;                        // that can speak
constexpr double kMoreShare = 0.03, kMoreTimes = 1.05;   // by which other cameras fit clearly more
constexpr double kDelays[] = {-2, -1, -0.5, 0.5, 1, 2};  // frames

double longer_side(const Camera& c) { return std::max(c.width_px, c.height_px); }

// Sum of the errors of a track's two sightings, in pixels of the small pictures; large where they do not meet.
double off_px(const Bundle& bundle, Track track) {
  if (!settle_point(bundle, track)) return kLikelyPx;
  double sum = 0;
  for (const Sighting& s : track.seen)
    sum += error_px(bundle, track, s) * kPhotoSide / longer_side(bundle.stated[static_cast<std::size_t>(s.frame)]);
  return sum;
}

// What moved by more than a hundredth of the image; the focal length, where nothing did.
std::string lens_text(const Bundle& given, const Bundle& fitted) {
  const Camera &a = given.stated[0], b = fitted.camera(0);
  const double least = 0.01 * longer_side(a);
  const bool centre = std::abs(b.cx - a.cx) > least || std::abs(b.cy - a.cy) > least;
  std::vector<std::string> out;
  if (std::abs(b.fx - a.fx) > 0.01 * a.fx || !centre)
    out.push_back(fmt::format("focal length {:.4g} for {:.4g} pixels", b.fx, a.fx));
  if (centre) out.push_back(fmt::format("centre ({:.4g}, {:.4g}) for ({:.4g}, {:.4g})", b.cx, b.cy, a.cx, a.cy));
  return "another lens (" + join(out) + ")";
}

std::string delay_text(double frames) {
  return fmt::format("poses of {:g} frame{} {}", std::abs(frames), std::abs(frames) > 1 ? "s" : "",
                     frames > 0 ? "later" : "earlier");
}

// Poses of the bundle's frames as they were so many frames later; empty where frames are not in order.
using DelayedPoses = std::function<std::vector<Pose>(double frames)>;

// `bundle` holds the frames as given and tracks of two frames each, whose points do not matter, in pixels of `stated`.
CameraCheck check_cameras(Bundle bundle, const DelayedPoses& delayed) {
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
  const auto fitting = [&](const Bundle& cameras, std::size_t half) {
    int fits = 0;
    for (std::size_t i = half; i < all.size(); i += 2) fits += off_px(cameras, all[i]) < kOff ? 1 : 0;
    return static_cast<double>(fits) / static_cast<double>(all.size());
  };
  const auto share_of = [&](const Bundle& cameras) { return fitting(cameras, 0) + fitting(cameras, 1); };
  // Each half of the corners judges cameras that the other was fitted by.
  const auto share_fitted = [&](bool move_lens, bool move_poses, Bundle& fitted) {
    double sum = 0;
    for (const std::size_t half : {0, 1}) {
      fitted = bundle;
      fitted.tracks.clear();
      for (std::size_t i = 1 - half; i < all.size(); i += 2)
        if (off_px(bundle, all[i]) < kLikelyPx) fitted.tracks.push_back(all[i]);
      for (const bool rest : {false, true})
        adjust(fitted, {.outlier_px = longer_side(bundle.stated.front()) / kPhotoSide,
                        .move_poses = move_poses,
                        .move_focal = move_lens,
                        .move_lens = move_lens && rest,
                        .iterations = 8});
      sum += fitting(fitted, half);
    }
    return sum;
  };
  out.given = share_of(bundle);
  double best = out.given;
  const auto offer = [&](const std::string& what, double share) {
    if (share < kMoreTimes * best || share < best + kMoreShare) return;
    out.fits.emplace_back(what, share);
    best = share;
  };
  Bundle lens, poses, both;
  const double by_lens = share_fitted(true, false, lens);
  double later = 0, by_delay = 0;
  for (const double frames : kDelays) {
    Bundle moved = bundle;
    moved.poses = delayed(frames);
    if (moved.poses.empty()) break;
    const double share = share_of(moved);
    if (share > by_delay) {
      by_delay = share;
      later = frames;
    }
  }
  const double by_poses = share_fitted(false, true, poses), by_both = share_fitted(true, true, both);
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

// Depth against colours: edges of depth are compared with edges of the photograph, shifted each way.

constexpr float kJump = 1.1f;              // of depth, across an edge
constexpr std::size_t kFewestEdges = 100;  // of a frame
constexpr std::size_t kFewestFrames = 4;
constexpr int kSide = 2 * kEdgeReach + 1;

// Where depth lies best.
struct DepthShift {
  double right_px = 0, down_px = 0;  ///< by which edges of colour lie beside those of depth, pixels of the photograph
  double steps = 0;                  ///< how far that is, pixels of the small picture
  double gain = 1;                   ///< how much stronger edges are there than where they should be
};

}  // namespace

EdgeScores edge_scores(const Camera& camera, const FrameBuffer& frame) {
  const std::int32_t step = photo_step(camera);
  const Grey grey = grey_of(frame, step);
  const auto depth = [&](std::int32_t x, std::int32_t y) {
    return frame.depth_m[pixel_at(x * step + step / 2, y * step + step / 2, camera.width_px)];
  };
  const auto jumps = [](float a, float b) { return a > 0 && b > 0 && std::max(a, b) > kJump * std::min(a, b); };
  // A strong edge counts little more than a plain one: patterns have the strongest.
  const auto strength = [](float a, float b) { return std::sqrt(std::abs(a - b)); };
  EdgeScores out(kSide * kSide);
  std::size_t edges = 0;
  for (std::int32_t y = kEdgeReach; y < grey.height_px - kEdgeReach - 1; ++y) {
    for (std::int32_t x = kEdgeReach; x < grey.width_px - kEdgeReach - 1; ++x) {
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

namespace {

// Nothing where too few frames say the same.
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

// Pairs of neighbouring frames, and depth warped between them.

/// Frames that may see the same things, by index; the first is the lower.
using FramePairs = std::vector<std::pair<int, int>>;

/// One convention and how well it fits.
struct Tally {
  PoseConvention convention;
  std::size_t axes = 0;  ///< its axes and direction, of conventions()
  int pairs = 0;         ///< pairs of frames that overlap under it
  double error = 1;      ///< median over them of the median relative difference of depths, 0..1
};

struct DepthTallies {
  std::vector<Tally> read;  ///< the convention given first
  /// Each of conventions() with camera centres that count for nothing: a unit that fits no better has not been seen.
  std::vector<Tally> still;
};

constexpr std::int32_t kDepthSide = 96;
constexpr std::size_t kPoints = 600;  // of a frame, warped into each neighbour
constexpr std::size_t kFewestLanded = 30;
constexpr int kAnchors = 24;
constexpr double kWidestAngle = 60;  // degrees; beyond it two frames show different sides of things
constexpr double kWidestOfFew = 85;  // and from a right angle on hardly the same ones

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
  return errors.size() < std::max(kFewestLanded, a.points.size() / 20) ? 2.0f : median_of(errors);
}

// The convention given (first), the other axes, the inverse, and both.
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

// to_from, from the poses of two frames as opened.
Pose relative_pose(const SceneInfo& as_opened, const PoseConvention& convention, std::size_t to, std::size_t from) {
  const Pose a = converted_pose(as_opened.frames[from].world_from_camera, convention, as_opened.opengl_files);
  const Pose b = converted_pose(as_opened.frames[to].world_from_camera, convention, as_opened.opengl_files);
  Pose out;
  for (std::size_t row = 0; row < 3; ++row)
    for (std::size_t col = 0; col < 3; ++col)
      out.r[row][col] = dot(b.axis(static_cast<int>(row)), a.axis(static_cast<int>(col)));
  out.t = b.apply_inverse(a.t);
  return out;
}

SmallFrame small_depth_frame(const Camera& camera, const FrameBuffer& frame) {
  SmallFrame out;
  const double scale = std::min(1.0, static_cast<double>(kDepthSide) / std::max(camera.width_px, camera.height_px));
  const auto width = static_cast<std::int32_t>(std::max(1L, std::lround(camera.width_px * scale)));
  const auto height = static_cast<std::int32_t>(std::max(1L, std::lround(camera.height_px * scale)));
  out.camera = camera.resized(width, height);
  out.depth_m = at_nearest_pixels(frame.depth_m, {camera.width_px, camera.height_px}, {width, height});
  std::vector<std::size_t> valid;
  for (std::size_t i = 0; i < out.depth_m.size(); ++i) {
    float& depth = out.depth_m[i];
    if (depth > 0 && std::isfinite(depth))
      valid.push_back(i);
    else
      depth = 0;
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

// At most 24 frames, evenly spaced, each with its neighbours in order and by pose, however the poses are read: the
// angle between two cameras is the same under every convention. Frames with width 0 in `cameras` are left out.
FramePairs choose_pairs(const SceneInfo& as_opened, const std::vector<Camera>& cameras) {
  std::vector<int> usable;
  for (std::size_t i = 0; i < cameras.size(); ++i)
    if (cameras[i].width_px > 0) usable.push_back(static_cast<int>(i));
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

// All pairs of a few frames whose directions differ by less than a right angle: those of a wide ring overlap too, but
// hide much from each other. None of over 24 frames.
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

// Depth of each frame warped into the other of its pair under each of conventions(), with depth as it is and times 1000
// and 1/1000; and under the first with depth in the other units of common sensors and exports. `frames` as
// `as_opened.frames`, empty where not looked at.
DepthTallies vote_by_depth(const SceneInfo& as_opened, const std::vector<SmallFrame>& frames, const FramePairs& pairs,
                           const PoseConvention& given) {
  const std::vector<PoseConvention> turned = conventions(given);
  std::vector<Tally> all;
  const auto add = [&](std::size_t axes, double depth_scale) {
    PoseConvention convention = turned[axes];
    convention.depth_scale *= depth_scale;
    all.push_back({convention, axes, 0, 1});
  };
  for (const double scale : {1.0, 1000.0, 0.001})
    for (std::size_t c = 0; c < turned.size(); ++c) add(c, scale);
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
    for (const std::vector<float>& pair : votes)
      if (pair[m] <= 1) landed.push_back(pair[m]);
    all[m].pairs = static_cast<int>(landed.size());
    if (!landed.empty()) all[m].error = median_of(landed);
  }
  const auto end_of_read = all.begin() + static_cast<std::ptrdiff_t>(read);
  return {{all.begin(), end_of_read}, {end_of_read, all.end()}};
}

// What photographs say of cameras: corners found again in neighbouring ones.

// Intrinsics of images of another size.
constexpr double kFocalFactors[] = {0.125, 0.25, 1.0 / 3, 0.5, 2, 3, 4, 6, 8};

// A way to read poses and lens, and what fits so.
struct Reading {
  PoseConvention convention;
  double factor = 1;                      ///< that divides the focal lengths
  int fits = 0;                           ///< matches that lie within 1.5 pixels of the half line where it puts them
  int better_pairs = 0, worse_pairs = 0;  ///< pairs of frames where more or fewer fit than as given
};

struct PhotoMatches {
  std::vector<Track> tracks;      ///< of two frames each, all matches of such pairs; points are not set
  int pairs = 0, matches = 0;     ///< of pairs with enough matches to show that they overlap
  std::vector<Reading> readings;  ///< as given, each other of conventions(), each of kFocalFactors
  SurveyPoints corners;  ///< of the first, between training frames, whose rays meet at an angle that shows how far
  std::optional<double> exposure;  ///< as GeometryVerdict
};

// What one pair of frames says.
struct PairMatches {
  int matches = 0;
  std::vector<int> fits;  // of each reading
  std::vector<Track> tracks;
  SurveyPoints corners;
  std::optional<double> brighter;  // median logarithm of the second frame's brightness over the first's
};

// Where two rays, in the axes of the first frame, are nearest to each other; nothing where they do not say how far.
std::optional<double> meeting_distance(Vec3d ray, const Pose& b_from_a, Vec3d seen) {
  const Vec3d d = normalized(ray), e = normalized(b_from_a.unrotate(seen));
  const Vec3d to_b = b_from_a.unrotate(b_from_a.t) * -1.0;
  const double cosine = dot(d, e), apart = 1 - cosine * cosine;
  if (apart < kLeastParallax * kLeastParallax) return {};
  const double t = (dot(d, to_b) - cosine * dot(e, to_b)) / apart;
  if (!(t > 0) || !(cosine * t > dot(e, to_b))) return {};  // behind one of the two
  return t;
}

using Matches = std::vector<std::pair<std::size_t, std::size_t>>;

// `factor` divides the focal lengths of both frames.
int count_fits(const Matches& matches, const PhotoFrame& a, const PhotoFrame& b, const Pose& b_from_a, double factor) {
  Camera camera = b.camera;
  if (camera.is_wide() && factor != 1) return 0;  // a wide lens is no pinhole whose rays a factor spreads
  camera.fx /= factor;
  camera.fy /= factor;
  const auto seen = [factor](const PhotoCorner& corner) {
    return Vec3d{corner.ray.x * factor, corner.ray.y * factor, 1};
  };
  return static_cast<int>(std::count_if(matches.begin(), matches.end(), [&](const auto& match) {
    return off_epipolar_line(seen(a.corners[match.first]), b_from_a, seen(b.corners[match.second]), camera) < kOff;
  }));
}

// Matches between the frames of each pair, under each reading. `frames` as `as_opened.frames`.
PhotoMatches match_photos(const SceneInfo& as_opened, const std::vector<PhotoFrame>& frames, const FramePairs& pairs,
                          const PoseConvention& given) {
  PhotoMatches all;
  for (const PoseConvention& convention : conventions(given)) all.readings.push_back({convention});
  for (const double factor : kFocalFactors) all.readings.push_back({given, factor});
  std::vector<PairMatches> found(pairs.size());
  parallel_for(std::ssize(pairs), [&, &readings = std::as_const(all.readings)](std::int64_t p) {
    PairMatches& out = found[static_cast<std::size_t>(p)];
    const auto i = static_cast<std::size_t>(pairs[static_cast<std::size_t>(p)].first);
    const auto j = static_cast<std::size_t>(pairs[static_cast<std::size_t>(p)].second);
    const Matches matches = matches_of(frames[i].corners, frames[j].corners);
    out.matches = static_cast<int>(matches.size());
    if (out.matches < kFewestMatches) return;
    for (const Reading& reading : readings)
      out.fits.push_back(count_fits(matches, frames[i], frames[j], relative_pose(as_opened, reading.convention, j, i),
                                    reading.factor));
    const Pose j_from_i = relative_pose(as_opened, given, j, i);
    const FrameInfo& frame = as_opened.frames[i];
    const Pose world_from_i = converted_pose(frame.world_from_camera, given, as_opened.opengl_files);
    const bool train = frame.split == Split::train && as_opened.frames[j].split == Split::train;
    std::vector<double> brighter;
    for (const auto& [a, b] : matches) {
      const PhotoCorner &x = frames[i].corners[a], &y = frames[j].corners[b];
      out.tracks.push_back({{}, {{static_cast<std::int32_t>(i), x.u, x.v}, {static_cast<std::int32_t>(j), y.u, y.v}}});
      if (off_epipolar_line(x.ray, j_from_i, y.ray, frames[j].camera) >= kOff) continue;
      brighter.push_back(std::log((y.grey + kDark) / (x.grey + kDark)));
      const std::optional<double> t = train ? meeting_distance(x.ray, j_from_i, y.ray) : std::nullopt;
      if (t) out.corners.add(world_from_i.apply(normalized(x.ray) * *t), *t);
    }
    out.corners.looked_at = std::ssize(out.corners.x);
    if (std::ssize(brighter) >= kFewestGreys) out.brighter = median_of(std::move(brighter));
  });
  std::vector<double> exposures;
  for (const PairMatches& pair : found) {
    if (pair.brighter) exposures.push_back(std::abs(*pair.brighter));
    if (pair.matches < kFewestMatches) continue;
    ++all.pairs;
    all.matches += pair.matches;
    for (std::size_t m = 0; m < pair.fits.size(); ++m) {
      Reading& reading = all.readings[m];
      reading.fits += pair.fits[m];
      reading.better_pairs += pair.fits[m] > pair.fits[0] ? 1 : 0;
      reading.worse_pairs += pair.fits[m] < pair.fits[0] ? 1 : 0;
    }
    all.tracks.insert(all.tracks.end(), pair.tracks.begin(), pair.tracks.end());
    all.corners.append(pair.corners);
  }
  if (std::ssize(exposures) >= kFewestPairs) all.exposure = std::exp(median_of(std::move(exposures)));
  return all;
}

// The verdict in words.

constexpr double kFits = 0.03;        // relative error of depth that sensors and small pictures account for
constexpr double kContradicts = 0.1;  // where nothing fits: more than noise and things that move
constexpr double kFitsRounded = 0.25;
constexpr int kRounded = 32;        // different values of depth that is rounded to large steps
constexpr double kClearly = 4;      // times better than the convention given
constexpr int kFewestCorners = 60;  // matches of photographs that can speak
constexpr double kFewFit = 0.25;    // of them; matches by chance fit 2 to 10 %
constexpr double kByChance = 0.1;
constexpr double kPhotosClearly = 1.5;  // times as many
constexpr int kManyCorners = 300;       // so many cannot all be found wrongly
constexpr std::size_t kFewPairs = 3;

constexpr double kInOrder = 0.25;        // of the way between any two, at most, between neighbours of a recording
constexpr double kEdgesStronger = 1.02;  // times, where edges of depth lie elsewhere
constexpr double kEdgesBeside = 2;       // pixels of the small picture
constexpr const char* kFixRemedy = "`semfield prepare SCENE --out NEW` fixes them";

std::string percent(double share) {
  return share < 0.1 ? fmt::format("{:.2g} %", 100 * share) : fmt::format("{:.0f} %", 100 * share);
}

std::string plain_number(double value) { return fmt::format("{:.6g}", value); }

std::string pairs_text(int pairs) { return fmt::format("{} pair{} of frames", pairs, pairs == 1 ? "" : "s"); }

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
  const auto times_off = [](double large) {
    return fmt::format("{:.6g} times too {}", large < 1 ? 1 / large : large, large < 1 ? "small" : "large");
  };
  if (fits.pose_scale != given.pose_scale) {
    const double large = given.pose_scale / fits.pose_scale;
    out.what.push_back(fits.pose_scale == 1 ? "camera centres should not be scaled"
                       : large == 1000      ? "camera centres are in millimetres where depth is in metres"
                                            : "camera centres are " + times_off(large) + " for the depth");
    set("pose_scale", plain_number(fits.pose_scale));
  }
  if (fits.depth_scale != given.depth_scale) {
    const double large = given.depth_scale / fits.depth_scale;
    out.what.push_back(fits.depth_scale == 1 ? "depth should not be scaled"
                       : large == 0.001      ? "depth in metres was read as millimetres"
                       : large == 1000       ? "depth in millimetres was read as metres"
                                             : "depth is " + times_off(large) + " for the camera centres");
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

/// Depth over all frames looked at.
struct DepthSpread {
  double median = 0;
  int values = 0;  ///< different ones; few when metres were rounded to whole steps
};

// What is to be said of tallies of vote_by_depth: one sentence, and the error or the warning. `wide`: of wide_pairs,
// where depth that disagrees may be of other sides of things; a convention that fits speaks all the same.
std::string judge_depth(const DepthTallies& tallies, const SceneInfo& as_opened, const DepthSpread& range, bool wide,
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
    const std::string off = "depth warped between neighbouring frames is off by " + percent(given.error) + " as given";
    report(fits, given.convention, as_opened,
           fmt::format("{}, by {} so read (median over {})",
                       given.pairs == 0 ? "neighbouring frames do not meet as given" : off, percent(best->error),
                       pairs_text(best->pairs)),
           diagnostics);
    return "poses contradict depth";
  }
  if (given.pairs == 0) return "could not be checked: no two frames with depth overlap";
  const std::string numbers = "median error " + percent(given.error) + " over " + pairs_text(given.pairs);
  if (given.error > kContradicts && wide) return "could not be checked: few frames, far apart (" + numbers + ")";
  if (given.error > kContradicts && given.pairs >= 3) {
    diagnostics.warning(
        "scene.depth.disagrees", as_opened.name,
        fmt::format("poses and depth do not agree: depth warped between neighbouring frames is off by {} (median over "
                    "{}), and neither other axes, nor inverse poses, nor another unit explain it",
                    percent(given.error), pairs_text(given.pairs)),
        range.values <= kRounded ? fmt::format("depth has {} different values: export it in millimetres", range.values)
                                 : "check poses, intrinsics and the unit of depth");
    return "poses do not agree with depth: " + numbers;
  }
  if (!tells) return "could not be checked: the camera hardly moves (" + numbers + ")";
  return "poses agree with depth: " + numbers;
}

// The same of photographs without depth. Unit and scale do not show in them.
std::string judge_photos(const PhotoMatches& found, const SceneInfo& as_opened, Diagnostics& diagnostics) {
  const Reading& given = found.readings.front();
  const auto share = [&](const Reading& r) { return static_cast<double>(r.fits) / std::max(1, found.matches); };
  const auto clearly_better = [&](const Reading& r) {
    return share(r) > kPhotosClearly * share(given) && 2 * (r.better_pairs - r.worse_pairs) > found.pairs;
  };
  // Another image size counts only where it explains clearly more: by chance one of nine fits a little better.
  const auto counted = [&](const Reading& r) {
    return r.factor == 1 || (share(r) >= kFewFit && clearly_better(r)) ? r.fits : -1;
  };
  const Reading& best = *std::max_element(found.readings.begin(), found.readings.end(),
                                          [&](const Reading& a, const Reading& b) { return counted(a) < counted(b); });
  const std::string seen = std::to_string(found.matches) + " corners found again over " + pairs_text(found.pairs);
  if (found.matches < kFewestCorners || found.pairs < 3) return "could not be checked: no depth, and only " + seen;
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
    const std::string evidence =
        "of " + seen + ", " + percent(share(given)) + " lie where the poses put them as given, " + percent(share(best));
    if (best.factor == 1) {
      report(best.convention, given.convention, as_opened, evidence + " so read", diagnostics);
      return "poses contradict the photographs";
    }
    const bool large = best.factor > 1;
    const std::string factor = plain_number(large ? best.factor : 1 / best.factor);
    diagnostics.error("scene.camera.size", as_opened.name,
                      fmt::format("intrinsics are of images {} times as {}: {} with focal lengths {} by {}", factor,
                                  large ? "large" : "small", evidence, large ? "divided" : "multiplied", factor),
                      fmt::format("{} focal lengths and centre by {}, or state the size of the images that they belong "
                                  "to (scene.load.check_geometry: false takes the scene as it is)",
                                  large ? "divide" : "multiply", factor));
    return "the intrinsics contradict the photographs";
  }
  const std::string numbers = percent(share(given)) + " of " + seen + " lie where the poses put them";
  for (std::size_t i = 1; i < found.readings.size() && found.readings[i].factor == 1; ++i) {
    if (given.fits < kPhotosClearly * found.readings[i].fits)
      return "could not be checked: the camera hardly moves (" + numbers + ", and as many under another convention)";
  }
  return "poses agree with the photographs: " + numbers;
}

}  // namespace

struct GeometrySurvey::Impl {
  const SceneInfo& as_opened;
  std::vector<Camera> cameras;
  PoseConvention given;
  bool exposure;
  FramePairs pairs, wide = {};  // wide: of frames with depth, where there are hardly any others
  std::vector<bool> wanted = std::vector<bool>(as_opened.frames.size());
  std::vector<SmallFrame> depths = std::vector<SmallFrame>(as_opened.frames.size());
  std::vector<EdgeScores> edges = std::vector<EdgeScores>(as_opened.frames.size());
  std::vector<PhotoFrame> photos = std::vector<PhotoFrame>(as_opened.frames.size());

  Pose pose(std::size_t frame) const {
    return converted_pose(as_opened.frames[frame].world_from_camera, given, as_opened.opengl_files);
  }

  // The frames that tracks are of, as given, and in `frames` which they are.
  Bundle bundle_of(const PhotoMatches& found, std::vector<std::size_t>& frames) const {
    Bundle out;
    std::vector<std::int32_t> place(depths.size(), -1);
    for (const Track& track : found.tracks) {
      out.tracks.push_back(track);
      for (Sighting& s : out.tracks.back().seen) {
        const auto frame = static_cast<std::size_t>(s.frame);
        std::int32_t& at = place[frame];
        if (at < 0) {
          at = static_cast<std::int32_t>(frames.size());
          frames.push_back(frame);
          out.stated.push_back(cameras[frame]);
          out.given.push_back(pose(frame));
          out.lens_of.push_back(0);
        }
        s.frame = at;
      }
    }
    out.poses = out.given;
    out.lenses.resize(1);
    return out;
  }

  // Of the frames of bundle_of(), in its order, as they were so many frames later. Empty where frames are in no order
  // of time.
  std::vector<Pose> delayed_poses(const std::vector<std::size_t>& frames, double later) const {
    const std::vector<FrameInfo>& all = as_opened.frames;
    double step = 0, reach = 0;
    for (std::size_t i = 1; i < all.size(); ++i) {
      step += length(pose(i).t - pose(i - 1).t);
      reach += length(pose(i).t - pose((i * 7919) % all.size()).t);
    }
    if (step > kInOrder * reach) return {};
    std::vector<Pose> out;
    for (const std::size_t i : frames) {
      const double at = std::clamp(static_cast<double>(i) + later, 0.0, static_cast<double>(all.size() - 1));
      const auto before = static_cast<std::size_t>(at), after = std::min(before + 1, all.size() - 1);
      out.push_back(between(pose(before), pose(after), at - static_cast<double>(before)));
    }
    return out;
  }

  // Adds to the text, and warnings, what the photographs say of the cameras in pixels.
  void judge_cameras(GeometryVerdict& verdict, bool with_depth, Diagnostics& diagnostics) const {
    const CameraCheck& c = verdict.cameras;
    const std::string corners = std::to_string(c.corners) + " corners";
    if (c.off) {
      std::string text =
          "cameras do not fit the photographs: " + percent(c.given) + " of " + corners + " lie where they put them";
      for (const auto& [what, share] : c.fits) text += ", " + percent(share) + " with " + what;
      diagnostics.warning("scene.camera.off", as_opened.name, text, kFixRemedy);
      verdict.text =
          "cameras do not fit the photographs (" + percent(c.given) + " of " + corners + "); " + verdict.text;
    } else if (c.corners > 0 && with_depth) {  // else the text is of corners already
      verdict.text += "; " + percent(c.given) + " of " + corners + " found again lie where the cameras put them";
    }
    const std::optional<DepthShift> shift = depth_shift(edges, cameras);
    verdict.depth_beside = shift && shift->gain > kEdgesStronger && shift->steps >= kEdgesBeside;
    if (!verdict.depth_beside) return;
    const auto side = [](double px, const char* more, const char* less) {
      return px == 0 ? std::string() : plain_number(std::abs(px)) + " pixels " + (px > 0 ? more : less);
    };
    const std::string right = side(shift->right_px, "right", "left"), down = side(shift->down_px, "below", "above");
    const std::string text = "depth images are shifted against the photographs, whose edges are " + right +
                             (right.empty() || down.empty() ? "" : " and ") + down + " of those of depth";
    diagnostics.warning("scene.depth.beside", as_opened.name, text, kFixRemedy);
    verdict.text += "; depth images are shifted";
  }
};

GeometrySurvey::GeometrySurvey(const SceneInfo& as_opened, const std::vector<Camera>& cameras,
                               const PoseConvention& given, bool exposure)
    : impl_(new Impl{as_opened, cameras, given, exposure, choose_pairs(as_opened, cameras)}) {
  const bool has_depth =
      std::any_of(as_opened.frames.begin(), as_opened.frames.end(), [](const FrameInfo& f) { return f.has_depth; });
  if (has_depth && impl_->pairs.size() < kFewPairs) impl_->wide = wide_pairs(as_opened, cameras);
  for (const FramePairs* pairs : {&impl_->wide, &impl_->pairs})
    for (const auto& [a, b] : *pairs)
      impl_->wanted[static_cast<std::size_t>(a)] = impl_->wanted[static_cast<std::size_t>(b)] = true;
}

GeometrySurvey::~GeometrySurvey() = default;

void GeometrySurvey::look_at(std::size_t frame, const Camera& camera, const FrameBuffer& pixels) {
  if (!impl_->wanted[frame]) return;
  impl_->photos[frame] = photo_frame(camera, pixels);
  if (pixels.depth_m.empty()) return;
  impl_->edges[frame] = edge_scores(camera, pixels);
  impl_->depths[frame] = small_depth_frame(camera, pixels);
}

GeometryVerdict GeometrySurvey::conclude(Diagnostics& diagnostics) const {
  const Impl& all = *impl_;
  GeometryVerdict out;
  if (all.pairs.empty() && all.wide.empty()) {
    out.text = "could not be checked: no two frames look in a similar direction";
    return out;
  }
  std::vector<float> depths;
  for (const SmallFrame& frame : all.depths)
    depths.insert(depths.end(), frame.point_depths.begin(), frame.point_depths.end());
  PhotoMatches found = match_photos(all.as_opened, all.photos, all.pairs, all.given);
  if (all.exposure) out.exposure = found.exposure;
  std::vector<std::size_t> frames;
  Bundle bundle = all.bundle_of(found, frames);
  out.cameras = check_cameras(std::move(bundle), [&](double later) { return all.delayed_poses(frames, later); });
  const int before = diagnostics.error_count();
  if (depths.empty()) {
    out.text = judge_photos(found, all.as_opened, diagnostics);
    if (found.readings.front().fits >= kFewFit * found.matches) out.corners = std::move(found.corners);
  } else {
    std::sort(depths.begin(), depths.end());
    DepthSpread range{depths[depths.size() / 2], 0};
    range.values = static_cast<int>(std::unique(depths.begin(), depths.end()) - depths.begin());
    const bool wide = all.wide.size() > all.pairs.size();
    out.text = judge_depth(vote_by_depth(all.as_opened, all.depths, wide ? all.wide : all.pairs, all.given),
                           all.as_opened, range, wide, diagnostics);
  }
  if (diagnostics.error_count() == before) all.judge_cameras(out, !depths.empty(), diagnostics);
  return out;
}

}  // namespace semfield
