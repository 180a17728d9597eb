// The surface of a run's field with colour and class at every vertex, as its training views show it.
#pragma once

#include <functional>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "app/app_context.h"
#include "session/session.h"
#include "surface/mesh/field_surface.h"
#include "surface/mesh/surface.h"

namespace semfield::app {

/// How a surface is made. What has no value is chosen by the scene.
struct SurfaceWishes {
  std::string source;                   ///< density, depth or sensor; "": by what lies around the scene
  std::optional<long long> resolution;  ///< cells along the longest side of the bounds; none: 256
  std::optional<double> voxel;          ///< edge of a cell instead, world units
  std::optional<double> level;          ///< density of the surface, 1/m
  bool keep_unseen = false;             ///< also faces that no training camera sees
  double keep_components = 0.002;       ///< least fraction of the faces: a chair is one, a floater is not
  std::optional<double> close_holes;    ///< longest border that is closed, world units
  std::optional<long long> faces;       ///< most of them
  std::int64_t depth_rays = 8'000'000;  ///< of all views together
};

struct RunSurface {
  Surface surface;  ///< with attributes
  VoxelGrid grid;
  std::string source;      ///< density, depth or sensor
  std::string described;   ///< for notes and errors: "at a density of 8.7", "in the depth of the training views"
  std::size_t unseen = 0;  ///< faces left out because no training camera sees them
  std::size_t closed = 0;  ///< holes
  std::int64_t components = 0;
  std::optional<double> level;
};

/// What is said on the way; each may be null.
struct SurfaceNews {
  std::function<void(const std::string& note)> note;
  std::function<void(double done, double of)> views;  ///< whose depth is rendered
};

/// The source that `wishes` name, or that suits the scene. Throws Error(usage) for wishes that contradict each other.
std::string surface_source(const SurfaceWishes& wishes, const Session& session);

/// The cameras of the training frames.
std::vector<RayCamera> training_cameras(const Session& session);

/// `sensor`: depth images of the training frames, read for that source alone. `run_dir` stands in messages. Throws
/// Error(data) where there is no surface.
RunSurface make_run_surface(const Session& session, const std::string& run_dir, const SurfaceWishes& wishes,
                            std::span<const DepthView> sensor, const SurfaceNews& news);

/// The axis of the world that is upright, as the cameras of the training frames stand; none: they do not tell.
std::optional<Vec3d> upright_of(const Session& session);

// The view in 3D at the top of a report.

/// `scene` of report_page, for a run that has come to `step`: the page of a coarse mesh. As evaluation does, it keeps
/// to a tenth of the training: of its rays here. "" where those are too few to see a surface, and where there is none
/// or it cannot be shown, which a note says.
std::string report_scene(const Session& session, const std::string& run_dir, std::int64_t step,
                         const AppContext& context);

}  // namespace semfield::app
