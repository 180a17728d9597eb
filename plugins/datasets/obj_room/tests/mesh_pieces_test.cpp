// Pieces of a mesh by class and touch.
#include <gtest/gtest.h>

#include "datasets/obj_room/mesh_io.h"

namespace semfield {
namespace {

// Squares of 20 cm on the floor, of two triangles each.
TriangleMesh squares(const std::vector<float>& at_x) {
  TriangleMesh mesh;
  for (const float x : at_x) {
    const auto first = static_cast<std::uint32_t>(mesh.positions.size());
    for (const auto& [dx, dy] : {std::pair{0.0F, 0.0F}, {0.2F, 0.0F}, {0.2F, 0.2F}, {0.0F, 0.2F}})
      mesh.positions.push_back({x + dx, dy, 0});
    mesh.triangles.push_back({first, first + 1, first + 2});
    mesh.triangles.push_back({first, first + 2, first + 3});
  }
  return mesh;
}

TEST(MeshPieces, WhatIsOfOneClassAndTouchesIsOne) {
  const TriangleMesh mesh = squares({0, 0.2F, 0.6F, 0.8F});
  EXPECT_EQ(pieces_of(mesh, {1, 1, 1, 1, 1, 1, 2, 2}, 0.03), (std::vector<std::int32_t>{0, 0, 0, 0, 1, 1, 2, 2}));
}

TEST(MeshPieces, PlanesThatMeetInNoCornerTouchToo) {
  TriangleMesh mesh = squares({0, 10});
  for (std::size_t k = 4; k < 8; ++k) mesh.positions[k] = mesh.positions[k - 4] * 0.2F + Vec3f{0.08F, 0.08F, 0.01F};
  EXPECT_EQ(pieces_of(mesh, {1, 1, 1, 1}, 0.03), (std::vector<std::int32_t>{0, 0, 0, 0}));
}

}  // namespace
}  // namespace semfield
