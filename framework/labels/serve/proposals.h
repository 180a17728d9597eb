// Which click to propose next.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <iterator>
#include <optional>
#include <span>
#include <string_view>
#include <vector>

#include "surface/surface_graph.h"

namespace semfield {

/// Where `at` falls among sums of weights.
inline std::size_t place_in(const std::vector<double>& up_to, double at) {
  const auto found = std::upper_bound(up_to.begin(), up_to.end(), at) - up_to.begin();
  return static_cast<std::size_t>(std::min(found, std::ssize(up_to) - 1));
}

struct Asked {
  std::int32_t point = -1;  ///< of the pool
  double gain = 0;          ///< cells of the surface that it is expected to settle
  std::string_view why;     ///< "unseen" or "uncertain"
};

struct ProposalRules {
  float unseen = 8;            ///< a point this far from every click, or farther, is open
  float reach = 1.5;           ///< a click settles what it spreads to for this
  std::size_t most = 400;      ///< points that one click settles
  double area_power = 0.35;    ///< a region counts by this power of its area: small things have classes too
  double entropy_share = 0.2;  ///< of a point's doubt that the network's entropy shows; the rest is the way to a click
  double first_clicks = 20;    ///< e-fold of the clicks during which what looks unlike all clicked places is preferred
  double alike = 0.1;          ///< doubt of a point that looks just like a clicked place, while that counts
  double lightness_sigma = 0.2, chroma_sigma = 0.1,
         normal_sigma = 1;  ///< differences in colour (0 to 1) and of normals
  std::int64_t candidates = 256;
};

/// What a choice knows. `probability` [N, C] of the pool's points; empty while nothing is learned. `clicks`: how many
/// there are. `passed`: points that somebody did not want to name; `barred`: points that nobody shall name.
struct ProposalInput {
  const SurfacePool* pool = nullptr;
  const SurfaceGraph* graph = nullptr;
  std::span<const float> probability;
  std::int32_t classes = 0;
  std::size_t clicks = 0;
  std::span<const std::int32_t> passed;
  const std::vector<bool>* barred = nullptr;  ///< [N] points that are never proposed; null or empty: none
  std::uint64_t seed = 1, round = 0;
  ProposalRules rules{};
};

/// The click that would settle most: doubt summed over the surface that it would spread to. None for an empty pool.
std::optional<Asked> choose_click(const ProposalInput& input);

}  // namespace semfield
