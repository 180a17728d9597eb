// Points, splats and maps of a run as files for other programs, and what goes with all files of `semfield mesh`.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "app/app_context.h"
#include "app/mesh/mesh_targets.h"
#include "app/render/render_views.h"
#include "handover/point_files.h"
#include "handover/splats.h"
#include "handover/voxel_map.h"
#include "objects/object_set.h"
#include "run/run_scores.h"
#include "surface/mesh/mesh_files.h"

namespace semfield::app {

class HandOver {
 public:
  /// Reads the objects of the run, where it has some, and notes those of another step. Borrows all but `up`, which is
  /// the axis of the world that is upright, where it is known.
  HandOver(const MeshOptions& options, const MeshTargets& targets, OpenedRun& run, std::optional<Vec3d> up,
           const AppContext& context);

  /// Ids of objects at the points; empty without objects.
  std::vector<std::int32_t> instances(std::span<const Vec3d> points) const;
  /// Names of the objects by their ids.
  std::map<std::int32_t, std::string> objects() const;

  /// Renders the training views, where a form needs them. Throws Error(usage) for cubes that are too many.
  void look();
  const PointSet& points() const { return points_; }  ///< empty unless --points or a form asks for them
  /// Writes every form that is no surface, and adds its files.
  void write();
  /// A file that was written elsewhere.
  void add(const std::string& path, const std::string& holds, Vec3d offset = {});
  /// Writes the sidecar, STEM.json, which is none of files(), unless nothing but a page was written.
  void finish();
  std::vector<std::string> files() const;

 private:
  bool wants_points() const { return options_.points || targets_.points(); }
  const ClassTable& classes() const { return run_.session.scene.info.classes; }
  void write_points();
  void write_splats();
  void write_maps();

  const MeshOptions& options_;
  const MeshTargets& targets_;
  OpenedRun& run_;
  const AppContext& context_;
  std::optional<ObjectSet> objects_;
  Sidecar sidecar_;
  double metre_ = 1;  // usual_metre() of the scene
  PointSet points_;
  Splats splats_;
  std::optional<VoxelMap> map_;
};

// The surface of a run as `semfield mesh` is asked for it, with figures.

struct FoundSurface : RunSurface {
  std::optional<MeshScores> scores;
};

inline constexpr long long kMeshResolution = 256;  ///< cells along the longest side, where none are asked for

/// What --voxel says, or the longest side over --resolution, or over `cells`.
double spacing_of(const MeshOptions& options, const Box& bounds, long long cells);

/// Throws Error(data) where there is no surface, or nothing of it is seen.
FoundSurface find_surface(const MeshOptions& options, OpenedRun& run, const AppContext& context);

}  // namespace semfield::app
