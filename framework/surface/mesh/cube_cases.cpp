// The case table of marching cubes, derived from one rule for a face.
#include <algorithm>
#include <array>
#include <optional>

#include "core/check.h"
#include "surface/mesh/marching_cubes.h"

namespace semfield {

namespace {

using Loop = std::vector<int>;  // numbers of cube edges, in order

int corner_at(int axis, int side, int u, int v) { return side << axis | u << (axis + 1) % 3 | v << (axis + 2) % 3; }

// The edge between two neighbouring corners.
int edge_between(int a, int b) {
  const int along = a ^ b;
  const int axis = along == 1 ? 0 : along == 2 ? 1 : 2;
  return 4 * axis + ((a >> (axis + 1) % 3) & 1) + 2 * ((a >> (axis + 2) % 3) & 1);
}

// Corners of a face, counter-clockwise seen from outside the cube.
std::array<int, 4> face_cycle(int axis, int side) {
  std::array<int, 4> cycle{corner_at(axis, side, 0, 0), corner_at(axis, side, 1, 0), corner_at(axis, side, 1, 1),
                           corner_at(axis, side, 0, 1)};
  if (side == 0) std::swap(cycle[1], cycle[3]);
  return cycle;
}

bool on_one_face(int edge_a, int edge_b) {
  const auto faces = [](int edge) {
    const int axis = edge / 4, u = edge & 1, v = edge >> 1 & 1;
    return std::array<int, 2>{2 * ((axis + 1) % 3) + u, 2 * ((axis + 2) % 3) + v};
  };
  for (const int a : faces(edge_a)) {
    for (const int b : faces(edge_b)) {
      if (a == b) return true;
    }
  }
  return false;
}

// Around every run of dense corners of a face goes one segment, from where the face's cycle leaves the run to where it
// entered it. An edge that is left on one face is entered on the other, so segments chain into loops.
std::vector<Loop> loops_of(int pattern) {
  std::array<int, 12> next;
  next.fill(-1);
  for (int face = 0; face < 6; ++face) {
    const std::array<int, 4> cycle = face_cycle(face / 2, face % 2);
    const auto dense = [&](int i) { return (pattern >> cycle[static_cast<std::size_t>(i & 3)] & 1) != 0; };
    const auto edge = [&](int i) {
      return edge_between(cycle[static_cast<std::size_t>(i & 3)], cycle[static_cast<std::size_t>((i + 1) & 3)]);
    };
    for (int i = 0; i < 4; ++i) {
      if (!dense(i) || dense(i + 1)) continue;
      int begin = i;
      while (dense(begin + 3)) begin += 3;  // one corner back
      next[static_cast<std::size_t>(edge(i))] = edge(begin + 3);
    }
  }
  std::vector<Loop> loops;
  std::array<bool, 12> seen{};
  for (int start = 0; start < 12; ++start) {
    if (next[static_cast<std::size_t>(start)] < 0 || seen[static_cast<std::size_t>(start)]) continue;
    Loop loop;
    for (int e = start; !seen[static_cast<std::size_t>(e)]; e = next[static_cast<std::size_t>(e)]) {
      seen[static_cast<std::size_t>(e)] = true;
      loop.push_back(e);
    }
    loops.push_back(std::move(loop));
  }
  return loops;
}

using Triangles = std::vector<std::array<std::uint8_t, 3>>;

// Triangles of loop[begin..end] (closed by the side end -> begin) without a diagonal in a face of the cube: there the
// neighbouring cube could have the same one, and the edge would have four triangles.
std::optional<Triangles> triangulate(const Loop& loop, std::size_t begin, std::size_t end) {
  if (end - begin < 2) return Triangles{};
  const auto allowed = [&](std::size_t a, std::size_t b) { return b - a == 1 || !on_one_face(loop[a], loop[b]); };
  for (std::size_t middle = begin + 1; middle < end; ++middle) {
    if (!allowed(begin, middle) || !allowed(middle, end)) continue;
    std::optional<Triangles> left = triangulate(loop, begin, middle);
    if (!left) continue;
    const std::optional<Triangles> right = triangulate(loop, middle, end);
    if (!right) continue;
    left->insert(left->end(), right->begin(), right->end());
    // The loop turns clockwise seen from the empty side.
    left->push_back({static_cast<std::uint8_t>(loop[end]), static_cast<std::uint8_t>(loop[middle]),
                     static_cast<std::uint8_t>(loop[begin])});
    return left;
  }
  return std::nullopt;
}

}  // namespace

const std::vector<CubeCase>& cube_cases() {
  static const std::vector<CubeCase> table = [] {
    std::vector<CubeCase> cases(256);
    for (int pattern = 0; pattern < 256; ++pattern) {
      for (const Loop& loop : loops_of(pattern)) {
        const std::optional<Triangles> triangles = triangulate(loop, 0, loop.size() - 1);
        SEMFIELD_CHECK(triangles, "every loop has triangles that keep off the cube's faces");
        auto& all = cases[static_cast<std::size_t>(pattern)].triangles;
        all.insert(all.end(), triangles->begin(), triangles->end());
      }
    }
    return cases;
  }();
  return table;
}

}  // namespace semfield
