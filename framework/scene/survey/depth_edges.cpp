#include "scene/survey/depth_edges.h"

#include <algorithm>
#include <cmath>

#include "scene/survey/photo_votes.h"

namespace semfield {

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
