// From the names in a mesh file to classes.
#pragma once

#include <string>
#include <vector>

#include "datasets/obj_room/mesh_io.h"
#include "scene/classes/class_table.h"

namespace semfield {

/// Every pattern given must match; '*' stands for any text, '?' for one character. Earlier rules win.
struct ClassRule {
  std::string object, group, material;  ///< "" = not asked
  std::int32_t id = 0;
};

struct ClassRules {
  ClassTable table;
  std::vector<ClassRule> rules;
};

/// Reads classes.yaml or classes.csv as ClassTable::load does, or a YAML map
///   classes: [{id, name, color, ignore}, ...]
///   rules: [{object: "chair_*", class: chair}, {material: Glass, class: window}, ...]
/// Errors name file, line and column; all of a file are reported together.
ClassRules load_class_rules(const std::string& path);

/// Internal class index of each triangle. Without a matching rule the object's name decides: the part before "__", or
/// the name without trailing "_12", ".003" and the like, has to be a class name. Every object that has no class gets
/// its own error in one pass (its triangles become void).
std::vector<std::int16_t> classes_of_mesh(const TriangleMesh& mesh, const ClassRules& rules, Diagnostics& diagnostics);

bool matches_glob(const std::string& text, const std::string& pattern);

}  // namespace semfield
