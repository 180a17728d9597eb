// What `semfield mesh` is asked for.
#pragma once

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

}  // namespace semfield::app
