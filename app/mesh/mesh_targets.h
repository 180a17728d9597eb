// Which files `semfield mesh` writes: their forms, names and colourings.
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "app/render/run_surface.h"

namespace semfield::app {

struct MeshOptions : SurfaceWishes {
  std::string run;
  std::string out;                   ///< default: mesh.ply in the run folder
  std::vector<std::string> formats;  ///< of mesh_targets.h; empty: what `out` ends with, or ply
  bool points = false;               ///< also a point cloud from the training views
  bool score = false;                ///< also figures against the depth images of the scene
  std::vector<std::string> band;     ///< heights above the floor of a PGM, world units; empty: HeightBand's
  std::string color;                 ///< photo, class or both; "": both where there are classes
  std::string up;                    ///< axis of the world that is upright; "": taken from the cameras
  std::vector<std::string> set;
};

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
