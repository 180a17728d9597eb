#include "surface/mesh/class_groups.h"

#include <fmt/format.h>

#include <cmath>
#include <map>
#include <set>

namespace semfield {

std::vector<ClassGroup> class_groups(const Surface& surface, const ClassTable& classes) {
  std::map<std::int16_t, ClassGroup> by_class;
  for (std::size_t i = 0; i < surface.triangles.size(); ++i) {
    by_class[triangle_label(surface.attributes, surface.triangles[i])].triangles.push_back(
        static_cast<std::uint32_t>(i));
  }
  std::vector<ClassGroup> groups;
  std::set<std::string> names;
  for (auto& [label, group] : by_class) {
    if (label == kVoid) {
      group.name = surface.attributes.has_labels() ? "void" : "surface";
    } else {
      const ClassEntry& entry = classes.valid(label);
      group.name = entry.name.empty() ? fmt::format("class_{}", entry.id) : entry.name;
      group.id = entry.id;
    }
    group.color = class_color(label, classes);
    for (char& c : group.name) {
      // Words of an OBJ line end at a blank, lines at a control character.
      if (static_cast<unsigned char>(c) <= ' ' || c == 127) c = '_';
    }
    while (!names.insert(group.name).second) group.name += fmt::format("_{}", group.id);
    groups.push_back(std::move(group));
  }
  return groups;
}

std::array<std::uint8_t, 3> class_color(std::int16_t label, const ClassTable& classes) {
  if (label == kVoid) return {128, 128, 128};
  return classes.valid(label).color;
}

std::vector<std::array<std::uint8_t, 3>> class_colors(const PointAttributes& attributes, const ClassTable& classes) {
  std::vector<std::array<std::uint8_t, 3>> colors;
  colors.reserve(attributes.label.size());
  for (const std::int16_t label : attributes.label) colors.push_back(class_color(label, classes));
  return colors;
}

double linear_light(std::uint8_t value) {
  const double v = value / 255.0;
  return v <= 0.04045 ? v / 12.92 : std::pow((v + 0.055) / 1.055, 2.4);
}

}  // namespace semfield
