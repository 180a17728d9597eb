// The distance from a point to the nearest triangle of a set, by a tree of boxes.
#pragma once

#include <cstdint>
#include <vector>

#include "surface/mesh/surface.h"

namespace semfield {

/// A triangle may have corners that are the same, so a set of points is one of triangles {i, i, i}.
class NearestSurface {
 public:
  NearestSurface(std::vector<Vec3d> positions, std::vector<Triangle> triangles);
  explicit NearestSurface(std::vector<Vec3d> points);

  /// To the nearest point of any triangle, in units of the world; `most` where none is nearer. From any thread.
  double distance(Vec3d point, double most) const;

 private:
  struct Node {
    Box box;
    std::uint32_t first = 0, end = 0;  // its triangles
    std::uint32_t second = 0;          // number of the second child, the first follows the node; 0: a leaf
  };
  std::uint32_t build(std::uint32_t first, std::uint32_t end);
  Vec3d middle(const Triangle& triangle) const;

  std::vector<Vec3d> positions_;
  std::vector<Triangle> triangles_;  // those of a node lie side by side
  std::vector<Node> nodes_;
};

}  // namespace semfield
