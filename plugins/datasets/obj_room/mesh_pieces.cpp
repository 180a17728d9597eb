#include "datasets/obj_room/mesh_pieces.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <numeric>
#include <tuple>

namespace semfield {

namespace {

// Sets of triangles that are joined; the least number stands for a set.
class Sets {
 public:
  explicit Sets(std::size_t count) : up_(count) { std::iota(up_.begin(), up_.end(), 0U); }
  std::uint32_t of(std::uint32_t i) {
    while (up_[i] != i) i = up_[i] = up_[up_[i]];
    return i;
  }
  void join(std::uint32_t a, std::uint32_t b) {
    const std::uint32_t x = of(a), y = of(b);
    up_[std::max(x, y)] = std::min(x, y);
  }

 private:
  std::vector<std::uint32_t> up_;
};

}  // namespace

std::vector<std::int32_t> pieces_of(const TriangleMesh& mesh, const std::vector<std::int16_t>& class_of, double gap_m) {
  using Cell = std::tuple<std::int16_t, int, int, int>;
  std::map<Cell, std::uint32_t> first;  // triangle of a class in a cell
  Sets sets(mesh.size());
  const auto corner = [&](std::size_t t, std::size_t k) {
    const Vec3f p = mesh.positions[mesh.triangles[t][k]];
    return Vec3d{static_cast<double>(p.x), static_cast<double>(p.y), static_cast<double>(p.z)};
  };
  for (std::size_t t = 0; t < mesh.size(); ++t) {
    const Vec3d a = corner(t, 0), ab = corner(t, 1) - a, ac = corner(t, 2) - a;
    const auto n = static_cast<int>(
        std::clamp(std::ceil(std::max({length(ab), length(ac), length(ac - ab)}) / gap_m), 1.0, 1000.0));
    for (int i = 0; i <= n; ++i) {
      for (int j = 0; i + j <= n; ++j) {
        const Vec3d p = a + ab * (static_cast<double>(i) / n) + ac * (static_cast<double>(j) / n);
        const Cell cell{class_of[t], static_cast<int>(std::floor(p.x / gap_m)),
                        static_cast<int>(std::floor(p.y / gap_m)), static_cast<int>(std::floor(p.z / gap_m))};
        const auto [found, fresh] = first.emplace(cell, static_cast<std::uint32_t>(t));
        if (!fresh) sets.join(found->second, static_cast<std::uint32_t>(t));
      }
    }
  }
  for (const auto& [cell, t] : first) {
    const auto [c, x, y, z] = cell;
    for (int step = 14; step < 27; ++step) {  // half of the 26 cells around it
      const auto other = first.find({c, x + step / 9 - 1, y + step / 3 % 3 - 1, z + step % 3 - 1});
      if (other != first.end()) sets.join(t, other->second);
    }
  }
  std::map<std::uint32_t, std::int32_t> number;
  std::vector<std::int32_t> piece;
  for (std::uint32_t t = 0; t < mesh.size(); ++t)
    piece.push_back(number.emplace(sets.of(t), static_cast<std::int32_t>(number.size())).first->second);
  return piece;
}

}  // namespace semfield
