// Which click to propose next.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <string_view>
#include <vector>

#include "config/params.h"
#include "surface/surface_graph.h"
#include "surface/surface_pool.h"

namespace semfield {

/// Ways to choose: the page uses `surface`, the others are what it is compared with.
///   random    any pixel of any view;
///   farthest  the point farthest from earlier clicks;
///   entropy   the largest entropy;
///   margin    the smallest lead of the first class over the second;
///   surface   what a click would settle: doubt summed over the surface that it would spread to.
enum class Acquisition : std::uint8_t { random, farthest, entropy, margin, surface };
template <>
struct ChoiceNames<Acquisition> {
  static constexpr std::array<std::string_view, 5> names{"random", "farthest", "entropy", "margin", "surface"};
};

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
  double entropy_share = 0.8;  ///< of a point's doubt that the network's entropy shows; the rest is the way to a click
  std::int64_t candidates = 256;
};

/// What a choice knows. `probability` [N, C] of the pool's points; empty while nothing is learned. `answered`: places
/// of earlier clicks; `passed`: points that somebody did not want to name; `barred`: points that nobody shall name.
struct ProposalInput {
  const SurfacePool* pool = nullptr;
  const SurfaceGraph* graph = nullptr;
  std::span<const float> probability;
  std::int32_t classes = 0;
  std::span<const Vec3d> answered;
  std::span<const std::int32_t> passed;
  const std::vector<bool>* barred = nullptr;  ///< [N] points that are never proposed; null or empty: none
  std::uint64_t seed = 1, round = 0;
  ProposalRules rules{};
};

/// None for an empty pool.
std::optional<Asked> choose_click(Acquisition how, const ProposalInput& input);

}  // namespace semfield
