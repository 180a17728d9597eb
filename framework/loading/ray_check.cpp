// Rays of the training frames against bounds, near and far.
#include "loading/ray_check.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

namespace semfield {

namespace {

constexpr std::size_t kFrames = 64;
constexpr int kColumns = 12, kRows = 9;
constexpr double kFew = 0.05;

std::string number(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%.4g", value);
  return text;
}

std::string box_text(const Box& box) {
  std::string out;
  for (const Vec3d& corner : {box.lo, box.hi}) {
    for (int a = 0; a < 3; ++a) out += (out.empty() ? "[" : ",") + number(corner[a]);
  }
  return out + "]";
}

struct RayCounts {
  int rays = 0, meet_box = 0, sampled = 0;
  double nearest = 1e300, farthest = 0;  ///< where rays are inside of the box
};

RayCounts count_rays(const LoadedScene& scene, const std::vector<int>& usable) {
  RayCounts out;
  const std::size_t frames = std::min(usable.size(), kFrames);
  for (std::size_t k = 0; k < frames; ++k) {
    const FrameInfo& frame = scene.info.frames[static_cast<std::size_t>(usable[k * usable.size() / frames])];
    for (int i = 0; i < kColumns * kRows; ++i) {
      const Vec3d local = frame.camera.direction((i % kColumns + 0.5) * frame.camera.width_px / kColumns,
                                                 (i / kColumns + 0.5) * frame.camera.height_px / kRows);
      if (!(frame.camera.depth_of(local) > 0)) continue;  // no ray
      ++out.rays;
      double enters = 0, leaves = 0;
      if (!intersect(scene.bounds, frame.world_from_camera.t, frame.world_from_camera.rotate(local), enters, leaves))
        continue;
      ++out.meet_box;
      out.nearest = std::min(out.nearest, enters);
      out.farthest = std::max(out.farthest, leaves);
      if (std::max(enters, scene.near_m) < std::min(leaves, scene.far_m)) ++out.sampled;
    }
  }
  return out;
}

// An error where the share is 0, else a warning.
void report(Code code, double share, const std::string& key, const std::string& what, const std::string& remedy,
            Diagnostics& diagnostics) {
  if (share == 0) {
    diagnostics.error(code, key, "none of " + what, remedy);
  } else {
    diagnostics.warning(code, key, "only " + number(std::max(0.1, std::round(1000 * share) / 10)) + " % of " + what,
                        remedy);
  }
}

std::string set_near_far(double near, double far) {
  return "add --set scene.load.near_m=" + number(near) + " --set scene.load.far_m=" + number(far);
}

}  // namespace

void check_rays(const LoadedScene& scene, const std::vector<int>& usable, const SeenExtent& seen,
                Diagnostics& diagnostics) {
  const RayCounts counts = count_rays(scene, usable);
  const auto share = [&](int some) { return static_cast<double>(some) / std::max(1, counts.rays); };
  const std::string span =
      "near " + number(scene.near_m) + " and far " + number(scene.far_m) + " (from " + scene.near_far_from + ")";
  const bool box_met = share(counts.meet_box) >= kFew;
  if (counts.rays > 0 && !box_met && !seen.taken) {
    return report("scene.bounds.missed", share(counts.meet_box), "scene.load.bounds",
                  "the rays of the training cameras can meet the bounds " + box_text(scene.bounds) + " (from " +
                      scene.bounds_from + ")",
                  "the data suggest --set 'scene.load.bounds=" + box_text(seen.box) + "'", diagnostics);
  }
  if (!seen.distances.empty()) {
    const auto inside = std::count_if(seen.distances.begin(), seen.distances.end(),
                                      [&](float t) { return t >= scene.near_m && t <= scene.far_m; });
    const double part = static_cast<double>(inside) / static_cast<double>(seen.distances.size());
    const auto [nearest, farthest] = std::minmax_element(seen.distances.begin(), seen.distances.end());
    if (part < kFew) {
      return report("scene.bounds.near_far", part, "scene.load.near_m",
                    "the depth of the training frames is between " + span,
                    "depth lies from " + number(*nearest) + " to " + number(*farthest) + ": " +
                        set_near_far(0.5 * *nearest, 1.05 * *farthest),
                    diagnostics);
    }
  }
  if (box_met && share(counts.sampled) < kFew) {
    report("scene.bounds.near_far", share(counts.sampled), "scene.load.near_m",
           "the rays of the training cameras can be inside the bounds between " + span,
           "rays are inside from " + number(counts.nearest) + " to " + number(counts.farthest) + ": " +
               set_near_far(std::max(counts.nearest, 0.01 * counts.farthest), counts.farthest),
           diagnostics);
  }
}

}  // namespace semfield
