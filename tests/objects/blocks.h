// A small set of objects: blocks of cells in a row.
#pragma once

#include <cstddef>

#include "objects/object_set.h"

namespace semfield::testing_objects {

inline constexpr double kCell = 0.1;

// Points of blocks along x, one per cell: object 1 has a block of 6 x 4 cells, a bridge of one row of 5 cells and a
// block of 4 x 4 cells; object 2 two blocks of 4 x 4 and of 3 x 4 that do not touch, and one cell alone; object 3 a
// block.
inline ObjectSet blocks() {
  ObjectSet set;
  set.cells = SurfaceCells(kCell);
  set.about = R"({"run": "room"})";
  const auto block = [&](std::int32_t object, int x0, int wide, int y0, int tall, std::int16_t of_class) {
    for (int x = x0; x < x0 + wide; ++x) {
      for (int y = y0; y < y0 + tall; ++y) {
        set.position.push_back({(x + 0.5) * kCell, (y + 0.5) * kCell, 0.05});
        set.cells.add(set.position.back());
        set.color.push_back({200, 100, 50});
        set.id.push_back(object);
        set.class_of.push_back(of_class);
      }
    }
  };
  block(1, 0, 6, 0, 4, 0);
  block(1, 6, 5, 1, 1, 0);
  block(1, 11, 4, 0, 4, 1);
  block(2, 20, 4, 0, 4, 1);
  block(2, 30, 3, 0, 4, 1);
  block(2, 40, 1, 0, 1, 1);
  block(3, 50, 2, 0, 2, 0);
  for (std::int32_t id = 1; id <= 3; ++id) {
    ObjectRow& row = set.rows.emplace_back();
    row.id = id;
    row.class_index = static_cast<std::int16_t>(id == 2);
    row.views = 10 * id;
    row.agreement = 0.9;
  }
  std::ptrdiff_t points[3] = {};
  for (const std::int32_t id : set.id) ++points[id - 1];
  for (ObjectRow& row : set.rows) row.points = points[row.id - 1];
  return set;
}

}  // namespace semfield::testing_objects
