// The things that a picture shows: regions of like colour on one surface, joined pair by pair into a tree, whose nodes
// are what a click may mean.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "surface/surface_graph.h"

namespace semfield {

/// A picture with what is known of the surface in it.
struct ThingPicture {
  std::int32_t width_px = 0, height_px = 0;
  std::span<const std::uint8_t> rgb;     ///< [height * width * 3]
  const SeenSurface* surface = nullptr;  ///< over the same field of view, of any size; null: colours alone say all
  /// [height * width] what a segmenter saw, 0 where it saw nothing; empty without one. Where two meet is a border.
  std::span<const std::int32_t> segment = {};
};

/// Pixels that are one thing.
struct Thing {
  std::vector<bool> mask;              ///< [height * width]
  int level = 0, least = 0, most = 0;  ///< the level taken, and those that there are
  double share = 0;                    ///< of the picture
};

/// Small regions (Felzenszwalb and Huttenlocher's, [Felzenszwalb04]) joined in the order of how little parts them:
/// steps of colour along their border and between their means, angles and offsets of their planes. What weighs how much
/// was learned from drawn instances of a real office and a modelled room. The same for the same picture.
class ThingTree {
 public:
  explicit ThingTree(const ThingPicture& picture);

  std::int32_t width_px() const { return width_px_; }
  std::int32_t height_px() const { return height_px_; }

  /// The thing at `also[0]`, `level` steps larger (above 0) or smaller than what it most likely is, with those parts
  /// that the other places of `also` name and without those that `without` names. Places lie in the picture; `also` is
  /// not empty.
  Thing choose(std::span<const PixelPlace> also, std::span<const PixelPlace> without, int level) const;

 private:
  // Sums over the pixels of a node.
  struct Region {
    double pixels = 0, rim = 0;     // rim: on the edge of the picture
    double seen = 0, distance = 0;  // of pixels whose place is known
    Vec3d color, square, place, normal;
    std::array<std::int32_t, 4> box{1 << 30, 1 << 30, -1, -1};  // least and most column and row
    void add(const Region& other);
  };
  // Sums over pairs of pixels on both sides.
  struct Border {
    double length = 0, step = 0, clear = 0;  // clear: pairs of which anybody would say that they are apart
    double segments = 0;                     // pairs in two segments less those in one
    void add(const Border& other);
  };
  struct Node {
    Region region;
    std::int32_t parent = -1;
    double cost = 0;                             // of joining its two parts, at least that of joining theirs
    double outline = 0;                          // mean cost of joining it with what touches it
    std::int32_t first_leaf = 0, last_leaf = 0;  // places of its leaves in the order of the tree, the last one excluded
    std::array<std::int32_t, 2> parts{-1, -1};
  };
  struct Pixel;
  struct Pair {
    std::int32_t a = 0, b = 0;
    Border border;
  };
  std::vector<Pixel> pixels_of(const ThingPicture& picture) const;
  void find_regions(const std::vector<Pixel>& pixels);
  std::vector<Pair> find_borders(const std::vector<Pixel>& pixels);
  void join(std::vector<Pair> pairs);
  void order_leaves();
  double cost_of(const Region& a, const Region& b, const Border& border) const;

  const Node& node(std::int32_t n) const { return nodes_[static_cast<std::size_t>(n)]; }
  std::int32_t leaf_at(const PixelPlace& at) const {
    return leaf_[static_cast<std::size_t>(std::int64_t{at.row} * width_px_ + at.column)];
  }
  bool holds(std::int32_t n, std::int32_t leaf) const {
    const std::int32_t place = node(leaf).first_leaf;
    return place >= node(n).first_leaf && place < node(n).last_leaf;
  }
  double inside(std::int32_t n, const PixelPlace& at) const;
  double likelihood(std::int32_t n, const PixelPlace& at) const;
  std::vector<std::int32_t> levels_of(std::int32_t n, std::int32_t leaf) const;

  std::int32_t width_px_, height_px_;
  std::int32_t reach_px_;           // of colours that are compared across a border
  std::vector<std::int32_t> leaf_;  // of each pixel
  std::vector<Node> nodes_;         // leaves first, parents behind their parts
  std::int32_t leaves_ = 0;
};

}  // namespace semfield
