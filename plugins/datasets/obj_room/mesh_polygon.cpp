// Polygons into triangles by ear clipping.
#include <cmath>

#include "datasets/obj_room/mesh_io.h"

namespace semfield {

std::vector<std::array<int, 3>> triangulate_polygon(const std::vector<Vec3f>& corners) {
  const int n = static_cast<int>(corners.size());
  std::vector<std::array<int, 3>> out;
  if (n == 3) return {{0, 1, 2}};
  // Newell's normal: its largest component is the axis to drop.
  Vec3d normal{};
  for (int i = 0; i < n; ++i) {
    const Vec3f p = corners[static_cast<std::size_t>(i)], q = corners[static_cast<std::size_t>((i + 1) % n)];
    normal.x += static_cast<double>(p.y - q.y) * (p.z + q.z);
    normal.y += static_cast<double>(p.z - q.z) * (p.x + q.x);
    normal.z += static_cast<double>(p.x - q.x) * (p.y + q.y);
  }
  int drop = 0;
  if (std::abs(normal.y) > std::abs(normal[drop])) drop = 1;
  if (std::abs(normal.z) > std::abs(normal[drop])) drop = 2;
  const int ax = (drop + 1) % 3, ay = (drop + 2) % 3;
  const double sign = normal[drop] < 0 ? -1 : 1;
  const auto turn = [&](int a, int b, int c) {  // > 0: left turn seen along the normal
    const Vec3f &p = corners[static_cast<std::size_t>(a)], &q = corners[static_cast<std::size_t>(b)],
                &r = corners[static_cast<std::size_t>(c)];
    return sign * ((static_cast<double>(q[ax]) - p[ax]) * (static_cast<double>(r[ay]) - p[ay]) -
                   (static_cast<double>(q[ay]) - p[ay]) * (static_cast<double>(r[ax]) - p[ax]));
  };
  std::vector<int> ring;
  for (int i = 0; i < n; ++i) ring.push_back(i);
  while (ring.size() > 3) {
    const std::size_t m = ring.size();
    std::size_t ear = m;
    for (std::size_t i = 0; i < m && ear == m; ++i) {
      const int a = ring[(i + m - 1) % m], b = ring[i], c = ring[(i + 1) % m];
      if (turn(a, b, c) <= 0) continue;
      bool clear = true;
      for (std::size_t k = 0; k < m && clear; ++k) {
        const int p = ring[k];
        if (p == a || p == b || p == c) continue;
        clear = !(turn(a, b, p) >= 0 && turn(b, c, p) >= 0 && turn(c, a, p) >= 0);
      }
      if (clear) ear = i;
    }
    if (ear == m) break;  // crosses itself or is flat: a fan of what is left
    out.push_back({ring[(ear + m - 1) % m], ring[ear], ring[(ear + 1) % m]});
    ring.erase(ring.begin() + static_cast<std::ptrdiff_t>(ear));
  }
  for (std::size_t i = 1; i + 1 < ring.size(); ++i) out.push_back({ring[0], ring[i], ring[i + 1]});
  return out;
}

}  // namespace semfield
