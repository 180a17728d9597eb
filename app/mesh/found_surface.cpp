#include "app/mesh/found_surface.h"

#include <fmt/format.h>

#include <algorithm>

#include "app/progress_line.h"
#include "surface/mesh/depth_fusion.h"
#include "surface/mesh/field_surface.h"
#include "surface/mesh/shape/close_holes.h"
#include "surface/mesh/shape/simplify.h"

namespace semfield::app {

namespace {

constexpr int kSightLines = 4096;
constexpr std::int64_t kDepthRays = 8'000'000;  // of all views together
constexpr double kOffsetCells = 1.5;            // where texture rays begin, in cells outside the surface

// A surface of depth may lie on the bounds, and what is solid behind it outside of them.
VoxelGrid grid_of(Box bounds, double spacing, bool of_density) {
  const double margin = of_density ? 0 : kTruncationCells * spacing;
  bounds.lo = bounds.lo - Vec3d{margin, margin, margin};
  bounds.hi = bounds.hi + Vec3d{margin, margin, margin};
  return VoxelGrid::covering(bounds, spacing);
}

FoundSurface surface_of_depth(const Session& s, const VoxelGrid& grid, std::span<const RayCamera> cameras,
                              const AppContext& context) {
  ProgressLine progress(context, "depth of", "views");
  const std::vector<DepthView> views = depth_views(*s.pipeline, cameras, s.limits, kDepthRays, [&](std::size_t done) {
    progress.show(static_cast<double>(done), static_cast<double>(cameras.size()));
  });
  FoundSurface found;
  found.surface = fused_surface(views, s.limits, grid);
  found.described = "in the depth of the training views";
  return found;
}

SurfaceRequest request_of(const MeshOptions& options, const Session& s, const VoxelGrid& grid,
                          std::span<const RayCamera> cameras) {
  SurfaceRequest request;
  request.grid = grid;
  request.opaque_border = s.limits.clip && s.config.rendering.far == FarMode::background;
  if (options.level) {
    request.level_per_m = *options.level;
    return request;
  }
  request.level_per_m = choose_level(*s.pipeline, request, look(*s.pipeline, cameras, s.limits, kSightLines));
  return request;
}

void drop_unseen(Surface& surface, std::span<const RayCamera> cameras, const RayLimits& limits, double cell) {
  keep_triangles(surface, triangles_in_sight(surface, sights_of(surface, cameras, limits, cell)));
}

FoundSurface surface_of_density(const MeshOptions& options, const Session& s, const VoxelGrid& grid,
                                std::span<const RayCamera> cameras, const AppContext& context) {
  const SurfaceRequest request = request_of(options, s, grid, cameras);
  const char* const unit = s.scene.info.metric ? "m" : "unit";
  FoundSurface found;
  found.described = fmt::format("at a density of {:.4g} / {}", request.level_per_m, unit);
  found.level = request.level_per_m;
  print_note(context, "surface " + found.described);
  found.surface = density_surface(*s.pipeline, request);
  if (options.keep_unseen) return found;
  const std::size_t all = found.surface.triangles.size();
  drop_unseen(found.surface, cameras, s.limits, grid.spacing);
  found.unseen = all - found.surface.triangles.size();
  if (found.unseen == 0) return found;
  if (found.surface.triangles.empty()) {
    throw Error(
        ErrorKind::data, "mesh.surface.unseen",
        fmt::format("{}: no training camera sees any of the {} faces {}", options.run, found.unseen, found.described),
        "train longer, or keep them with --keep-unseen");
  }
  print_note(context, fmt::format("{} of {} faces that no training camera sees are left out; --keep-unseen keeps them",
                                  found.unseen, all));
  return found;
}

// The mesh's, and that of the fused depth images, which is the mesh itself where it was made of them.
MeshScores scores_of(const MeshOptions& options, const Surface& surface, const std::string& source, const Session& s,
                     const MeasuredDepth& measured, const VoxelGrid& grid) {
  const DepthReference reference(measured.training, measured.held_out);
  MeshScores scores{reference.points(), reference.held_out_points(), reference.score(surface), {}};
  if (source == "sensor" || measured.training.empty()) return scores;
  Surface of_sensor = fused_surface(measured.training, s.limits, grid);
  drop_small_components(of_sensor, options.keep_components);
  scores.sensor = reference.score(of_sensor);
  return scores;
}

void reduce(Surface& surface, std::size_t most, const AppContext& context) {
  const std::size_t before = surface.triangles.size();
  simplify(surface, most);
  const std::size_t left = surface.triangles.size();
  if (left == before) return;
  print_note(context, fmt::format("{} of {} faces are left{}", left, before,
                                  left > most ? ": fewer would tear the surface or turn faces over" : ""));
}

}  // namespace

double spacing_of(const MeshOptions& options, const Box& bounds, long long cells) {
  const Vec3d size = bounds.size();
  return options.voxel.value_or(std::max({size.x, size.y, size.z}) /
                                static_cast<double>(options.resolution.value_or(cells)));
}

std::vector<RayCamera> training_cameras(const Session& s) {
  std::vector<RayCamera> cameras;
  for (const int f : s.scene.frames_of(Split::train)) {
    const FrameInfo& info = s.scene.info.frames[static_cast<std::size_t>(f)];
    cameras.push_back({info.camera, info.world_from_camera, s.plan.undistortion});
  }
  return cameras;
}

std::string surface_source(const MeshOptions& options, const Session& s) {
  const bool of_density = options.level || options.keep_unseen;
  if ((options.surface == "depth" || options.surface == "sensor") && of_density)
    throw Error(ErrorKind::usage, "mesh.surface.options",
                "--surface " + options.surface + ": " + (options.level ? "--level" : "--keep-unseen") +
                    " belongs to the surface of the density",
                "leave one of the two out");
  if (!options.surface.empty()) return options.surface;
  return !of_density && s.config.rendering.far == FarMode::background ? "depth" : "density";
}

FoundSurface find_surface(const MeshOptions& options, OpenedRun& run, const AppContext& context) {
  Session& s = run.session;
  const std::string source = surface_source(options, s);
  MeasuredDepth measured;
  if (options.score || source == "sensor") measured = measured_depth(s, options.run, source == "sensor");
  const std::vector<RayCamera> cameras = training_cameras(s);
  const double spacing = spacing_of(options, s.extent.bounds, kMeshResolution);
  const VoxelGrid grid = grid_of(s.extent.bounds, spacing, source == "density");
  print_note(context, fmt::format("{} x {} x {} points, {:.4g} {} apart", grid.nx, grid.ny, grid.nz, grid.spacing,
                                  s.scene.info.metric ? "m" : "units"));
  FoundSurface found;
  if (source == "sensor") {
    found.surface = fused_surface(measured.training, s.limits, grid);
    found.described = "in the depth images of the training frames";
  } else {
    found = source == "depth" ? surface_of_depth(s, grid, cameras, context)
                              : surface_of_density(options, s, grid, cameras, context);
  }
  found.source = source;
  found.spacing = spacing;
  Surface& surface = found.surface;
  found.components = drop_small_components(surface, options.keep_components);
  if (surface.triangles.empty()) {
    throw Error(ErrorKind::data, "mesh.surface.none", fmt::format("{}: no surface {}", options.run, found.described),
                source == "density" ? "lower --level, or --keep-components, or train longer"
                                    : "train longer, or take --surface density");
  }
  if (options.close_holes) {
    found.holes_closed = close_holes(surface, *options.close_holes);
    print_note(context, fmt::format("{} holes closed", found.holes_closed));
  }
  std::vector<Sights> sights = sights_of(surface, cameras, s.limits, grid.spacing);
  lend_sights(surface, sights);
  surface.attributes = render_attributes(*s.pipeline, surface, {cameras, sights}, kOffsetCells * grid.spacing, s.limits,
                                         s.plan.class_of_logit);
  if (options.faces) reduce(surface, static_cast<std::size_t>(*options.faces), context);
  if (options.score) found.scores = scores_of(options, surface, source, s, measured, grid);
  return found;
}

}  // namespace semfield::app
