#include "surface/mesh/class_groups.h"

#include <fmt/format.h>

#include <cmath>
#include <map>
#include <set>

namespace semfield {

std::vector<ClassGroup> class_groups(const Surface& surface, const ClassTable& classes, bool by_object) {
  std::map<std::pair<std::int32_t, std::int16_t>, ClassGroup> found;
  for (std::size_t i = 0; i < surface.triangles.size(); ++i) {
    const Triangle& triangle = surface.triangles[i];
    const std::int32_t instance = by_object ? triangle_instance(surface.attributes, triangle) : 0;
    ClassGroup& group = found[{instance, triangle_label(surface.attributes, triangle)}];
    group.instance = instance;
    group.triangles.push_back(static_cast<std::uint32_t>(i));
  }
  std::set<std::int16_t> labels;
  for (const auto& [key, group] : found) labels.insert(key.second);
  std::map<std::int16_t, std::string> name_of;
  std::set<std::string> names;
  for (const std::int16_t label : labels) {
    std::string name = surface.attributes.has_labels() ? "void" : "surface";
    if (label != kVoid) {
      const ClassEntry& entry = classes.valid(label);
      name = entry.name.empty() ? fmt::format("class_{}", entry.id) : entry.name;
    }
    for (char& c : name) {
      // Words of an OBJ line end at a blank, lines at a control character.
      if (static_cast<unsigned char>(c) <= ' ' || c == 127) c = '_';
    }
    while (!names.insert(name).second) name += fmt::format("_{}", label == kVoid ? -1 : classes.valid(label).id);
    name_of[label] = name;
  }
  std::vector<ClassGroup> groups;
  for (auto& [key, group] : found) {
    group.name = name_of[key.second];
    if (key.second != kVoid) group.id = classes.valid(key.second).id;
    group.color = class_color(key.second, classes);
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
