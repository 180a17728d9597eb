// A surface as one HTML file that any browser opens without a network: the mesh, its classes and a viewer.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "run/open_run.h"
#include "scene/classes/class_table.h"
#include "surface/mesh/surface.h"

namespace semfield::app {

/// What the page says and shows beside the surface.
struct ScenePage {
  std::string title;
  std::vector<std::string> about;  ///< lines on where the scene comes from
  bool metric = true;              ///< distances are metres; else units of the input
  Vec3d up{0, 1, 0};               ///< unit vector of the world that is upright
  std::optional<Vec3d> eye;        ///< a place inside, world units; none: the scene is seen from outside alone
};

/// A room is looked at from where its cameras stood too; the middle of those around an object lies in the object.
ScenePage scene_page_of(const OpenedRun& run, Vec3d up);

/// Writes `path` whole. Positions are rounded to 65,535 steps along each side of the surface's box, and stay in the
/// input's world. surface.attributes.color holds colours as rendered; class colours are the table's. Throws Error(io),
/// and Error(no_input) where the viewer's files, which come with the program, are missing.
void write_scene_page(const std::string& path, const Surface& surface, const ClassTable& classes,
                      const ScenePage& page);

}  // namespace semfield::app
