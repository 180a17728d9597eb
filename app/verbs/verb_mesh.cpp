// mesh: what a run's cameras saw, as a surface, as points, splats or maps, with colours, class ids and objects.
#include <fmt/format.h>

#include <cstdio>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "app/json_output.h"
#include "app/mesh/hand_over.h"
#include "app/mesh/mesh_targets.h"
#include "app/render/scene_page.h"
#include "app/scene/inspect_report.h"
#include "app/verb.h"
#include "core/error.h"
#include "core/text.h"
#include "run/run_scores.h"
#include "surface/mesh/mesh_files.h"
#include "surface/mesh/surface.h"

namespace semfield::app {

namespace {

namespace fs = std::filesystem;

constexpr double kMailMegabytes = 25;  // what a colleague still gets by mail

Vec3d offset_of(const std::string& format, const Surface& surface) {
  return format == "glb" ? offset_of_floats(box_around(surface.positions)) : Vec3d{};
}

void write_surface(const std::string& format, const std::string& path, const Surface& surface,
                   const ClassTable& classes, const GlbLook& look) {
  if (format == "ply") write_ply(path, surface, classes);
  if (format == "obj") write_obj(path, surface, classes);
  if (format == "glb") write_glb(path, surface, classes, look);
}

// The axis that is upright, and what the cameras say where none is named.
struct Upright {
  std::optional<Vec3d> known;
  std::string note;
};

Upright wanted_upright(const MeshOptions& options, const Session& s) {
  if (const auto named = axis_named(options.up)) return {named, ""};
  const std::optional<Vec3d> up = upright_of(s);
  if (!up) return {up, "the cameras do not tell which way is up: files show +y upright; --up names another axis"};
  return {up, fmt::format("files show {} upright, as the cameras stand; --up names another axis", axis_text(*up))};
}

void make_folder_of(const fs::path& stem) {
  std::error_code failed;
  if (stem.has_parent_path()) fs::create_directories(stem.parent_path(), failed);
  if (failed)
    throw Error(ErrorKind::cannot_create, "files.output.create",
                stem.parent_path().string() + ": cannot create the folder: " + failed.message(),
                "choose another --out");
}

void write_page(const MeshTargets& targets, const Surface& surface, const OpenedRun& run, Vec3d up,
                const AppContext& context) {
  const std::string path = targets.file("html");
  write_scene_page(path, surface, run.session.scene.info.classes,
                   scene_page_of(run.session, run.run_dir, run.step, up));
  const double megabytes = static_cast<double>(fs::file_size(path)) * 1e-6;
  print_note(context, fmt::format("{}: {:.1f} MB{}", path, megabytes,
                                  megabytes > kMailMegabytes ? "; --faces makes it smaller" : ""));
}

// Surfaces, and the points of --points, in each colouring.
void write_colored(const MeshOptions& options, const MeshTargets& targets, Surface& surface, Vec3d up,
                   const OpenedRun& run, HandOver& out) {
  const ClassTable& classes = run.session.scene.info.classes;
  PointSet cloud;
  if (options.points) cloud = out.points();
  for (const Coloring& coloring : mesh_colorings(options, run.session.pipeline->has_semantics())) {
    if (coloring.classes) {
      surface.attributes.color = class_colors(surface.attributes, classes);
      cloud.attributes.color = class_colors(cloud.attributes, classes);
    }
    for (const std::string& format : targets.formats) {
      if (format != "ply" && format != "obj" && format != "glb") continue;
      const std::string path = targets.file(format, coloring.suffix);
      // Photographs hold the light of the room; classes need some to show a form.
      write_surface(format, path, surface, classes, {up, !coloring.classes, out.objects()});
      out.add(path, "surface", offset_of(format, surface));
    }
    if (!options.points) continue;
    const std::string path = targets.file("ply", "_points" + coloring.suffix);
    write_ply(path, cloud, classes);
    out.add(path, "points");
  }
}

int run(const MeshOptions& options, AppContext& context) {
  const MeshTargets targets = mesh_targets(options);
  const bool wants_surface = targets.surfaces() || options.score;
  Diagnostics diagnostics;
  OpenedRun run = open_run(
      options.run, options.set, context.registry, diagnostics,
      options.score || options.source == "sensor" ? OpenFor::evaluation_of_training_frames : OpenFor::rendering);
  context.adopt(run.session.config);
  for (const Diagnostic& finding : folded(diagnostics)) print_note(context, finding.shown());
  const Session& s = run.session;
  mesh_colorings(options, s.pipeline->has_semantics());
  surface_source(options, s);
  const bool upright = targets.writes("glb") || targets.writes("html") || targets.writes("pgm");
  const Upright found_up = wanted_upright(options, s);
  const Vec3d up = found_up.known.value_or(Vec3d{0, 1, 0});
  HandOver out(options, targets, run, upright ? up : found_up.known, context);
  make_folder_of(targets.stem);
  FoundSurface found;
  if (wants_surface) {
    found = find_surface(options, run, context);
    found.surface.attributes.instance = out.instances(found.surface.positions);
  }
  out.look();
  if (upright && !found_up.note.empty()) print_note(context, found_up.note);
  if (targets.writes("html")) {  // has both colourings
    write_page(targets, found.surface, run, up, context);
    out.add(targets.file("html"), "page");
  }
  write_colored(options, targets, found.surface, up, run, out);
  out.write();
  out.finish();
  const std::size_t points = out.points().positions.size();
  if (context.json) {
    Json told{{"run", options.run}, {"step", run.step}};
    if (wants_surface) {
      told["spacing"] = found.grid.spacing;
      told["surface"] = found.source;
      told["vertices"] = found.surface.positions.size();
      told["faces"] = found.surface.triangles.size();
      told["unseen_faces"] = found.unseen;
      told["components"] = found.components;
    }
    told["files"] = out.files();
    if (found.level) told["level"] = *found.level;
    if (upright) told["up"] = {up.x, up.y, up.z};
    if (options.close_holes && wants_surface) told["holes_closed"] = found.closed;
    if (points > 0) told["points"] = points;
    if (found.scores) told["score"] = scores_json(*found.scores);
    print_json(context, told);
    return 0;
  }
  if (found.scores) std::fputs(scores_table(*found.scores, s.scene.info.metric).c_str(), stdout);
  std::string line = "mesh:";
  if (wants_surface)
    line += fmt::format(" vertices={} faces={} components={}", found.surface.positions.size(),
                        found.surface.triangles.size(), found.components);
  if (points > 0) line += fmt::format(" points={}", points);
  std::printf("%s file=%s\n", line.c_str(), join(out.files(), ",").c_str());
  print_next(context, next_of_look(options.run));
  return 0;
}

void words(VerbWords& verb, MeshOptions& options) {
  verb.operand("run", options.run, "run folder");
  verb.value_in("--resolution N", options.resolution, 1, 4095,
                "cells along the longest side of the scene (default: 256)");
  verb.positive("--voxel X", options.voxel, "edge of a cell in metres, instead of --resolution");
  verb.excludes("--voxel", "--resolution");
  verb.choice(
      "--surface WHICH", options.source, {"depth", "density", "sensor"},
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
              "axis of the world that GLB, HTML and PGM files show upright (default: as the cameras stand)");
  verb.positive("--close-holes X", options.close_holes, "close holes whose border is at most this long, in metres");
  verb.list(
      "--band LOW,HIGH", options.band,
      "heights above the floor whose obstacles a PGM shows (default: 0.1,1 in metres; 1/50 and 1/5 of the longest side "
      "of a scene that is no room in metres)");
  verb.value_in("--faces N", options.faces, 4, 4294967295.0,
                "at most so many faces: edges are collapsed where form and classes change least");
  verb.flag("--points", options.points, "also write a labelled point cloud from the depth of the training views");
  verb.flag(
      "--score", options.score,
      "also compare the mesh with the scene's depth images: completeness and accuracy within 2, 5 and 10 cm (1/250, "
      "1/100 and 1/50 of the longest side of a scene that is no room in metres), next to those of the fused depth "
      "images themselves");
  verb.value("--out FILE", options.out, "file to write, or a folder for mesh.ply (default: the run folder)");
  verb.flag("--keep-unseen", options.keep_unseen, "keep what no training camera sees (default: it is left out)");
  verb.value_in("--keep-components X", options.keep_components, 0, 1,
                "keep connected parts with at least this share of all faces; 0 keeps all");
  verb.run_settings(options.set);
}

}  // namespace

Verb verb_mesh() {
  return with_json(make_verb<MeshOptions>(
      "mesh", 60, "write what the cameras saw with colour, class and object: a surface, points, splats, maps, a page",
      words, run));
}

}  // namespace semfield::app
