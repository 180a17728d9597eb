// mesh: the surface of a run's field with colours and class ids, and a point cloud of what its cameras saw.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "app/json_output.h"
#include "app/progress_line.h"
#include "app/render/mesh_score_output.h"
#include "app/render/scene_page.h"
#include "app/verb.h"
#include "core/findings.h"
#include "run/open_run.h"
#include "surface/mesh/class_groups.h"
#include "surface/mesh/depth_fusion.h"
#include "surface/mesh/field_surface.h"
#include "surface/mesh/mesh_files.h"
#include "surface/mesh/point_cloud.h"
#include "surface/mesh/shape/close_holes.h"
#include "surface/mesh/shape/simplify.h"
#include "surface/mesh/upright.h"

namespace semfield::app {

namespace {

struct MeshOptions {
  std::string run;
  std::string out;                      ///< default: mesh.ply in the run folder
  std::vector<std::string> formats;     ///< ply, obj, glb, html; empty: what `out` ends with, or ply
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
  std::string color;                    ///< photo, class or both; "": both where there are classes
  std::string up;                       ///< axis that GLB and HTML files show upright; "": taken from the cameras
  std::vector<std::string> set;
};

namespace fs = std::filesystem;

constexpr long long kDefaultResolution = 256;
constexpr int kSightLines = 4096;
constexpr std::int64_t kDepthRays = 8'000'000;  // of all views together
constexpr double kMailMegabytes = 25;           // what a colleague still gets by mail
constexpr double kOffsetCells = 1.5;            // where texture rays begin, in cells outside the surface

const std::vector<std::string>& known_formats() {
  static const std::vector<std::string> names{"ply", "obj", "glb", "html"};
  return names;
}

void check_format(const std::string& name, const std::string& where) {
  if (std::find(known_formats().begin(), known_formats().end(), name) != known_formats().end()) return;
  throw Error(ErrorKind::usage, "mesh.format.unknown", where + ": unknown mesh format '" + name + "'",
              "one of " + join(known_formats()) +
                  (did_you_mean(name, known_formats()).empty()
                       ? std::string()
                       : "; did you mean " + did_you_mean(name, known_formats()) + "?"));
}

struct Targets {
  fs::path stem;  ///< path without extension
  std::vector<std::string> formats;
};

// One way of colouring, and what its files' names have behind the stem.
struct Coloring {
  bool classes;
  std::string suffix;
};

Targets targets_of(const MeshOptions& options) {
  Targets targets;
  fs::path out = options.out.empty() ? fs::path(options.run) / "mesh" : fs::path(options.out);
  std::string ending = options.out.empty() || !out.has_extension() ? "" : out.extension().string().substr(1);
  const bool ending_known = std::find(known_formats().begin(), known_formats().end(), ending) != known_formats().end();
  targets.formats = options.formats;
  if (targets.formats.empty()) {
    if (!ending.empty()) check_format(ending, "--out " + options.out);
    targets.formats = {ending.empty() ? "ply" : ending};
  }
  targets.stem = ending_known ? out.replace_extension() : out;  // "scan.v2" keeps its name
  return targets;
}

std::vector<Coloring> colorings_of(const MeshOptions& options, bool has_classes) {
  if (!has_classes && (options.color == "class" || options.color == "both"))
    throw Error(ErrorKind::data, "run.semantics.none",
                "--color " + options.color + ": " + options.run + " has no semantics",
                "train with labels, or leave --color out");
  std::vector<Coloring> colorings;
  if (options.color != "class") colorings.push_back({false, ""});
  // A file that was named gets its name.
  if (has_classes && options.color != "photo")
    colorings.push_back({true, options.color == "class" && !options.out.empty() ? "" : "_classes"});
  return colorings;
}

// A surface of depth may lie on the bounds, and what is solid behind it outside of them.
VoxelGrid grid_of(const MeshOptions& options, Box bounds, bool of_density) {
  const Vec3d size = bounds.size();
  const auto cells = static_cast<double>(options.resolution.value_or(kDefaultResolution));
  const double spacing = options.voxel.value_or(std::max({size.x, size.y, size.z}) / cells);
  const double margin = of_density ? 0 : kTruncationCells * spacing;
  bounds.lo = bounds.lo - Vec3d{margin, margin, margin};
  bounds.hi = bounds.hi + Vec3d{margin, margin, margin};
  return VoxelGrid::covering(bounds, spacing);
}

std::vector<RayCamera> training_cameras(const Session& s) {
  std::vector<RayCamera> cameras;
  for (const int f : s.scene.frames_of(Split::train)) {
    const FrameInfo& info = s.scene.info.frames[static_cast<std::size_t>(f)];
    cameras.push_back({info.camera, info.world_from_camera, s.plan.undistortion});
  }
  return cameras;
}

// Cameras that stand inside of what they see leave much of it unseen. What is alone in empty space is seen from all
// around, and its density is the finer source.
std::string source_of(const MeshOptions& options, const Session& s) {
  const bool of_density = options.level || options.keep_unseen;
  if ((options.surface == "depth" || options.surface == "sensor") && of_density)
    throw Error(ErrorKind::usage, "mesh.surface.options",
                "--surface " + options.surface + ": " + (options.level ? "--level" : "--keep-unseen") +
                    " belongs to the surface of the density",
                "leave one of the two out");
  if (!options.surface.empty()) return options.surface;
  return !of_density && s.config.rendering.far == FarMode::background ? "depth" : "density";
}

// A surface, and how many faces were left out because no training camera saw them.
struct FoundSurface {
  Surface surface;
  std::size_t unseen = 0;
  std::string described;  ///< for notes and errors: "at a density of 8.7", "in the depth of the training views"
  std::optional<double> level;
};

FoundSurface surface_of_depth(const Session& s, const VoxelGrid& grid, std::span<const RayCamera> cameras,
                              const AppContext& context) {
  ProgressLine progress(context, "depth of", "views");
  const std::vector<DepthView> views = depth_views(*s.pipeline, cameras, s.limits, kDepthRays, [&](std::size_t done) {
    progress.show(static_cast<double>(done), static_cast<double>(cameras.size()));
  });
  return {fused_surface(views, s.limits, grid), 0, "in the depth of the training views", {}};
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
  FoundSurface found{{}, 0, fmt::format("at a density of {:.4g} / {}", request.level_per_m, unit), request.level_per_m};
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

PointSet points_of(const Session& s, double voxel, const AppContext& context) {
  PointCloud cloud(voxel, s.pipeline->options().rules.background());
  const std::vector<int> frames = s.scene.frames_of(Split::train);
  ProgressLine progress(context, "points of", "views");
  for (std::size_t i = 0; i < frames.size(); ++i) {
    const FrameInfo& info = s.scene.info.frames[static_cast<std::size_t>(frames[i])];
    const RayCamera camera{info.camera, info.world_from_camera, s.plan.undistortion};
    const auto part_done = [&](double share) {
      progress.show(static_cast<double>(i) + share, static_cast<double>(frames.size()));
    };
    cloud.add(camera,
              render_named_frame(*s.pipeline, info.name, camera, s.limits, s.plan.class_of_logit, {}, {1, part_done}));
  }
  return cloud.points();
}

void write_surface(const std::string& format, const std::string& path, const Surface& surface,
                   const ClassTable& classes, const GlbLook& look) {
  if (format == "ply") write_ply(path, surface, classes);
  if (format == "obj") write_obj(path, surface, classes);
  if (format == "glb") write_glb(path, surface, classes, look);
}

// The axis that GLB and HTML files show upright; says how it was found.
Vec3d up_of(const MeshOptions& options, const Session& s, const AppContext& context) {
  if (const auto named = axis_named(options.up)) return *named;
  std::vector<Pose> poses;
  for (const int f : s.scene.frames_of(Split::train))
    poses.push_back(s.scene.info.frames[static_cast<std::size_t>(f)].world_from_camera);
  const std::optional<Vec3d> up = up_of_cameras(poses);
  if (up) {
    print_note(context,
               fmt::format("files show {} upright, as the cameras stand; --up names another axis", axis_text(*up)));
  } else {
    print_note(context, "the cameras do not tell which way is up: files show +y upright; --up names another axis");
  }
  return up.value_or(Vec3d{0, 1, 0});
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

int run(const MeshOptions& options, AppContext& context) {
  const Targets targets = targets_of(options);
  Diagnostics diagnostics;
  const bool measures = options.score || options.surface == "sensor";
  OpenedRun run = open_run(options.run, options.set, context.registry, diagnostics,
                           measures ? OpenFor::evaluation_of_training_frames : OpenFor::rendering);
  context.adopt(run.session.config);
  for (const Diagnostic& finding : folded(diagnostics)) print_note(context, finding.shown());
  Session& s = run.session;
  const ClassTable& classes = s.scene.info.classes;
  const std::vector<Coloring> colorings = colorings_of(options, s.pipeline->has_semantics());
  const std::vector<RayCamera> cameras = training_cameras(s);
  const std::string source = source_of(options, s);
  MeasuredDepth measured;
  if (measures) measured = measured_depth(s, options.run, source == "sensor");
  const VoxelGrid grid = grid_of(options, s.extent.bounds, source == "density");
  std::error_code failed;
  if (targets.stem.has_parent_path()) fs::create_directories(targets.stem.parent_path(), failed);
  if (failed) {
    throw Error(ErrorKind::cannot_create, "files.output.create",
                targets.stem.parent_path().string() + ": cannot create the folder: " + failed.message(),
                "choose another --out");
  }
  print_note(context, fmt::format("{} x {} x {} points, {:.4g} {} apart", grid.nx, grid.ny, grid.nz, grid.spacing,
                                  s.scene.info.metric ? "m" : "units"));
  FoundSurface found;
  if (source == "sensor") {
    found = {fused_surface(measured.training, s.limits, grid), 0, "in the depth images of the training frames", {}};
  } else {
    found = source == "depth" ? surface_of_depth(s, grid, cameras, context)
                              : surface_of_density(options, s, grid, cameras, context);
  }
  Surface& surface = found.surface;
  const std::int64_t components = drop_small_components(surface, options.keep_components);
  if (surface.triangles.empty()) {
    throw Error(ErrorKind::data, "mesh.surface.none", fmt::format("{}: no surface {}", options.run, found.described),
                source == "density" ? "lower --level, or --keep-components, or train longer"
                                    : "train longer, or take --surface density");
  }
  std::size_t closed = 0;
  if (options.close_holes) {
    closed = close_holes(surface, *options.close_holes);
    print_note(context, fmt::format("{} holes closed", closed));
  }
  std::vector<Sights> sights = sights_of(surface, cameras, s.limits, grid.spacing);
  lend_sights(surface, sights);
  surface.attributes = render_attributes(*s.pipeline, surface, {cameras, sights}, kOffsetCells * grid.spacing, s.limits,
                                         s.plan.class_of_logit);
  if (options.faces) reduce(surface, static_cast<std::size_t>(*options.faces), context);
  std::optional<MeshScores> scores;
  if (options.score) scores = scores_of(options, surface, source, s, measured, grid);
  PointSet cloud;
  if (options.points) cloud = points_of(s, grid.spacing, context);
  const auto writes = [&](const char* format) {
    return std::find(targets.formats.begin(), targets.formats.end(), format) != targets.formats.end();
  };
  const bool upright = writes("glb") || writes("html");
  const Vec3d up = upright ? up_of(options, s, context) : Vec3d{0, 1, 0};
  std::vector<std::string> files;
  if (writes("html")) {  // has both colourings
    files.push_back(targets.stem.string() + ".html");
    write_scene_page(files.back(), surface, classes, scene_page_of(run, up));
    const double megabytes = static_cast<double>(fs::file_size(files.back())) * 1e-6;
    print_note(context, fmt::format("{}: {:.1f} MB{}", files.back(), megabytes,
                                    megabytes > kMailMegabytes ? "; --faces makes it smaller" : ""));
  }
  for (const Coloring& coloring : colorings) {
    if (coloring.classes) {
      surface.attributes.color = class_colors(surface.attributes, classes);
      cloud.attributes.color = class_colors(cloud.attributes, classes);
    }
    const std::string stem = targets.stem.string();
    for (const std::string& format : targets.formats) {
      if (format == "html") continue;
      files.push_back(stem + coloring.suffix + "." + format);
      // Photographs hold the light of the room; classes need some to show a form.
      write_surface(format, files.back(), surface, classes, {up, !coloring.classes});
    }
    if (!options.points) continue;
    files.push_back(stem + "_points" + coloring.suffix + ".ply");
    write_ply(files.back(), cloud, classes);
  }
  if (context.json) {
    Json out{{"run", options.run},
             {"step", run.step},
             {"spacing", grid.spacing},
             {"surface", source},
             {"vertices", surface.positions.size()},
             {"faces", surface.triangles.size()},
             {"unseen_faces", found.unseen},
             {"components", components},
             {"files", files}};
    if (found.level) out["level"] = *found.level;
    if (upright) out["up"] = {up.x, up.y, up.z};
    if (options.close_holes) out["holes_closed"] = closed;
    if (options.points) out["points"] = cloud.positions.size();
    if (scores) out["score"] = scores_json(*scores);
    print_json(context, out);
    return 0;
  }
  if (scores) std::fputs(scores_table(*scores, s.scene.info.metric).c_str(), stdout);
  const std::string of_points = options.points ? fmt::format(" points={}", cloud.positions.size()) : "";
  std::printf("mesh: vertices=%zu faces=%zu components=%lld%s file=%s\n", surface.positions.size(),
              surface.triangles.size(), static_cast<long long>(components), of_points.c_str(),
              join(files, ",").c_str());
  return 0;
}

void words(VerbWords& verb, MeshOptions& options) {
  verb.operand("run", options.run, "run folder");
  verb.value_in("--resolution N", options.resolution, 1, 4095,
                "cells along the longest side of the scene (default: 256)");
  verb.positive("--voxel X", options.voxel, "edge of a cell in metres, instead of --resolution");
  verb.excludes("--voxel", "--resolution");
  verb.choice(
      "--surface WHICH", options.surface, {"depth", "density", "sensor"},
      "depth: fused from the depth of the training views; density: where the field becomes opaque; sensor: fused from "
      "the depth images of the training frames (default: depth where rays end in a background, density for what is "
      "alone in empty space)");
  verb.positive("--level X", options.level,
                "density of the surface in 1/m (default: the one that agrees best with rendered depth)");
  verb.list("--format LIST", options.formats, "forms of the files, with commas (default: what --out ends with, or ply)",
            known_formats());
  verb.choice("--color WHICH", options.color, {"photo", "class", "both"},
              "colours as rendered, or of the class table, in files that end in _classes (default: both)");
  verb.choice("--up AXIS", options.up, {"x", "-x", "y", "-y", "z", "-z"},
              "axis of the world that GLB and HTML files show upright (default: as the cameras stand)");
  verb.positive("--close-holes X", options.close_holes, "close holes whose border is at most this long, in metres");
  verb.value_in("--faces N", options.faces, 4, 4294967295.0,
                "at most so many faces: edges are collapsed where form and classes change least");
  verb.flag("--points", options.points, "also write a labelled point cloud from the depth of the training views");
  verb.flag(
      "--score", options.score,
      "also compare the mesh with the scene's depth images: completeness and accuracy within 2, 5 and 10 cm, next to "
      "those of the fused depth images themselves");
  verb.value("--out FILE", options.out, "file to write (default: mesh.ply in the run folder)");
  verb.flag("--keep-unseen", options.keep_unseen, "keep what no training camera sees (default: it is left out)");
  verb.value_in("--keep-components X", options.keep_components, 0, 1,
                "keep connected parts with at least this share of all faces; 0 keeps all");
  verb.run_settings(options.set);
}

}  // namespace

Verb verb_mesh() {
  return with_json(make_verb<MeshOptions>(
      "mesh", 60, "write the field's surface with colour and class, as PLY, OBJ or GLB, or as a page to look at", words,
      run));
}

}  // namespace semfield::app
