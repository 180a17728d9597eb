// Which click to ask for next.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <string_view>
#include <vector>

#include "config/params.h"
#include "serve/point_learner.h"
#include "serve/surface_pool.h"

namespace semfield {

/// Ways to choose: the page uses `surface`, the others are what it is compared with.
///   random    any pixel of any view;
///   farthest  the point farthest from earlier clicks;
///   entropy   the largest entropy;
///   margin    the smallest lead of the first class over the second;
///   surface   uncertainty summed over the surface that a click would settle.
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

/// What a choice knows. `rows` [N, dims] and `probability` [N, C] of the pool's points; empty while nothing is learned.
/// `answered`: places of earlier clicks and of those that were passed over.
struct ProposalInput {
  const SurfacePool* pool = nullptr;
  const PointRows* rows = nullptr;
  std::span<const float> probability;
  std::int32_t classes = 0;
  std::span<const Vec3d> answered;
  std::span<const float> answered_color;  ///< [answered, 3]
  std::uint64_t seed = 1, round = 0;
};

/// None for an empty pool.
std::optional<Asked> choose_click(Acquisition how, const ProposalInput& input);

}  // namespace semfield
