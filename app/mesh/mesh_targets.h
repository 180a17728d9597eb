// Which files `semfield mesh` writes: their forms, names and colourings.
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "app/mesh/mesh_options.h"

namespace semfield::app {

/// Forms of surfaces: ply, obj, glb, html; of points: las, pcd, splat, splats.ply; of maps: npz, bt, ot, pgm. Each is
/// the ending of its files.
const std::vector<std::string>& known_formats();

struct MeshTargets {
  std::filesystem::path stem;  ///< path without the form's ending
  std::vector<std::string> formats;

  bool writes(const std::string& format) const;
  bool surfaces() const;  ///< whether any form needs triangles
  bool points() const;    ///< whether any but splats is of points
  bool splats() const;
  bool maps() const;
  std::string file(const std::string& format, const std::string& suffix = "") const;
};

/// Throws Error(usage) for an ending that is no form.
MeshTargets mesh_targets(const MeshOptions& options);

/// One way of colouring, and what its files' names have behind the stem.
struct Coloring {
  bool classes;
  std::string suffix;
};

/// Of surfaces and of the points of --points. Throws Error(data) for class colours of a run without semantics.
std::vector<Coloring> mesh_colorings(const MeshOptions& options, bool has_classes);

}  // namespace semfield::app
