// Where on the surface the pixels lie that clicks and strokes name: found once, and kept while the labels change.
#pragma once

#include <cstdint>
#include <span>
#include <unordered_map>
#include <vector>

#include "surface/surface_graph.h"

namespace semfield {

/// Pixels of a view that somebody has named: a click or a stroke.
struct LabelledPixels {
  int view = 0;
  std::int16_t class_index = 0;
  std::vector<PixelPlace> pixels;
  double weight = 1;  ///< below 1: given by the configuration, and a click may say otherwise
};

/// A stroke says itself what it covers; a click, which has fewer pixels, names what looks alike around it too.
inline constexpr std::size_t kMostClickPixels = 9;
inline bool is_stroke(const LabelledPixels& named) { return named.pixels.size() > kMostClickPixels; }

class NamedPlaces {
 public:
  /// `reach_px`: how far a click names what looks alike, in an image 320 pixels wide.
  explicit NamedPlaces(std::int32_t reach_px) : reach_px_(reach_px) {}

  /// What places are found by. Borrowed for a call.
  struct Surface {
    Pipeline<float>& pipeline;
    const RayLimits& limits;
    std::span<const PoolView> views;
    const SurfacePool& pool;
  };
  /// Finds places that are not known yet of `clicks`, which take the place of those of the last call, for about
  /// `budget_s` and at least of one click. True when those of all are known.
  bool find(std::span<const LabelledPixels> clicks, const Surface& surface, double budget_s);
  /// The surface has moved: what is known stays until refresh() has found it anew.
  void renew() { ++age_; }
  /// Finds old places of the last find()'s clicks anew, for about `budget_s`.
  void refresh(std::span<const LabelledPixels> clicks, const Surface& surface, double budget_s);

  /// Of click `i` of the last find(): its places, its first pixel's first where that meets a surface; empty where
  /// nothing is met or nothing is known yet. A stroke has one in each cell of the pool.
  std::span<const Vec3d> of(std::size_t i) const;
  /// Clicks whose places have been looked for so far, each time counted.
  std::int64_t found() const { return found_; }

 private:
  struct Known {
    std::vector<Vec3d> places;
    std::uint64_t age = 0;   // when it was found; 0: not yet
    std::uint64_t turn = 0;  // find() that wanted it last
  };
  std::vector<PixelPlace> pixels_of(const LabelledPixels& click, const Surface& surface) const;
  void look_for(Known& known, const LabelledPixels& click, const Surface& surface);

  std::int32_t reach_px_;
  std::uint64_t age_ = 1, turn_ = 0;
  std::int64_t found_ = 0;
  std::unordered_map<std::uint64_t, Known> known_;  // by a checksum of view and pixels
  std::vector<std::uint64_t> keys_;                 // of the clicks
};

}  // namespace semfield
