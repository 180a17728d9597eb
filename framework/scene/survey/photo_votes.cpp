// Corners after Shi and Tomasi [Shi94], patches compared by zero-mean normalised cross-correlation, and how far from
// its epipolar line each is found.
#include "scene/survey/photo_votes.h"

#include <algorithm>
#include <cmath>

#include "compute/parallel.h"

namespace semfield {

namespace {

constexpr std::int32_t kCell = 16;  // pixels; one corner each
constexpr std::size_t kCorners = 300;
constexpr int kReach = 8;           // half the side of a patch, pixels
constexpr float kWeakest = 500;     // strength of a corner, grey steps squared
constexpr float kAlike = 0.75f;     // correlation of a match
constexpr float kAmbiguous = 0.9f;  // of (1 - best) / (1 - second)
constexpr double kOff = 1.5;        // pixels of the small picture
constexpr int kFewestMatches = 12;
constexpr double kLeastParallax = 0.02;  // radians between two rays that meet; a pixel of the small picture is 0.004
constexpr int kFewestGreys = 8, kFewestPairs = 8;
constexpr double kDark = 4;  // grey steps: darker ones say little of a factor
constexpr double kFocalFactors[] = {0.125, 0.25, 1.0 / 3, 0.5, 2, 3, 4, 6, 8};

// Sums over 5 x 5 pixels of a picture, by running sums; the outermost two rows and columns stay 0.
std::vector<float> box_sums(const std::vector<float>& in, std::int32_t width, std::int32_t height) {
  const auto at = [width](std::int32_t x, std::int32_t y) {
    return static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x);
  };
  std::vector<float> rows(in.size()), out(in.size());
  for (std::int32_t y = 0; y < height; ++y) {
    for (std::int32_t x = 2; x < width - 2; ++x) {
      const float* p = in.data() + at(x, y);
      rows[at(x, y)] = p[-2] + p[-1] + p[0] + p[1] + p[2];
    }
  }
  for (std::int32_t y = 2; y < height - 2; ++y) {
    for (std::int32_t x = 2; x < width - 2; ++x) {
      out[at(x, y)] =
          rows[at(x, y - 2)] + rows[at(x, y - 1)] + rows[at(x, y)] + rows[at(x, y + 1)] + rows[at(x, y + 2)];
    }
  }
  return out;
}

// The smaller eigenvalue of the sum of gradient products over 5 x 5 pixels [Shi94].
Grey corner_strength(const Grey& g) {
  std::vector<float> xx(g.value.size()), yy(g.value.size()), xy(g.value.size());
  for (std::int32_t y = 1; y < g.height - 1; ++y) {
    for (std::int32_t x = 1; x < g.width - 1; ++x) {
      const std::size_t i =
          static_cast<std::size_t>(y) * static_cast<std::size_t>(g.width) + static_cast<std::size_t>(x);
      const float dx = g.at(x + 1, y) - g.at(x - 1, y), dy = g.at(x, y + 1) - g.at(x, y - 1);
      xx[i] = dx * dx;
      yy[i] = dy * dy;
      xy[i] = dx * dy;
    }
  }
  xx = box_sums(xx, g.width, g.height);
  yy = box_sums(yy, g.width, g.height);
  xy = box_sums(xy, g.width, g.height);
  Grey out{g.width, g.height, std::move(xx)};
  for (std::size_t i = 0; i < xy.size(); ++i) {
    const float sum = out.value[i] + yy[i], off = out.value[i] - yy[i];
    out.value[i] = 0.5f * (sum - std::sqrt(off * off + 4 * xy[i] * xy[i]));
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

}  // namespace

std::int32_t photo_step(const Camera& camera) {
  return std::max(1, (std::max(camera.width_px, camera.height_px) + kPhotoSide / 2) / kPhotoSide);
}

Grey grey_of(const FrameBuffer& frame, std::int32_t side) {
  Grey out{frame.width_px / side, frame.height_px / side, {}};
  out.value.resize(static_cast<std::size_t>(out.width) * static_cast<std::size_t>(out.height));
  for (std::int32_t y = 0; y < out.height * side; ++y) {
    const std::uint8_t* p = frame.rgb.data() + static_cast<std::ptrdiff_t>(y) * frame.width_px * 3;
    float* row = out.value.data() + static_cast<std::ptrdiff_t>(y / side) * out.width;
    for (std::int32_t x = 0; x < out.width * side; ++x, p += 3) {
      row[x / side] += static_cast<float>(77 * p[0] + 150 * p[1] + 29 * p[2]);  // of 256
    }
  }
  for (float& v : out.value) v /= static_cast<float>(256 * side * side);
  return out;
}

PhotoFrame photo_frame(const Camera& camera, const FrameBuffer& frame) {
  const std::int32_t side = photo_step(camera);
  const Grey g = grey_of(frame, side);
  const Grey strengths = corner_strength(g);
  struct Found {
    float strength;
    std::int32_t x, y;
  };
  std::vector<Found> found;
  for (std::int32_t cy = kReach; cy + kReach < g.height; cy += kCell) {
    for (std::int32_t cx = kReach; cx + kReach < g.width; cx += kCell) {
      Found best{kWeakest, 0, 0};
      for (std::int32_t y = cy; y < std::min(cy + kCell, g.height - kReach); ++y) {
        for (std::int32_t x = cx; x < std::min(cx + kCell, g.width - kReach); ++x) {
          if (strengths.at(x, y) > best.strength) best = {strengths.at(x, y), x, y};
        }
      }
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

namespace {

// What one pair of frames says.
struct Votes {
  int matches = 0;
  std::vector<Track> tracks;
  std::vector<int> fits, focal_fits;  // of each convention, of each factor
  SurveyPoints corners;
  std::optional<double> brighter;  // median logarithm of the second frame's brightness over the first's
};

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

template <class T>
T median_of(std::vector<T> values) {
  const auto middle = values.begin() + std::ssize(values) / 2;
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

std::optional<double> brighter_by(const Matches& matches, const PhotoFrame& a, const PhotoFrame& b,
                                  const Pose& b_from_a) {
  std::vector<double> logs;
  for (const auto& [i, j] : matches) {
    if (off_epipolar_line(a.corners[i].ray, b_from_a, b.corners[j].ray, b.camera) < kOff)
      logs.push_back(std::log((b.corners[j].grey + kDark) / (a.corners[i].grey + kDark)));
  }
  if (std::ssize(logs) < kFewestGreys) return {};
  return median_of(std::move(logs));
}

// Where two rays are nearest to each other, for each match that fits.
SurveyPoints meeting_points(const Matches& matches, const PhotoFrame& a, const PhotoFrame& b, const Pose& b_from_a,
                            const Pose& world_from_a) {
  SurveyPoints out;
  for (const auto& [i, j] : matches) {
    const Vec3d ray = a.corners[i].ray, seen = b.corners[j].ray;
    if (off_epipolar_line(ray, b_from_a, seen, b.camera) >= kOff) continue;
    const Vec3d d = normalized(ray), e = normalized(b_from_a.unrotate(seen));  // in the axes of a
    const Vec3d to_b = b_from_a.unrotate(b_from_a.t) * -1.0;
    const double cosine = dot(d, e), apart = 1 - cosine * cosine;
    if (apart < kLeastParallax * kLeastParallax) continue;
    const double t = (dot(d, to_b) - cosine * dot(e, to_b)) / apart;
    if (!(t > 0) || !(cosine * t > dot(e, to_b))) continue;  // behind one of the two
    const Vec3d p = world_from_a.apply(d * t);
    out.x.push_back(static_cast<float>(p.x));
    out.y.push_back(static_cast<float>(p.y));
    out.z.push_back(static_cast<float>(p.z));
    out.distance.push_back(static_cast<float>(t));
    ++out.looked_at;
  }
  return out;
}

void append(std::vector<float>& to, const std::vector<float>& from) { to.insert(to.end(), from.begin(), from.end()); }

}  // namespace

PhotoTallies vote_by_photos(const SceneInfo& as_opened, const std::vector<PhotoFrame>& frames, const FramePairs& pairs,
                            const PoseConvention& given) {
  const std::vector<PoseConvention> all = conventions(given);
  std::vector<Votes> votes(pairs.size());
  parallel_for(std::ssize(pairs), [&](std::int64_t p) {
    Votes& out = votes[static_cast<std::size_t>(p)];
    const auto i = static_cast<std::size_t>(pairs[static_cast<std::size_t>(p)].first);
    const auto j = static_cast<std::size_t>(pairs[static_cast<std::size_t>(p)].second);
    const Matches matches = matches_of(frames[i].corners, frames[j].corners);
    out.matches = static_cast<int>(matches.size());
    if (out.matches < kFewestMatches) return;
    for (const auto& [a, b] : matches) {
      const PhotoCorner &x = frames[i].corners[a], &y = frames[j].corners[b];
      out.tracks.push_back({{}, {{static_cast<std::int32_t>(i), x.u, x.v}, {static_cast<std::int32_t>(j), y.u, y.v}}});
    }
    for (const PoseConvention& convention : all)
      out.fits.push_back(count_fits(matches, frames[i], frames[j], relative_pose(as_opened, convention, j, i), 1));
    const Pose j_from_i = relative_pose(as_opened, given, j, i);
    for (const double factor : kFocalFactors)
      out.focal_fits.push_back(count_fits(matches, frames[i], frames[j], j_from_i, factor));
    out.brighter = brighter_by(matches, frames[i], frames[j], j_from_i);
    const FrameInfo& frame = as_opened.frames[i];
    if (frame.split == Split::train && as_opened.frames[j].split == Split::train) {
      out.corners = meeting_points(matches, frames[i], frames[j], j_from_i,
                                   converted_pose(frame.world_from_camera, given, as_opened.opengl_files));
    }
  });
  PhotoTallies out;
  for (const PoseConvention& convention : all) out.tallies.push_back({convention, 0, 0, 0});
  for (const double factor : kFocalFactors) out.focal.push_back({factor, 0, 0, 0});
  std::vector<double> exposures;
  for (const Votes& pair : votes) {
    if (pair.brighter) exposures.push_back(std::abs(*pair.brighter));
    if (pair.matches < kFewestMatches) continue;
    ++out.pairs;
    out.matches += pair.matches;
    out.tracks.insert(out.tracks.end(), pair.tracks.begin(), pair.tracks.end());
    const auto add = [&pair](auto& tally, int fits) {
      tally.fits += fits;
      tally.better_pairs += fits > pair.fits[0] ? 1 : 0;
      tally.worse_pairs += fits < pair.fits[0] ? 1 : 0;
    };
    for (std::size_t m = 0; m < all.size(); ++m) add(out.tallies[m], pair.fits[m]);
    for (std::size_t m = 0; m < out.focal.size(); ++m) add(out.focal[m], pair.focal_fits[m]);
    append(out.corners.x, pair.corners.x);
    append(out.corners.y, pair.corners.y);
    append(out.corners.z, pair.corners.z);
    append(out.corners.distance, pair.corners.distance);
    out.corners.looked_at += pair.corners.looked_at;
  }
  if (std::ssize(exposures) >= kFewestPairs) out.exposure = std::exp(median_of(std::move(exposures)));
  return out;
}

}  // namespace semfield
