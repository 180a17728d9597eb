// What `semfield mesh` is asked for.
#pragma once

#include <optional>
#include <string>
#include <vector>

namespace semfield::app {

struct MeshOptions {
  std::string run;
  std::string out;                      ///< default: mesh.ply in the run folder
  std::vector<std::string> formats;     ///< of mesh_targets.h; empty: what `out` ends with, or ply
  std::optional<long long> resolution;  ///< cells along the longest side of the bounds
  std::optional<double> voxel;          ///< edge of a cell instead, world units
  std::string surface;                  ///< density, depth or sensor; "": by what lies around the scene
  std::optional<double> level;          ///< density of the surface, 1/m
  bool keep_unseen = false;             ///< also faces that no training camera sees
  double keep_components = 0.002;       ///< least fraction of the faces: a chair is one, a floater is not
  std::optional<double> close_holes;    ///< longest border that is closed, world units
  std::optional<long long> faces;       ///< most of them
  bool points = false;                  ///< also a point cloud from the training views
  bool score = false;                   ///< also figures against the depth images of the scene
  std::vector<std::string> band;        ///< heights above the floor of a PGM, world units; empty: HeightBand's
  std::string color;                    ///< photo, class or both; "": both where there are classes
  std::string up;                       ///< axis of the world that is upright; "": taken from the cameras
  std::vector<std::string> set;
};

}  // namespace semfield::app
