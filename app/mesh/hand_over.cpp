#include "app/mesh/hand_over.h"

#include <fmt/format.h>

#include <algorithm>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "app/objects/object_tables.h"
#include "app/terminal.h"
#include "compute/parallel.h"
#include "core/small_math.h"
#include "core/text.h"
#include "eval/image_output.h"
#include "handover/point_files.h"
#include "handover/splats.h"
#include "handover/voxel_map.h"
#include "surface/mesh/mesh_files.h"
#include "surface/mesh/surface.h"
#include "system/files.h"

namespace semfield::app {

namespace {

namespace fs = std::filesystem;

constexpr long long kSplatResolution = 384;         // finer than a mesh: a splat has one colour
constexpr std::int64_t kFittedPixels = 64'000'000;  // of all views that colours of splats are fitted to
constexpr long long kMapResolution = 128;           // of scenes that are no rooms in metres
constexpr double kMapEdge = 0.05;                   // metres; what robots plan with

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

}  // namespace

HandOver::HandOver(const MeshOptions& options, const MeshTargets& targets, OpenedRun& run, std::optional<Vec3d> up,
                   const AppContext& context)
    : options_(options),
      targets_(targets),
      run_(run),
      context_(context),
      objects_(objects_of_run(run.run_dir, run.session.scene.info.classes.valid_count())) {
  const std::int64_t step = objects_ ? nlohmann::json::parse(objects_->about).value("step", run.step) : run.step;
  if (step != run.step)
    print_note(context, fmt::format("the objects of {} are of step {}, the field is of step {}; `semfield objects {}` "
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

std::vector<std::int32_t> HandOver::instances(std::span<const Vec3d> points) const {
  if (!objects_) return {};
  std::vector<std::int32_t> ids(points.size());
  parallel_for(std::ssize(points), [&](std::int64_t i) {
    ids[static_cast<std::size_t>(i)] = objects_->at(points[static_cast<std::size_t>(i)]);
  });
  return ids;
}

std::map<std::int32_t, std::string> HandOver::objects() const {
  std::map<std::int32_t, std::string> names;
  if (!objects_) return names;
  for (const ObjectRow& row : objects_->rows)
    if (row.points > 0) names[row.id] = object_name(row, classes());
  return names;
}

void HandOver::look() {
  Session& s = run_.session;
  if (!wants_points() && !targets_.splats() && !targets_.maps()) return;
  const Box& bounds = s.extent.bounds;
  const std::array<double, 3> background = s.pipeline->options().rules.background();
  PointCloud cloud(spacing_of(options_, bounds, kMeshResolution), background);
  std::optional<SplatVolume> splats;
  const auto around = [&](double edge) {  // a wall on the bounds lies in the cube behind them
    const Vec3d margin{edge, edge, edge};
    return VoxelGridPlace::covering({bounds.lo - margin, bounds.hi + margin}, edge);
  };
  if (targets_.splats())
    splats.emplace(*s.pipeline, around(spacing_of(options_, bounds, kSplatResolution)), bounds,
                   s.limits.clip && s.config.rendering.far == FarMode::background);
  if (targets_.maps()) {
    const bool usual = !options_.voxel && !options_.resolution && is_in_metres(s.scene.info.metric, bounds.size());
    const double edge = usual ? kMapEdge : spacing_of(options_, bounds, kMapResolution);
    map_.emplace(around(edge));
  }
  const std::vector<int> frames = s.scene.frames_of(Split::train);
  std::vector<SplatView> shown;  // every so many views, which bounds their memory
  std::int64_t pixels_of_all = 0;
  for (const int f : frames) {
    const Camera& camera = s.scene.info.frames[static_cast<std::size_t>(f)].camera;
    pixels_of_all += std::int64_t{camera.width_px} * camera.height_px;
  }
  const auto every = static_cast<std::size_t>(1 + pixels_of_all / kFittedPixels);
  ProgressLine progress(context_, "points of", "views");
  for (std::size_t i = 0; i < frames.size(); ++i) {
    const FrameInfo& info = s.scene.info.frames[static_cast<std::size_t>(frames[i])];
    const RayCamera camera{info.camera, info.world_from_camera, s.plan.undistortion};
    const auto part_done = [&](double share) {
      progress.show(static_cast<double>(i) + share, static_cast<double>(frames.size()));
    };
    const RenderedFrame frame =
        render_named_frame(*s.pipeline, info.name, camera, s.limits, s.plan.class_of_logit, {}, {1, part_done});
    if (splats) splats->add(camera, frame, s.limits);
    if (splats && i % every == 0) shown.push_back({camera, to_bytes(frame.rgb)});
    if (!wants_points() && !map_) continue;
    const SeenPixels pixels = seen_pixels(camera, frame);
    if (wants_points()) cloud.add(frame, pixels);
    if (map_) map_->add(camera, frame, pixels);
  }
  points_ = cloud.points();
  if (splats) {
    splats_ = splats->splats();
    fit_colors(splats_, shown, background);
  }
  for (PointSet* set : {&points_, &splats_.points}) set->attributes.instance = instances(set->positions);
}

void HandOver::write_points() {
  const Vec3d offset = offset_of_floats(box_around(points_.positions));
  if (targets_.writes("las")) {
    const std::string path = targets_.file("las");
    write_las(path, points_, classes());
    add(path, "points");  // readers add the header's offset by themselves
  }
  if (targets_.writes("pcd")) {
    const std::string path = targets_.file("pcd");
    write_pcd(path, points_, classes(), offset);
    add(path, "points", offset);
  }
}

void HandOver::write_splats() {
  const Vec3d offset = offset_of_floats(box_around(splats_.points.positions));
  if (targets_.writes("splats.ply")) {
    const std::string path = targets_.file("splats.ply");
    write_splat_ply(path, splats_, classes(), offset);
    add(path, "splats", offset);
  }
  if (targets_.writes("splat")) {
    const std::string path = targets_.file("splat");
    write_splat(path, splats_, offset);
    add(path, "splats", offset);
  }
}

void HandOver::write_maps() {
  const auto add_map = [&](const std::string& path, const char* holds, Vec3d offset) {
    add(path, holds, offset);
    sidecar_.files.back().edge = map_->place().edge;
  };
  if (targets_.writes("npz")) {
    write_voxels(targets_.file("npz"), *map_, classes());
    add_map(targets_.file("npz"), "voxels", {});
  }
  for (const char* format : {"bt", "ot"}) {
    if (!targets_.writes(format)) continue;
    const std::string path = targets_.file(format);
    add_map(path, "voxels", write_octomap(path, *map_, classes(), format == std::string("ot")));
  }
  if (!targets_.writes("pgm")) return;
  const Costmap map = costmap_of(*map_, sidecar_.up.value_or(Vec3d{}), band_of(options_, metre_));
  const std::string yaml = write_costmap(targets_.file("pgm"), map);
  print_note(context_,
             fmt::format("the floor is at {:.3g} along {}; {} has what lies {:.3g} to {:.3g} above it", map.floor,
                         axis_text(*sidecar_.up), targets_.file("pgm"), map.band.low, map.band.high));
  add_map(targets_.file("pgm"), "costmap", {});
  add_map(yaml, "costmap", {});
}

void HandOver::write() {
  if (options_.color == "class") {
    for (PointSet* set : {&points_, &splats_.points}) set->attributes.color = class_colors(set->attributes, classes());
  }
  if (targets_.points()) write_points();
  if (targets_.splats()) write_splats();
  if (map_) write_maps();
}

void HandOver::add(const std::string& path, const std::string& holds, Vec3d offset) {
  sidecar_.files.push_back({path, holds, offset});
}

void HandOver::finish() {
  const bool page_alone = std::all_of(sidecar_.files.begin(), sidecar_.files.end(),
                                      [](const HandedFile& file) { return file.holds == "page"; });
  if (!page_alone) write_file_atomic(targets_.stem.string() + ".json", sidecar_json(sidecar_));
}

std::vector<std::string> HandOver::files() const {
  std::vector<std::string> out;
  for (const HandedFile& file : sidecar_.files) out.push_back(file.path);
  return out;
}

namespace {

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

}  // namespace

double spacing_of(const MeshOptions& options, const Box& bounds, long long cells) {
  const Vec3d size = bounds.size();
  return options.voxel.value_or(std::max({size.x, size.y, size.z}) /
                                static_cast<double>(options.resolution.value_or(cells)));
}

FoundSurface find_surface(const MeshOptions& options, OpenedRun& run, const AppContext& context) {
  const Session& s = run.session;
  const bool of_sensor = surface_source(options, s) == "sensor";
  MeasuredDepth measured;
  if (options.score || of_sensor) measured = measured_depth(run.session, options.run, of_sensor);
  ProgressLine progress(context, "depth of", "views");
  FoundSurface found{make_run_surface(s, options.run, options, measured.training,
                                      {[&](const std::string& note) { print_note(context, note); },
                                       [&](double done, double of) { progress.show(done, of); }}),
                     {}};
  if (options.score) found.scores = scores_of(options, found, s, measured);
  return found;
}

}  // namespace semfield::app
