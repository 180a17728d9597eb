// mesh, objects: what a run's cameras saw, as files for other programs, and the things in it.
#include <fmt/format.h>

#include <algorithm>
#include <nlohmann/json.hpp>

#include "app/objects/object_files.h"
#include "app/render/run_surface.h"
#include "app/scene/inspect_report.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "core/error.h"
#include "core/files.h"
#include "core/small_math.h"
#include "core/text.h"
#include "labels/segments.h"
#include "scene/camera_rig.h"
#include "surface/mesh/mesh_files.h"
#include "surface/mesh/point_files.h"
#include "surface/mesh/score/mesh_score.h"
#include "surface/mesh/surface.h"
#include "surface/mesh/voxel_map.h"
#include "surface/objects/find_objects.h"
#include "surface/objects/object_score.h"
#include "surface/objects/object_set.h"
#include "train/opened_run.h"

namespace semfield::app {

// mesh: what a run's cameras saw, as a surface, as points or maps, with colours, class ids and objects.

namespace {

enum class Holds : std::uint8_t { surface, page, points, map };

// Each is called by the ending of its files.
constexpr std::pair<const char*, Holds> kForms[] = {
    {"ply", Holds::surface}, {"obj", Holds::surface}, {"glb", Holds::surface}, {"html", Holds::page},
    {"las", Holds::points},  {"pcd", Holds::points},  {"npz", Holds::map},     {"bt", Holds::map},
    {"ot", Holds::map},      {"pgm", Holds::map}};

std::vector<std::string> known_formats() {
  std::vector<std::string> names;
  for (const auto& [name, holds] : kForms) names.emplace_back(name);
  return names;
}

struct MeshOptions : Options {
  explicit MeshOptions(const Declaration& at) : Options(at) { excludes("--voxel", "--resolution"); }
  const std::string& run = operand("run", "run folder");
  const std::optional<long long>& resolution = value_in<std::optional<long long>>(
      "--resolution N", {}, 1, 4095, "cells along the longest side of the scene (default: 256)");
  const std::optional<double>& voxel = positive("--voxel X", "edge of a cell in metres, instead of --resolution");
  const std::string& source =
      choice("--surface WHICH", "", {"depth", "density", "sensor"},
             "depth: fused from the depth of the training views; density: where the field becomes opaque; sensor: "
             "fused from the depth images of the training frames (default: depth where rays end in a background, "
             "density for what is alone in empty space)");
  const std::optional<double>& level =
      positive("--level X", "density of the surface in 1/m (default: the one that agrees best with rendered depth)");
  const std::vector<std::string>& formats =
      list("--format LIST", "file formats, with commas (default: the extension of --out, or ply)", known_formats());
  const std::string& color =
      choice("--color WHICH", "", {"photo", "class", "both"},
             "colours of the photographs, or of the class table, in files that end in _classes (default: both)");
  const std::string& up =
      choice("--up AXIS", "", {"x", "-x", "y", "-y", "z", "-z"},
             "axis of the world that GLB, HTML and PGM files show upright (default: as the cameras stand)");
  const std::optional<double>& close_holes =
      positive("--close-holes X", "close holes whose border is at most this long, in metres");
  const std::vector<std::string>& band = list(
      "--band LOW,HIGH",
      "heights above the floor whose obstacles a PGM shows (default: 0.1,1 in metres; 1/50 and 1/5 of the longest side "
      "of a scene that is no room in metres)");
  const std::optional<long long>& faces = value_in<std::optional<long long>>(
      "--faces N", {}, 4, 4294967295.0,
      "at most so many faces: edges are collapsed where form and classes change least");
  const bool& points = flag("--points", "also write a labelled point cloud from the depth of the training views");
  const bool& score = flag(
      "--score",
      "also compare the mesh with the scene's depth images: completeness and accuracy within 2, 5 and 10 cm (1/250, "
      "1/100 and 1/50 of the longest side of a scene that is no room in metres), next to those of the fused depth "
      "images themselves");
  const std::string& out = value("--out FILE", "file to write, or a folder for mesh.ply (default: the run folder)");
  const bool& keep_unseen = flag("--keep-unseen", "keep what no training camera sees (default: it is left out)");
  const double& keep_components = value_in("--keep-components X", SurfaceWishes().keep_components, 0, 1,
                                           "keep connected parts with at least this share of all faces; 0 keeps all");
  const std::vector<std::string>& set = run_settings();

  SurfaceWishes surface() const {
    return {source, resolution, voxel, level, keep_unseen, keep_components, close_holes, faces};
  }
};

/// One way of colouring, and what its files' names have behind the stem.
struct Coloring {
  bool classes;
  std::string suffix;
};

void check_format(const std::string& name, const std::string& where) {
  const std::vector<std::string> known = known_formats();
  if (std::find(known.begin(), known.end(), name) != known.end()) return;
  const std::string near = did_you_mean(name, known);
  throw Error(ErrorKind::usage, "mesh.format.unknown", where + ": unknown mesh format '" + name + "'",
              "one of " + join(known) + (near.empty() ? std::string() : "; did you mean " + near + "?"));
}

struct MeshTargets {
  fs::path stem;  ///< path without the form's ending
  std::vector<std::string> formats;

  bool writes(const std::string& format) const {
    return std::find(formats.begin(), formats.end(), format) != formats.end();
  }
  bool writes(Holds holds) const {
    return std::any_of(std::begin(kForms), std::end(kForms),
                       [&](const auto& form) { return form.second == holds && writes(form.first); });
  }
  /// Whether any form needs triangles.
  bool surfaces() const { return writes(Holds::surface) || writes(Holds::page); }
  std::string file(const std::string& format, const std::string& suffix = "") const {
    return stem.string() + suffix + "." + format;
  }
};

// Throws Error(usage) for an ending that is no form.
MeshTargets mesh_targets(const MeshOptions& options) {
  const bool folder = options.out.empty() || options.out.ends_with('/') || is_folder(options.out);
  const fs::path into = options.out.empty() ? options.run : options.out;
  MeshTargets targets{folder ? into / "mesh" : into, options.formats};
  std::string ending;
  const std::string name = folder ? std::string() : targets.stem.filename().string();
  if (name.ends_with(".splats.ply")) check_format("splats.ply", "--out " + options.out);  // of 1.0: no surface is meant
  for (const std::string& format : known_formats())
    if (name.ends_with("." + format)) ending = format;
  if (targets.formats.empty()) {
    const fs::path extension = folder ? fs::path() : targets.stem.extension();
    if (ending.empty() && !extension.empty()) check_format(extension.string().substr(1), "--out " + options.out);
    targets.formats = {ending.empty() ? "ply" : ending};
  }
  if (!ending.empty())  // "scan.v2" keeps its name
    targets.stem.replace_filename(name.substr(0, name.size() - ending.size() - 1));
  return targets;
}

// Of surfaces and of the points of --points. Throws Error(data) for class colours of a run without semantics.
std::vector<Coloring> mesh_colorings(const MeshOptions& options, bool has_classes) {
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

// What --voxel says, or the longest side over --resolution, or over `cells`.
double spacing_of(const MeshOptions& options, const Box& bounds, long long cells) {
  const Vec3d size = bounds.size();
  return options.voxel.value_or(std::max({size.x, size.y, size.z}) /
                                static_cast<double>(options.resolution.value_or(cells)));
}

constexpr long long kMeshResolution = 256;  // cells along the longest side, where none are asked for
constexpr long long kMapResolution = 128;   // of scenes that are no rooms in metres
constexpr double kMapEdge = 0.05;           // metres; what robots plan with

// What a robot of half a metre meets.
HeightBand band_of(const MeshOptions& options, double metre) {
  HeightBand band{0.1 * metre, metre};
  if (options.band.empty()) return band;
  const bool sound = options.band.size() == 2 && parse_number(options.band[0], band.low) &&
                     parse_number(options.band[1], band.high) && band.low < band.high;
  if (!sound)
    throw Error(ErrorKind::usage, "handover.band.format", "--band " + join(options.band, ",") + ": not two heights",
                "give the lower and the upper one, as in --band 0.1,1");
  return band;
}

// Points and maps as files for other programs, and what goes with all files.
class HandOver {
 public:
  /// Reads the objects of the run, where it has some, and notes those of another step. Borrows all but `up`, which is
  /// the axis of the world that is upright, where it is known.
  HandOver(const MeshOptions& options, const MeshTargets& targets, OpenedRun& run, std::optional<Vec3d> up,
           const AppContext& context)
      : options_(options),
        targets_(targets),
        run_(run),
        context_(context),
        objects_(objects_of_run(run.run_dir, run.session.scene.info.classes.valid_count())) {
    const std::int64_t step = objects_ ? nlohmann::json::parse(objects_->about).value("step", run.step) : run.step;
    if (step != run.step)
      print_note(context,
                 fmt::format("the objects of {} are of step {}, the field is of step {}; `semfield objects {}` "
                             "finds them again",
                             run.run_dir, step, run.step, shell_word(run.run_dir)));
    const Session& s = run.session;
    sidecar_.run = run.run_dir;
    sidecar_.scene = s.scene.info.name;
    sidecar_.step = run.step;
    sidecar_.metric = s.scene.info.metric;
    sidecar_.up = up;
    sidecar_.convention = s.config.load.convention;
    if (s.pipeline->has_semantics()) sidecar_.classes = &classes();
    sidecar_.objects = objects();
    metre_ = usual_metre(sidecar_.metric, s.extent.bounds.size());
    band_of(options, metre_);  // before any work
  }

  const ObjectSet* object_set() const { return objects_ ? &*objects_ : nullptr; }

  /// Names of the objects by their ids.
  std::map<std::int32_t, std::string> objects() const {
    std::map<std::int32_t, std::string> names;
    if (!objects_) return names;
    for (const ObjectRow& row : objects_->rows)
      if (row.points > 0) names[row.id] = object_name(row, classes());
    return names;
  }

  /// Renders the training views, where a form needs them. Throws Error(usage) for cubes that are too many.
  void look() {
    Session& s = run_.session;
    if (!wants_points() && !targets_.writes(Holds::map)) return;
    const Box& bounds = s.extent.bounds;
    PointCloud cloud(spacing_of(options_, bounds, kMeshResolution), s.pipeline->options().rules.background());
    const auto around = [&](double edge) {  // a wall on the bounds lies in the cube behind them
      const Vec3d margin{edge, edge, edge};
      return VoxelGridPlace::covering({bounds.lo - margin, bounds.hi + margin}, edge);
    };
    if (targets_.writes(Holds::map)) {
      const bool usual = !options_.voxel && !options_.resolution && is_in_metres(s.scene.info.metric, bounds.size());
      const double edge = usual ? kMapEdge : spacing_of(options_, bounds, kMapResolution);
      map_.emplace(around(edge));
    }
    const std::vector<int> frames = s.scene.frames_of(Split::train);
    const std::vector<RayCamera> cameras = training_cameras(s);
    ProgressLine progress(context_, "points of", "views");
    for (std::size_t i = 0; i < frames.size(); ++i) {
      const RayCamera& camera = cameras[i];
      const std::string& name = s.scene.info.frames[static_cast<std::size_t>(frames[i])].name;
      const auto part_done = [&](double share) {
        progress.show(static_cast<double>(i) + share, static_cast<double>(frames.size()));
      };
      const RenderedFrame frame =
          render_named_frame(*s.pipeline, name, camera, s.limits, s.plan.class_of_logit, {}, {1, part_done});
      const SeenPixels pixels = seen_pixels(camera, frame);
      if (wants_points()) cloud.add(frame, pixels);
      if (map_) map_->add(camera, frame, pixels);
    }
    points_ = cloud.points();
    if (objects_) points_.attributes.instance = objects_->at(points_.positions);
  }

  const PointSet& points() const { return points_; }  ///< empty unless --points or a form asks for them
  /// Writes every form that is no surface, and adds its files.
  void write() {
    if (options_.color == "class") points_.attributes.color = class_colors(points_.attributes, classes());
    for (const std::string& format : known_formats()) {
      if (!targets_.writes(format)) continue;
      const std::string path = targets_.file(format);
      if (format == "las") {
        write_las(path, points_, classes());
        add(path, "points");  // readers add the header's offset by themselves
      } else if (format == "pcd") {
        const Vec3d offset = offset_of_floats(box_around(points_.positions));
        write_pcd(path, points_, classes(), offset);
        add(path, "points", offset);
      } else if (format == "npz") {
        write_voxels(path, *map_, classes());
        add_map(path, "voxels");
      } else if (format == "bt" || format == "ot") {
        add_map(path, "voxels", write_octomap(path, *map_, classes(), format == "ot"));
      } else if (format == "pgm") {
        write_map_of_floor(path);
      }
    }
  }

  /// A file that was written elsewhere.
  void add(const std::string& path, const std::string& holds, Vec3d offset = {}) {
    sidecar_.files.push_back({path, holds, offset});
  }

  /// Writes the sidecar, STEM.json, which is none of files(), unless nothing but a page was written.
  void finish() {
    const bool page_alone = std::all_of(sidecar_.files.begin(), sidecar_.files.end(),
                                        [](const HandedFile& file) { return file.holds == "page"; });
    if (!page_alone) write_file_atomic(targets_.stem.string() + ".json", sidecar_json(sidecar_));
  }

  std::vector<std::string> files() const {
    std::vector<std::string> out;
    for (const HandedFile& file : sidecar_.files) out.push_back(file.path);
    return out;
  }

 private:
  bool wants_points() const { return options_.points || targets_.writes(Holds::points); }
  const ClassTable& classes() const { return run_.session.scene.info.classes; }

  void add_map(const std::string& path, const char* holds, Vec3d offset = {}) {
    add(path, holds, offset);
    sidecar_.files.back().edge = map_->place().edge;
  }
  void write_map_of_floor(const std::string& path) {
    const Costmap map = costmap_of(*map_, sidecar_.up.value_or(Vec3d{}), band_of(options_, metre_));
    const std::string yaml = write_costmap(path, map);
    print_note(context_, fmt::format("the floor is at {:.3g} along {}; {} has what lies {:.3g} to {:.3g} above it",
                                     map.floor, axis_text(*sidecar_.up), path, map.band.low, map.band.high));
    add_map(path, "costmap");
    add_map(yaml, "costmap");
  }

  const MeshOptions& options_;
  const MeshTargets& targets_;
  OpenedRun& run_;
  const AppContext& context_;
  std::optional<ObjectSet> objects_;
  Sidecar sidecar_;
  double metre_ = 1;  // usual_metre() of the scene
  PointSet points_;
  std::optional<VoxelMap> map_;
};

// The score of a mesh against a scene's depth images, for `mesh --score`.

/// Depth images of a scene as views.
struct MeasuredDepth {
  std::vector<DepthView> training, held_out;
};

/// Scores of a run's mesh, and of what the same fusion makes of the depth images of its training frames.
struct MeshScores {
  double metre = 1;  ///< of distances, in units of the scene (usual_metre)
  std::size_t points = 0, held_out_points = 0;
  MeshScore mesh;
  std::optional<MeshScore> sensor;  ///< none without depth of training frames
};

Json one_json(const MeshScore& score) {
  return {{"complete", score.complete},
          {"complete_of_held_out", score.complete_of_held_out ? Json(*score.complete_of_held_out) : Json()},
          {"accurate", score.accurate},
          {"f", score.f},
          {"judged", score.judged}};
}

ScoreShares distances_of(const MeshScores& scores) {
  ScoreShares out = kScoreDistances;
  for (double& distance : out) distance *= scores.metre;
  return out;
}

std::string cells(const std::optional<ScoreShares>& shares) {
  std::string out;
  for (std::size_t k = 0; k < kScoreDistances.size(); ++k)
    out += shares ? fmt::format("{:>8.1f} %", 100 * (*shares)[k]) : fmt::format("{:>10}", "-");
  return out;
}

std::vector<DepthView> views_of(const Session& s, Split split) {
  std::vector<DepthView> views;
  for (const int f : s.scene.frames_of(split)) {
    const FrameInfo& info = s.scene.info.frames[static_cast<std::size_t>(f)];
    const DepthMap& depth = s.scene.frames[static_cast<std::size_t>(f)].depth_m;
    if (!depth.empty())
      views.push_back(measured_view({info.camera, info.world_from_camera, s.plan.undistortion}, depth));
  }
  return views;
}

// Of a session that keeps all depth. Throws Error(data) that names the run where no frame of the scene has a depth
// image, or, with `training_needed`, no training frame.
MeasuredDepth measured_depth(const Session& session, const std::string& run, bool training_needed) {
  MeasuredDepth depth{views_of(session, Split::train), views_of(session, Split::test)};
  if (depth.training.empty() && (training_needed || depth.held_out.empty()))
    throw Error(
        ErrorKind::data, "mesh.depth.none",
        fmt::format("{}: no {} frame of the scene has a depth image", run, training_needed ? "training" : "single"),
        "leave out what asks for measured depth: --score, --surface sensor");
  return depth;
}

Json scores_json(const MeshScores& scores) {
  return {{"distances", distances_of(scores)},
          {"points", scores.points},
          {"held_out_points", scores.held_out_points},
          {"mesh", one_json(scores.mesh)},
          {"sensor", scores.sensor ? one_json(*scores.sensor) : Json()}};
}

// A table with a line at each end. `metric`: the scene is in metres; distances are shown in centimetres, or else in its
// own unit.
std::string scores_table(const MeshScores& scores, bool metric) {
  std::string head;
  for (const double distance : distances_of(scores))
    head += metric ? fmt::format("{:>7.4g} cm", 100 * distance) : fmt::format("{:>10.4g}", distance);
  std::string text = fmt::format("{:<24}{}   {} points of depth images, {} of held-out frames\n", "within", head,
                                 scores.points, scores.held_out_points);
  const auto rows = [&](const std::string& name, const MeshScore& score) {
    text += fmt::format("{:<24}{}\n", name + ": complete", cells(score.complete));
    text += fmt::format("{:<24}{}\n", "  of held-out frames", cells(score.complete_of_held_out));
    text += fmt::format("{:<24}{}   {:.1f} % of the mesh is judged\n", "  accurate", cells(score.accurate),
                        100 * score.judged);
    text += fmt::format("{:<24}{}\n", "  F", cells(score.f));
  };
  rows("mesh", scores.mesh);
  if (scores.sensor) rows("sensor", *scores.sensor);
  return text;
}

// The surface of a run as `semfield mesh` is asked for it, with figures.

struct FoundSurface : RunSurface {
  std::optional<MeshScores> scores;
};

// The mesh's, and that of the fused depth images, which is the mesh itself where it was made of them.
MeshScores scores_of(const MeshOptions& options, const RunSurface& found, const Session& s,
                     const MeasuredDepth& measured) {
  const double metre = usual_metre(s.scene.info.metric, s.extent.bounds.size());
  const DepthReference reference(measured.training, measured.held_out, metre);
  MeshScores scores{metre, reference.points(), reference.held_out_points(), reference.score(found.surface), {}};
  if (found.source == "sensor" || measured.training.empty()) return scores;
  Surface of_sensor = fused_surface(measured.training, s.limits, found.grid);
  drop_small_components(of_sensor, options.keep_components);
  scores.sensor = reference.score(of_sensor);
  return scores;
}

// Throws Error(data) where there is no surface, or nothing of it is seen.
FoundSurface find_surface(const MeshOptions& options, OpenedRun& run, const ObjectSet* objects,
                          const AppContext& context) {
  const Session& s = run.session;
  const bool of_sensor = surface_source(options.surface(), s) == "sensor";
  MeasuredDepth measured;
  if (options.score || of_sensor) measured = measured_depth(run.session, options.run, of_sensor);
  ProgressLine progress(context, "depth of", "views");
  FoundSurface found{make_run_surface(s, options.run, options.surface(), measured.training, objects,
                                      {[&](const std::string& note) { print_note(context, note); },
                                       [&](double done, double of) { progress.show(done, of); }}),
                     {}};
  if (options.score) found.scores = scores_of(options, found, s, measured);
  return found;
}

constexpr double kMailMegabytes = 25;  // what a colleague still gets by mail

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
      const std::string path = targets.file(format, coloring.suffix);
      if (format == "ply") {
        write_ply(path, surface, classes);
      } else if (format == "obj") {
        write_obj(path, surface, classes);
      } else if (format == "glb") {  // photographs hold the light of the room; classes need some to show a form
        write_glb(path, surface, classes, {up, !coloring.classes, out.objects()});
      } else {
        continue;
      }
      out.add(path, "surface", format == "glb" ? offset_of_floats(box_around(surface.positions)) : Vec3d{});
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
  const bool measured = options.score || options.source == "sensor";
  OpenedRun run =
      run_of(options.run, options.set, measured ? OpenFor::evaluation_of_training_frames : OpenFor::surface, context);
  const Session& s = run.session;
  mesh_colorings(options, s.pipeline->has_semantics());
  surface_source(options.surface(), s);
  const bool upright = targets.writes("glb") || targets.writes("html") || targets.writes("pgm");
  const Upright found_up = wanted_upright(options, s);
  const Vec3d up = found_up.known.value_or(Vec3d{0, 1, 0});
  HandOver out(options, targets, run, upright ? up : found_up.known, context);
  create_output_folder(targets.stem.parent_path());
  FoundSurface found;
  if (wants_surface) found = find_surface(options, run, out.object_set(), context);
  out.look();
  if (upright && !found_up.note.empty()) print_note(context, found_up.note);
  if (targets.writes("html")) {  // has both colourings
    const std::string path = targets.file("html");
    write_scene_page(path, found.surface, s.scene.info.classes, scene_page_of(s, run.run_dir, run.step, up));
    const double megabytes = static_cast<double>(fs::file_size(path)) * 1e-6;
    print_note(context, fmt::format("{}: {:.1f} MB{}", path, megabytes,
                                    megabytes > kMailMegabytes ? "; --faces makes it smaller" : ""));
    out.add(path, "page");
  }
  write_colored(options, targets, found.surface, up, run, out);
  out.write();
  out.finish();
  const std::size_t points = out.points().positions.size();
  Json told{{"run", options.run}, {"step", run.step}};
  std::string text = found.scores ? scores_table(*found.scores, s.scene.info.metric) : "";
  if (wants_surface)
    text += fmt::format("A surface of {} triangles in {} piece{} was found {}.\n", found.surface.triangles.size(),
                        found.components, found.components == 1 ? "" : "s", found.described);
  text += "mesh:";
  if (wants_surface) {
    const std::size_t vertices = found.surface.positions.size(), faces = found.surface.triangles.size();
    told.update({{"spacing", found.grid.spacing},
                 {"surface", found.source},
                 {"vertices", vertices},
                 {"faces", faces},
                 {"unseen_faces", found.unseen},
                 {"components", found.components}});
    text += fmt::format(" vertices={} faces={} components={}", vertices, faces, found.components);
  }
  told["files"] = out.files();
  if (found.level) told["level"] = *found.level;
  if (upright) told["up"] = {up.x, up.y, up.z};
  if (options.close_holes && wants_surface) told["holes_closed"] = found.closed;
  if (points > 0) {
    told["points"] = points;
    text += fmt::format(" points={}", points);
  }
  if (found.scores) told["score"] = scores_json(*found.scores);
  print_results(context, told, text + " file=" + join(out.files(), ","));
  print_next(context, next_of_look(options.run));
  return 0;
}

}  // namespace

Verb verb_mesh() {
  return make_verb<MeshOptions>(
      "mesh", 60, "write what the cameras saw with colour, class and object: a surface, points, maps, a page",
      {"runs/my_photos --format ply,html", "runs/my_photos --out room.glb --faces 200000"}, run);
}

// objects: things of a run's scene told apart by segments of its images, as images, a table, points and figures.

namespace {

struct ObjectsOptions : Options {
  explicit ObjectsOptions(const Declaration& at) : Options(at) { needs("--pattern", "--segments"); }
  const std::string& run = operand("run", "run folder");
  const std::string& segments =
      value("--segments PATH",
            "segments of the training images: a folder of PNGs, JSON or NumPy masks, a COCO file, or clicks.jsonl "
            "(default: the scene's own instances)");
  const std::string& pattern =
      value("--pattern NAME", "how files of that folder are named, with {name}, {stem} or {number} of the frame");
  const std::string& split =
      choice("--split SPLIT", "test", {"test", "train"}, "frames whose objects are written as images");
  const bool& score = flag("--score", "also figures of those frames against the scene's own labels and instances");
  const std::string& out = value("--out FOLDER", "folder to write (default: objects/ in the run folder)");
  const std::vector<std::string>& set = run_settings();
};

PluginSlot usual_method(const Registry& registry) {
  PluginSlot slot;
  slot.entry = &registry.usual_grouping();
  slot.params = slot.entry->new_params();
  return slot;
}

/// Objects of a class.
struct Count {
  int found = 0, truth = 0;
};

// `counts`: by class, of the whole scene.
Json figures_json(const ObjectFigures& f, const std::map<std::string, Count>& counts) {
  Json of_classes = Json::object();
  double wrong = 0, all = 0;
  for (const auto& [name, count] : counts) {
    of_classes[name] = {{"found", count.found}, {"true", count.truth}};
    wrong += std::abs(count.found - count.truth);
    all += count.truth;
  }
  return {{"counts", of_classes},
          {"miscounted", wrong / std::max(1.0, all)},
          {"pq", f.pq},
          {"sq", f.sq},
          {"rq", f.rq},
          {"pq_things", f.pq_things},
          {"pq_stuff", f.pq_stuff},
          {"mcov", f.mcov},
          {"count_error", f.count_error},
          {"true_objects", f.objects},
          {"found_objects", f.found},
          {"matched_objects", f.matched}};
}

Json about(const ObjectsOptions& options, const OpenedRun& run, const SegmentSet& segments, const FoundObjects& found) {
  const Session& s = run.session;
  Json seconds;
  double all = 0;
  for (const auto& [part, took] : found.seconds) {
    seconds[part] = took;
    all += took;
  }
  seconds["all"] = all;
  RunConfig& editable = const_cast<RunConfig&>(s.config);  // describe() takes a mutable struct; the writer only looks
  return {
      {"run", options.run},
      {"step", run.step},
      {"segments_from", segments.from},
      {"segments", segments.count()},
      {"method", s.config.grouping.entry->name},
      {"parameters", write_config(params_to_config([&](ParamVisitor& visit) { describe(visit, editable.objects); }))},
      {"damage",
       write_config(params_to_config([&](ParamVisitor& visit) { describe(visit, editable.segment_damage); }))},
      {"cell", found.surface.pool.cell_m()},
      {"seconds", seconds}};
}

Split split_of(const ObjectsOptions& options) { return options.split == "test" ? Split::test : Split::train; }

std::vector<int> frames_of(const ObjectsOptions& options, const Session& s) {
  return s.scene.frames_of(split_of(options));
}

bool has_truth(const Session& s, int frame) {
  const StoredFrame& stored = s.scene.frames[static_cast<std::size_t>(frame)];
  return !stored.instance.empty() && !stored.label.empty();
}

// Before any work, and before any file.
void check_truth(const ObjectsOptions& options, const Session& s) {
  const std::vector<int> frames = frames_of(options, s);
  if (!options.score || std::any_of(frames.begin(), frames.end(), [&](int f) { return has_truth(s, f); })) return;
  throw Error(ErrorKind::data, "objects.truth.none",
              options.run + ": no frame of split '" + options.split + "' has true labels and instances",
              "leave --score out");
}

// Of each class, by its name. Those of the truth are seen in at least so many pixels of all frames together; without
// --score there is none.
std::map<std::string, Count> counts_of(const ObjectsOptions& options, const Session& s, const FoundObjects& found) {
  const ClassTable& classes = s.scene.info.classes;
  std::map<std::string, Count> counts;
  for (const ObjectRow& row : found.rows)
    if (row.points > 0) ++counts[object_class_name(row, classes)].found;
  if (!options.score) return counts;
  std::map<std::int32_t, std::map<std::int16_t, std::int64_t>> pixels;  // of each true object, by class
  for (int f = 0; f < std::ssize(s.scene.frames); ++f) {
    if (!has_truth(s, f)) continue;
    const StoredFrame& frame = s.scene.frames[static_cast<std::size_t>(f)];
    const std::vector<std::int16_t> label = frame.label.expand();
    for (std::size_t i = 0; i < label.size(); ++i)
      if (frame.instance[i] != 0 && label[i] != kVoid) ++pixels[frame.instance[i]][label[i]];
  }
  for (const auto& [id, of_class] : pixels) {
    std::int64_t all = 0;
    for (const auto& [index, n] : of_class) all += n;
    const auto most = std::max_element(of_class.begin(), of_class.end(),
                                       [](const auto& a, const auto& b) { return a.second < b.second; });
    if (all >= ObjectScore::kLeastPx && !found.stuff[static_cast<std::size_t>(most->first)])
      ++counts[classes.valid(most->first).name].truth;
  }
  return counts;
}

// Renders the views, writes them, and scores those of which the scene knows objects.
std::optional<ObjectFigures> write_views(const ObjectsOptions& options, Session& s, FoundObjects& found,
                                         ObjectFiles& files, const AppContext& context) {
  const std::vector<int> frames = frames_of(options, s);
  ObjectScore score(found.rows, found.stuff, ObjectScore::kLeastPx);
  ProgressLine progress(context, "rendered");
  for (std::size_t k = 0; k < frames.size(); ++k) {
    const auto n = static_cast<std::size_t>(frames[k]);
    const FrameInfo& info = s.scene.info.frames[n];
    const RayCamera camera{info.camera, info.world_from_camera, s.plan.undistortion};
    std::vector<std::int16_t> label;
    if (s.pipeline->has_semantics()) {
      FrameOptions wanted;
      wanted.color = false;
      label = render_named_frame(*s.pipeline, info.name, camera, s.limits, s.plan.class_of_logit, {}, wanted).label;
    }
    const std::vector<std::int32_t> ids = object_ids(s, found, camera, label);
    files.add({info, ids, label});
    progress.show(static_cast<double>(k + 1), static_cast<double>(frames.size()));
    if (!options.score || !has_truth(s, frames[k])) continue;
    const std::vector<std::int16_t> true_label = s.scene.frames[n].label.expand();
    score.add({true_label, s.scene.frames[n].instance, label, ids});
  }
  if (!options.score) return std::nullopt;
  return score.figures();
}

SegmentSet segments_of(const ObjectsOptions& options, const LoadedScene& scene, const AppContext& context) {
  if (options.segments.empty()) return segments_of_scene(scene);
  if (!options.segments.ends_with(".jsonl")) return read_segments(options.segments, options.pattern, scene.info);
  Diagnostics diagnostics;
  SegmentSet clicks = segments_of_clicks(options.segments, scene.info, diagnostics);
  for (const Diagnostic& finding : diagnostics.all()) print_note(context, finding.shown());
  return clicks;
}

void tell_unclaimed(const FoundObjects& found, const SegmentSet& segments, const Session& s,
                    const AppContext& context) {
  if (found.unclaimed.empty()) return;
  const Annotations::Mark& first = segments.clicks[found.unclaimed.front()];
  const SceneInfo& info = s.scene.info;
  print_note(context,
             fmt::format("{} of {} clicks are of no object, the first one on '{}' in frame '{}': there is too "
                         "little surface around them; raise objects.points and objects.rays",
                         found.unclaimed.size(), segments.clicks.size(), info.classes.valid(first.class_index).name,
                         info.frames[static_cast<std::size_t>(first.frame)].name));
}

// Why segments became no object, and what to do about it.
std::string why_none(const FoundObjects& found, const SegmentSet& segments) {
  std::ptrdiff_t rays = 0, met = 0;
  for (const PoolView& view : found.surface.views) {
    rays += std::ssize(view.map.distance_m);
    met += std::count_if(view.map.distance_m.begin(), view.map.distance_m.end(), [](float d) { return d > 0; });
  }
  const std::ptrdiff_t stuff = std::count_if(found.class_of.begin(), found.class_of.end(), [&](std::int16_t c) {
    return c != kVoid && found.stuff[static_cast<std::size_t>(c)];
  });
  std::string why =
      "the surfaces of different views do not meet; train longer, or lower objects.neighbours and objects.least_points";
  if (2 * met < rays)
    why = fmt::format("only {} of 100 rays meet a surface, the others meet fog; train longer, or with depth",
                      100 * met / rays);
  else if (10 * stuff > 9 * std::ssize(found.class_of))
    why = "nearly all of the surface is of classes without objects; check objects.stuff and the classes of segments";
  return fmt::format("none of {} segments became an object: {} show on the surface, and {}", segments.count(),
                     found.shown, why);
}

int run(const ObjectsOptions& options, AppContext& context) {
  OpenedRun opened = run_of(options.run, options.set, OpenFor::objects, context);
  Session& s = opened.session;
  check_truth(options, s);
  if (s.config.grouping.entry == nullptr) s.config.grouping = usual_method(context.registry);
  SegmentSet segments = segments_of(options, s.scene, context);
  damage_segments(segments, s.config.segment_damage, s.config.objects.seed);
  const std::string folder = options.out.empty() ? (fs::path(options.run) / "objects").string() : options.out;
  // From here on, so that nobody edits objects that are about to be others.
  FolderLock alone;
  if (fs::is_directory(folder)) alone = hold_objects(folder, 0);
  ProgressLine progress(context, "objects");
  std::string stage;
  const auto show = [&](const char* part, double done, double of) {
    if (stage != part) {
      stage = part;
      progress.restart(stage, stage == "learned" ? "steps" : "frames");
    }
    progress.show(done, of);
  };
  FoundObjects found = find_objects(s, segments, s.config.grouping.entry->grouping(*s.config.grouping.params),
                                    context.registry.kernels(), show);
  tell_unclaimed(found, segments, s, context);
  if (found.rows.empty()) print_note(context, why_none(found, segments));
  check_object_count(found.rows);
  if (!alone.held()) {
    create_folders(folder);
    alone = hold_objects(folder, 0);
  }
  EditedObjects objects;
  objects.set = object_set(found, about(options, opened, segments, found).dump());
  const ObjectSet as_found = objects.set;
  const std::string edits_file = (fs::path(folder) / "edits.json").string();
  objects.edits = read_object_edits(edits_file);
  apply_edits(objects.set, objects.edits, edits_file);
  objects.edits.digest = as_found.digest();
  found.id = objects.set.id;
  found.rows = objects.set.rows;
  ObjectFiles files(folder, found, s.scene.info);
  const std::optional<ObjectFigures> figures = write_views(options, s, found, files, context);
  Json facts = Json::parse(objects.set.about);
  facts["edits"] = objects.edits.edits.size();
  const std::map<std::string, Count> counts = counts_of(options, s, found);
  if (figures) facts["score"] = figures_json(*figures, counts);
  files.finish();
  objects.set.about = facts.dump();
  write_object_set((fs::path(folder) / "found.safetensors").string(), as_found);
  write_object_tables(folder, objects, s.scene.info);
  const auto count =
      std::count_if(found.rows.begin(), found.rows.end(), [](const ObjectRow& row) { return row.points > 0; });
  std::string text;
  for (const auto& [name, count_of] : counts)
    text += fmt::format("  {:<20} {}{}\n", name, count_of.found,
                        figures ? fmt::format(" of {}", count_of.truth) : std::string());
  if (figures)
    text += fmt::format(
        "score: pq={:.4f} sq={:.4f} rq={:.4f} mcov={:.4f} count_error={:.4f} true={} found={} miscounted={:.4f}\n",
        figures->pq, figures->sq, figures->rq, figures->mcov, figures->count_error, figures->objects, figures->found,
        facts["score"]["miscounted"].get<double>());
  text += fmt::format("objects: objects={} segments={} seconds={:.1f} folder={}", count, segments.count(),
                      facts["seconds"]["all"].get<double>(), folder);
  facts["objects"] = count;
  facts["folder"] = folder;
  print_results(context, facts, text);
  print_next(context, next_of_look(options.run));
  return 0;
}

}  // namespace

Verb verb_objects() {
  return make_verb<ObjectsOptions>("objects", 65, "separate and count the things of a scene, by segments of its images",
                                   {"runs/my_photos", "runs/my_photos --segments masks --score"}, run);
}

}  // namespace semfield::app
