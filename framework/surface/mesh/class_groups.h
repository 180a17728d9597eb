// Triangles of a surface by class, with a name and a colour for each group: what OBJ and GLB write as materials.
#pragma once

#include <string>
#include <vector>

#include "scene/classes/class_table.h"
#include "surface/mesh/surface.h"

namespace semfield {

struct ClassGroup {
  std::string name;                      ///< unique, of the class table; "surface" without semantics, "void" for none
  std::int32_t id = -1;                  ///< -1: no class
  std::int32_t instance = 0;             ///< object, where groups are told apart by it
  std::array<std::uint8_t, 3> color{};   ///< display-referred
  std::vector<std::uint32_t> triangles;  ///< numbers of triangles, ascending
};

/// Groups that have triangles, by ascending class index. `by_object`: by ascending object first, a group for every
/// class in it; groups of one class then have the same name.
std::vector<ClassGroup> class_groups(const Surface& surface, const ClassTable& classes, bool by_object = false);

/// A class's colour in its table; grey for kVoid.
std::array<std::uint8_t, 3> class_color(std::int16_t label, const ClassTable& classes);
/// That of every point; the attributes must have labels.
std::vector<std::array<std::uint8_t, 3>> class_colors(const PointAttributes& attributes, const ClassTable& classes);

/// Linear light of a display-referred 8-bit value (IEC 61966-2-1), 0..1.
double linear_light(std::uint8_t value);

}  // namespace semfield
