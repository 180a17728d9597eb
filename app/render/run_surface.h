// The surface of a run's field with colour and class at every vertex, as its training views show it; and as one HTML
// file that any browser opens without a network: the mesh, its classes and a viewer.
#pragma once

#include <functional>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "app/app_context.h"
#include "scene/classes/class_table.h"
#include "surface/mesh/field_surface.h"
#include "surface/mesh/surface.h"
#include "surface/objects/object_set.h"
#include "train/session.h"

namespace semfield::app {

/// What the page says and shows beside the surface.
struct ScenePage {
  std::string title;
  std::vector<std::string> about;  ///< lines on where the scene comes from
  std::string run;                 ///< name of its folder
  std::int64_t step = 0;
  bool labels = false;       ///< the field has classes, even where no surface is made yet
  bool metric = true;        ///< distances are metres; else units of the input
  Vec3d up{0, 1, 0};         ///< unit vector of the world that is upright
  std::optional<Vec3d> eye;  ///< a place inside, world units; none: the scene is seen from outside alone
  Vec3d ahead;               ///< unit vector of the world: where one looks from there
  Box bounds;                ///< of the scene, for a run without a surface
  std::optional<ObjectSet> objects;
};

/// A scene is first looked at as by the training camera that sees most of it, unless cameras stand around an object.
/// Objects are those of RUN/objects, with their edits, where they were found.
/// `up`: else as the cameras of the training frames stand, or the axis y where they do not tell.
ScenePage scene_page_of(const Session& session, const std::string& run_dir, std::int64_t step,
                        std::optional<Vec3d> up = {});

/// A page that stands alone. Positions are rounded to 65,535 steps along each side of the surface's box, and stay in
/// the input's world. surface.attributes.color holds those of photographs; class colours are the table's. Throws
/// Error(no_input) where the viewer's files, which come with the program, are missing.
std::string scene_page_text(const Surface& surface, const ClassTable& classes, const ScenePage& page);
/// Writes it whole, with the date. Throws Error(io) too.
void write_scene_page(const std::string& path, const Surface& surface, const ClassTable& classes,
                      const ScenePage& page);

/// A scene for the page of a program that answers it: its facts with `more` of them, and the mesh, deflated.
std::pair<std::string, std::string> scene_parts(const Surface& surface, const ClassTable& classes,
                                                const ScenePage& page, const Json& more);
/// Rows of the objects as the page reads them.
Json page_objects(const ObjectSet& objects, const ClassTable& classes);
/// The object of each vertex, 16 bits each: that of a place in its triangles, since a vertex on a border has two.
std::vector<std::uint16_t> vertex_objects(const Surface& surface, const ObjectSet& objects);

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

/// `sensor`: depth images of the training frames, read for that source alone. `objects`: whose ids vertices get, and
/// whose borders are smooth as those of classes are; null: there are none. `run_dir` stands in messages. Throws
/// Error(data) where there is no surface.
RunSurface make_run_surface(const Session& session, const std::string& run_dir, const SurfaceWishes& wishes,
                            std::span<const DepthView> sensor, const ObjectSet* objects, const SurfaceNews& news);

/// The axis of the world that is upright, as the cameras of the training frames stand; none: they do not tell.
std::optional<Vec3d> upright_of(const Session& session);

// The view in 3D at the top of a report.

/// `scene` of report_page, for a run that has come to `step`: the page of a coarse mesh. As evaluation does, it keeps
/// to a tenth of the training: of its rays here. "" where those are too few to see a surface, and where there is none
/// or it cannot be shown, which a note says.
std::string report_scene(const Session& session, const std::string& run_dir, std::int64_t step,
                         const AppContext& context);

}  // namespace semfield::app
