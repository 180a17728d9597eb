#include "app/render/run_surface.h"

#include <fmt/format.h>

#include <algorithm>

#include "app/render/scene_page.h"
#include "core/error.h"
#include "surface/mesh/field_surface.h"
#include "surface/mesh/shape/simplify.h"
#include "surface/mesh/surface.h"

namespace semfield::app {

namespace {

constexpr long long kDefaultResolution = 256;
constexpr int kSightLines = 4096;
constexpr double kOffsetCells = 1.5;  // where texture rays begin, in cells outside the surface

void say(const SurfaceNews& news, const std::string& text) {
  if (news.note) news.note(text);
}

// A surface of depth may lie on the bounds, and what is solid behind it outside of them.
VoxelGrid grid_of(const SurfaceWishes& wishes, Box bounds, bool of_density) {
  const Vec3d size = bounds.size();
  const auto cells = static_cast<double>(wishes.resolution.value_or(kDefaultResolution));
  const double spacing = wishes.voxel.value_or(std::max({size.x, size.y, size.z}) / cells);
  const double margin = of_density ? 0 : kTruncationCells * spacing;
  bounds.lo = bounds.lo - Vec3d{margin, margin, margin};
  bounds.hi = bounds.hi + Vec3d{margin, margin, margin};
  return VoxelGrid::covering(bounds, spacing);
}

SurfaceRequest request_of(const SurfaceWishes& wishes, const Session& s, const VoxelGrid& grid,
                          std::span<const RayCamera> cameras) {
  SurfaceRequest request;
  request.grid = grid;
  request.opaque_border = s.limits.clip && s.config.rendering.far == FarMode::background;
  if (wishes.level) {
    request.level_per_m = *wishes.level;
    return request;
  }
  request.level_per_m = choose_level(*s.pipeline, request, look(*s.pipeline, cameras, s.limits, kSightLines));
  return request;
}

void find_in_depth(RunSurface& found, const Session& s, const SurfaceWishes& wishes, std::span<const RayCamera> cameras,
                   const SurfaceNews& news) {
  const std::vector<DepthView> views =
      depth_views(*s.pipeline, cameras, s.limits, wishes.depth_rays, [&](std::size_t done) {
        if (news.views) news.views(static_cast<double>(done), static_cast<double>(cameras.size()));
      });
  found.surface = fused_surface(views, s.limits, found.grid);
  found.described = "in the depth of the training views";
}

void find_in_density(RunSurface& found, const Session& s, const std::string& run_dir, const SurfaceWishes& wishes,
                     std::span<const RayCamera> cameras, const SurfaceNews& news) {
  const SurfaceRequest request = request_of(wishes, s, found.grid, cameras);
  found.level = request.level_per_m;
  found.described = fmt::format("at a density of {:.4g} / {}", request.level_per_m, s.scene.info.metric ? "m" : "unit");
  say(news, "surface " + found.described);
  found.surface = density_surface(*s.pipeline, request);
  if (wishes.keep_unseen) return;
  const std::size_t all = found.surface.triangles.size();
  keep_triangles(found.surface,
                 triangles_in_sight(found.surface, sights_of(found.surface, cameras, s.limits, found.grid.spacing)));
  found.unseen = all - found.surface.triangles.size();
  if (found.unseen == 0) return;
  if (found.surface.triangles.empty()) {
    throw Error(
        ErrorKind::data, "mesh.surface.unseen",
        fmt::format("{}: no training camera sees any of the {} faces {}", run_dir, found.unseen, found.described),
        "train longer, or keep them with --keep-unseen");
  }
  say(news, fmt::format("{} of {} faces that no training camera sees are left out; --keep-unseen keeps them",
                        found.unseen, all));
}

void reduce(Surface& surface, std::size_t most, const SurfaceNews& news) {
  const std::size_t before = surface.triangles.size();
  simplify(surface, most);
  const std::size_t left = surface.triangles.size();
  if (left == before) return;
  say(news, fmt::format("{} of {} faces are left{}", left, before,
                        left > most ? ": fewer would tear the surface or turn faces over" : ""));
}

}  // namespace

std::vector<RayCamera> training_cameras(const Session& session) {
  std::vector<RayCamera> cameras;
  for (const int f : session.scene.frames_of(Split::train)) {
    const FrameInfo& info = session.scene.info.frames[static_cast<std::size_t>(f)];
    cameras.push_back({info.camera, info.world_from_camera, session.plan.undistortion});
  }
  return cameras;
}

// Cameras that stand inside of what they see leave much of it unseen. What is alone in empty space is seen from all
// around, and its density is the finer source.
std::string surface_source(const SurfaceWishes& wishes, const Session& session) {
  const bool of_density = wishes.level || wishes.keep_unseen;
  if ((wishes.source == "depth" || wishes.source == "sensor") && of_density)
    throw Error(ErrorKind::usage, "mesh.surface.options",
                "--surface " + wishes.source + ": " + (wishes.level ? "--level" : "--keep-unseen") +
                    " belongs to the surface of the density",
                "leave one of the two out");
  if (!wishes.source.empty()) return wishes.source;
  return !of_density && session.config.rendering.far == FarMode::background ? "depth" : "density";
}

RunSurface make_run_surface(const Session& session, const std::string& run_dir, const SurfaceWishes& wishes,
                            std::span<const DepthView> sensor, const SurfaceNews& news) {
  RunSurface found;
  found.source = surface_source(wishes, session);
  found.grid = grid_of(wishes, session.extent.bounds, found.source == "density");
  say(news, fmt::format("{} x {} x {} points, {:.4g} {} apart", found.grid.nx, found.grid.ny, found.grid.nz,
                        found.grid.spacing, session.scene.info.metric ? "m" : "units"));
  const std::vector<RayCamera> cameras = training_cameras(session);
  if (found.source == "sensor") {
    found.surface = fused_surface(sensor, session.limits, found.grid);
    found.described = "in the depth images of the training frames";
  } else if (found.source == "depth") {
    find_in_depth(found, session, wishes, cameras, news);
  } else {
    find_in_density(found, session, run_dir, wishes, cameras, news);
  }
  Surface& surface = found.surface;
  found.components = drop_small_components(surface, wishes.keep_components);
  if (surface.triangles.empty()) {
    throw Error(ErrorKind::data, "mesh.surface.none", fmt::format("{}: no surface {}", run_dir, found.described),
                found.source == "density" ? "lower --level, or --keep-components, or train longer"
                                          : "train longer, or take --surface density");
  }
  if (wishes.close_holes) {
    found.closed = close_holes(surface, *wishes.close_holes);
    say(news, fmt::format("{} holes closed", found.closed));
  }
  std::vector<Sights> sights = sights_of(surface, cameras, session.limits, found.grid.spacing);
  lend_sights(surface, sights);
  surface.attributes =
      render_attributes(*session.pipeline, surface, {cameras, sights}, kOffsetCells * found.grid.spacing,
                        session.limits, session.plan.class_of_logit);
  if (wishes.faces) reduce(surface, static_cast<std::size_t>(*wishes.faces), news);
  return found;
}

std::optional<Vec3d> upright_of(const Session& session) {
  std::vector<Pose> poses;
  for (const RayCamera& camera : training_cameras(session)) poses.push_back(camera.world_from_camera);
  return up_of_cameras(poses);
}

std::string report_scene(const Session& session, const std::string& run_dir, std::int64_t step,
                         const AppContext& context) {
  constexpr long long kCells = 64;  // along the longest side
  constexpr std::int64_t kMostRays = 60'000, kLeastRays = 15'000;
  constexpr std::int64_t kShare = 10;  // of the rays of training: one of so many
  const std::int64_t rays = std::min(kMostRays, step * session.config.train.rays / kShare);
  if (rays < kLeastRays) return {};
  SurfaceWishes wishes;
  wishes.resolution = kCells;
  wishes.depth_rays = rays;
  try {
    const RunSurface found = make_run_surface(session, run_dir, wishes, {}, {});
    return scene_page_text(found.surface, session.scene.info.classes,
                           scene_page_of(session, run_dir, step, upright_of(session).value_or(Vec3d{0, 1, 0})));
  } catch (const Error& e) {
    if (e.kind() != ErrorKind::data && e.kind() != ErrorKind::no_input) throw;
    print_note(context, "no view in 3D in the report: " + e.message());
    return {};
  }
}

}  // namespace semfield::app
