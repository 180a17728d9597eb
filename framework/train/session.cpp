#include "train/session.h"

#include <fmt/format.h>
#include <sched.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <numeric>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "config/settings/choices.h"
#include "core/error.h"
#include "core/process.h"
#include "core/text.h"
#include "execution/ranks_executor.h"
#include "formats/image_io.h"
#include "scene/loading/frame_source.h"
#include "train/trainer.h"

namespace semfield {

namespace {

// Rays through the corners of all training frames: those of the pixels between lie within their cone.
double direction_spread_deg(const SceneInfo& info) {
  std::vector<Vec3d> rays;
  Vec3d sum;
  for (const FrameInfo& frame : info.frames) {
    if (frame.split != Split::train) continue;
    for (const int corner : {0, 1, 2, 3}) {
      const Camera& c = frame.camera;
      const Vec3d local = c.direction(corner & 1 ? c.width_px : 0, corner & 2 ? c.height_px : 0);
      if (c.is_wide() || !(local.z > 0)) return 360;  // all around, or a corner without a ray
      rays.push_back(frame.world_from_camera.rotate(local));
      sum = sum + rays.back();
    }
  }
  if (rays.empty() || !(dot(sum, sum) > 0)) return 360;
  const Vec3d mean = normalized(sum);
  double widest = 0;
  for (const Vec3d& ray : rays) {
    const Vec3d off = cross(mean, ray);
    widest = std::max(widest, std::atan2(std::sqrt(dot(off, off)), dot(mean, ray)));
  }
  return 2 * widest * 180 / M_PI;
}

SceneManifest manifest_of(const LoadedScene& scene, const TrainingLabels& labels) {
  SceneManifest manifest;
  manifest.classes = scene.info.classes.valid_count();
  manifest.train_class_pixels.resize(static_cast<std::size_t>(manifest.classes));
  for (std::size_t f = 0; f < scene.frames.size(); ++f) {
    const FrameInfo& info = scene.info.frames[f];
    manifest.any_depth = manifest.any_depth || info.has_depth;
    manifest.any_distortion = manifest.any_distortion || info.camera.has_distortion();
    if (info.split != Split::train) continue;
    ++manifest.train_frames;
    manifest.train_pixels += std::int64_t{scene.frames[f].width_px} * scene.frames[f].height_px;
    if (labels.frames[f].empty()) continue;
    ++manifest.labelled_frames;
    for (std::size_t c = 0; c < manifest.train_class_pixels.size(); ++c)
      manifest.train_class_pixels[c] += labels.class_pixels[f][c];
  }
  manifest.direction_spread_deg = direction_spread_deg(scene.info);
  return manifest;
}

bool keeps(const RunConfig& config, std::string_view component) {
  return std::find(config.runtime.keep.begin(), config.runtime.keep.end(), component) != config.runtime.keep.end();
}

std::int64_t training_depth_px(const LoadedScene& scene) {
  std::int64_t pixels = 0;
  for (const FrameInfo& frame : scene.info.frames) {
    if (frame.split == Split::train && frame.has_depth)
      pixels += std::int64_t{frame.camera.width_px} * frame.camera.height_px;
  }
  return pixels;
}

BuiltParts built_parts(const Session& s, const Ranks* ranks) {
  BuiltParts built;
  built.sizes = s.chosen;
  built.learned = s.pipeline->store().learned_count();
  for (const Tensor<float>& t : s.pipeline->store().all())
    built.in_tables += t.spec.role == TensorRole::sparse ? t.size() : 0;
  built.mpi = has_mpi();
  if (ranks != nullptr) built.processes = ranks->size();
  built.image_library = images_available();
  built.images_loaded = image_formats_loaded();
  return built;
}

// Before pixels are read: throws Error(unavailable) when `frames` of them, `bytes` in all, do not fit.
void require_frame_memory(double memory_gb, std::size_t bytes, std::size_t frames) {
  const std::size_t held = resident_bytes();
  std::size_t room = available_memory();
  if (memory_gb > 0) {
    const auto limit = static_cast<std::size_t>(memory_gb * (1 << 30));
    room = std::min(room, limit > held ? limit - held : 0);
  }
  if (bytes <= room) return;
  throw Error(ErrorKind::unavailable, "memory.frames.size",
              fmt::format("the pixels of {} frames would take {} of memory, {} are available, and the program "
                          "holds {} already",
                          frames, memory_text(bytes), memory_text(room), memory_text(held)),
              "raise scene.load.downscale, take fewer frames, or raise runtime.memory_gb where it sets the limit");
}

// All that tells the loader which scene it makes.
std::string load_settings(const RunConfig& config, const SceneLoadOptions& load) {
  const ConfigNode all = resolved_config(config);
  std::string text = config.base_dir;
  for (const char* section : {"scene", "limits"})
    if (const ConfigNode* node = all.find(section)) text += "\n" + write_config_inline(*node);
  return text + fmt::format("\n{} {} {} {} {} {} {}", static_cast<int>(load.depth), load.with_instances,
                            load.contracted, load.exposure, load.pixels, load.check_geometry, join(load.channels));
}

// Loads the scene, or copies the kept one where that is the same; it is kept where memory has room for both.
LoadedScene load_or_copy(Dataset& dataset, SceneLoadOptions load, const RunConfig& config, KeptScene* kept,
                         Diagnostics& diagnostics) {
  std::size_t scene_bytes = 0;
  load.before_pixels = [&](std::size_t bytes, std::size_t frames) {
    require_frame_memory(config.runtime.memory_gb, bytes, frames);
    scene_bytes = bytes;
  };
  if (kept == nullptr) return load_scene(dataset, load, diagnostics);
  const std::string settings = load_settings(config, load);
  if (kept->settings != settings) {
    *kept = {};
    kept->scene = load_scene(dataset, load, kept->found);
    if (!kept->found.has_errors() && scene_bytes < available_memory() / 2) kept->settings = settings;
  }
  for (const Diagnostic& one : kept->found.all()) diagnostics.add(one);
  if (kept->settings.empty()) return std::move(kept->scene);
  return kept->scene;
}

// What the plan leaves out stands in the configuration no more, so that a resume trains the same heads by the same
// terms.
void drop_idle(Session& s) {
  std::erase_if(s.config.losses, [&](const LossEntry& entry) {
    return std::find(s.plan.no_losses.begin(), s.plan.no_losses.end(), entry.type) != s.plan.no_losses.end();
  });
  std::erase_if(s.config.heads, [&](const HeadConfig& head) {
    return std::find(s.plan.no_heads.begin(), s.plan.no_heads.end(), head.channel) != s.plan.no_heads.end();
  });
}

// What is left open in the configuration and the labels decide. Of a run that was trained it is settled.
void choose_by_labels(Session& s, bool labels_made, bool trainable, Diagnostics& diagnostics) {
  const std::vector<std::int64_t>& pixels = s.manifest.train_class_pixels;
  const LabelCount count{std::accumulate(pixels.begin(), pixels.end(), std::int64_t{0}), s.manifest.train_pixels,
                         s.plan.semantics};
  if (trainable) warn_of_rare_labels(s.config.train, count, diagnostics);
  const std::string rays = choose_ray_source(s.config.train, count);
  std::vector<std::string> branches;
  if (labels_made) branches = choose_branches(s.config, label_statistics(s.scene, s.labels));
  if (s.plan.semantics) s.chosen_by_labels = std::move(branches);  // else none of them is built
  if (!rays.empty()) s.chosen_by_labels.push_back(rays);
}

SceneExtent extent_of(const Session& s) {
  return {s.scene.bounds, s.scene.near_m, s.scene.far_m, s.scene.pixel_footprint_m,
          s.config.rendering.outside == Outside::contracted};
}

// Scene, labels, manifest and plan. `last` is the sampler that the plan has asked, made for the scene's extent of now.
Session load_session(RunConfig config, Registry& registry, const SessionOptions& options, const ChosenDevice& chosen,
                     std::unique_ptr<Sampler<float>>& last, Diagnostics& diagnostics) {
  Session s;
  s.config = std::move(config);
  const DatasetBuild dataset_build{s.config.base_dir};
  std::unique_ptr<Dataset> dataset = s.config.dataset.entry->dataset(*s.config.dataset.params, dataset_build);
  SceneLoadOptions load = s.config.load;
  const bool make_labels = !options.known || options.labels;
  load.pixels = options.pixels || !options.known;
  load.check_geometry = load.check_geometry && !options.known;  // a run that was trained is evaluated as it is
  if (options.trainable) load.channels = targets_of(s.config.losses);
  load.exposure = s.config.cameras.colors == CameraTrust::automatic;
  load.with_instances = options.instances || (make_labels && s.config.labels.needs_instances());
  const bool of_losses = options.trainable && losses_read(s.config.losses, channel::depth);
  const bool needs_depth =
      of_losses || options.depth == DepthKept::all || (make_labels && s.config.labels.wants_depth());
  load.depth = needs_depth || keeps(s.config, kTrainingDepth) ? DepthKept::all : options.depth;
  s.scene = load_or_copy(*dataset, std::move(load), s.config, options.kept, diagnostics);
  open_label_files(s.scene, s.config.labels, diagnostics);
  if (options.trained_classes)
    require_class_table(*options.trained_classes, s.scene.info.classes, s.config.labels.clicks);
  diagnostics.throw_if_errors(ErrorKind::data, "the scene has problems:");
  if (options.pixels || !options.known) read_test_labels(s.scene, s.config.labels, diagnostics);
  if (make_labels) s.labels = make_training_labels(s.scene, s.config.labels, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::data, "the labels have problems:");
  s.manifest = options.known ? options.known->manifest : manifest_of(s.scene, s.labels);
  if (options.known) s.scene.pixel_footprint_m = options.known->pixel_footprint_m;
  last = make_last_sampler(s.config, registry, extent_of(s));
  const std::optional<bool> fits = s.scene.cameras.corners > 0 ? std::optional(!s.scene.cameras.off) : std::nullopt;
  const CameraReasons why = choose_cameras(s.config.cameras, {s.scene.info.tracked, s.scene.exposure, fits});
  BuildRequest request = build_request(s.config, registry, last->traits());
  request.poses_why = why.poses;
  request.colors_why = why.colors;
  request.no_cuda = chosen.no_cuda;
  request.training_depth_px = needs_depth ? 0 : training_depth_px(s.scene);
  if (of_losses) {
    const TrainingDepth depth = training_depth(s.scene);
    (void)depth_use(s.config.losses, depth, diagnostics);  // for its warning
    request.depth_frames = depth.frames;
    request.depth_px = depth.pixels;
  }
  for (const int f : s.scene.frames_of(Split::train))
    for (const FrameChannelInfo& one : s.scene.info.frames[static_cast<std::size_t>(f)].channels)
      request.channels.insert(one.name);
  request.trained = options.known.has_value();
  s.plan = plan_build(s.manifest, request, s.config.runtime.keep);
  drop_idle(s);
  settle_heads(s.config, s.scene.info);
  choose_by_labels(s, make_labels, options.trainable, diagnostics);
  s.chosen_by_labels.insert(s.chosen_by_labels.end(), why.learned.begin(), why.learned.end());
  return s;
}

// Derived values become part of the resolved configuration, so that a later session cannot derive others.
void fix_extent(Session& s, DeviceId device) {
  s.extent = extent_of(s);
  s.config.load.near_m = s.limits.near_m = s.scene.near_m;
  s.config.load.far_m = s.limits.far_m = s.scene.far_m;
  const Box& b = s.limits.bounds = s.scene.bounds;
  s.config.load.bounds = {b.lo.x, b.lo.y, b.lo.z, b.hi.x, b.hi.y, b.hi.z};
  if (s.config.rendering.unit_m == 0) s.config.rendering.unit_m = s.scene.unit_m;
  s.chosen = choose_from_scene(s.config, s.extent, device.kind);
}

// [C logits]; none: classes count alike.
std::vector<float> class_weights(const Session& s) {
  if (!s.plan.semantics || !s.config.semantics.balance_classes) return {};
  std::vector<std::int64_t> pixels;
  for (const int c : s.plan.class_of_logit)
    pixels.push_back(s.manifest.train_class_pixels[static_cast<std::size_t>(c)]);
  return inverse_log_frequency_weights(pixels);
}

// What rank 0 tells of where a session's network runs, behind its configuration and its manifest.
struct Place {
  DeviceId device;
  bool trainable = true;
};

void broadcast(Ranks& ranks, Place& place) { ranks.broadcast(std::as_writable_bytes(std::span(&place, 1))); }

void broadcast(Ranks& ranks, std::string& text) {
  std::size_t size = text.size();
  ranks.broadcast(std::as_writable_bytes(std::span(&size, 1)));
  text.resize(size);
  ranks.broadcast(std::as_writable_bytes(std::span(text)));
}

int cuda_devices() {
  int count = 0;
  while (cuda_available(nullptr, count)) ++count;
  return count;
}

// Ranks of a host take its devices in turn, from the one that was asked for on.
DeviceId device_of(const Ranks& ranks, DeviceId asked) {
  if (asked.kind == Device::cpu) return asked;
  const int count = cuda_devices();
  if (count == 0) {
    std::string why_not;
    (void)cuda_available(&why_not, asked.ordinal);
    throw Error(ErrorKind::unavailable, "device.gpu.unavailable",
                ranks.name_of(ranks.rank()) + ": runtime.device: cuda: " + why_not, "set runtime.device: cpu");
  }
  return {asked.kind, (asked.ordinal + ranks.local_rank()) % count};
}

// Rank 0, once `session` has its plan and its pipeline on the CPU: the other ranks assemble the same network, and from
// now on it runs on the device of all ranks that `how` names. Device `cuda` is a device for each rank of a host, in
// turn. Throws what a rank could not do, with its name; the others then wait for another session.
void lead(Ranks& ranks, Session& session, Registry& registry, RunOn how) {
  std::string config = write_config(resolved_config(session.config));
  std::string manifest = manifest_text({session.manifest, session.scene.pixel_footprint_m});
  Place place{how.device, how.trainable};
  broadcast(ranks, config);
  broadcast(ranks, manifest);
  broadcast(ranks, place);
  agree(ranks, [&] { how.device = device_of(ranks, how.device); });
  how.ranks = &ranks;
  run_on(how, session.config, registry, session.plan, session.extent, *session.pipeline);
}

// The network is built once, `last` in it; what else depends on its parts is asked of them.
void build_session(Session& s, Registry& registry, const SessionOptions& options, RunOn how,
                   std::unique_ptr<Sampler<float>> last) {
  if (options.trainable) release_freed_memory();  // of reading, before the network is allocated
  NetworkParts<float> parts = make_parts<float>(s.config, registry, s.plan, s.extent, std::move(last));
  s.limits.clip = !s.extent.contracted && parts.needs_bounds();

  s.config.runtime.lanes = parts.options.lanes;  // derived, as the extent is
  s.pipeline = assemble(std::move(parts), class_weights(s), options.trainable);
  const bool has_axes = options.trainable && settle_axes(s);
  add_built_rows(built_parts(s, options.ranks), s.plan);
  if (options.ranks != nullptr) {
    lead(*options.ranks, s, registry, how);
    if (has_axes) s.pipeline->executor().upload(0);  // the other processes have no frames to find them in
  } else {
    run_on(how, s.config, registry, s.plan, s.extent, *s.pipeline);
  }
}

constexpr std::int64_t kShortestRun = 4;  // in probes
constexpr double kMostPoints = 1 << 16;   // rays that look for depth
constexpr float kLeastOpacity = 0.5F;

// The rendered depth of one training frame, where its rays meet something.
SurveyPoints look(const Session& s, const FrameInfo& info, double downscale) {
  const auto smaller = [&](std::int32_t size) { return std::max(1, static_cast<std::int32_t>(size / downscale)); };
  const RayCamera camera{info.camera.resized(smaller(info.camera.width_px), smaller(info.camera.height_px)),
                         info.world_from_camera, s.plan.undistortion};
  const RenderedFrame seen = render_frame(*s.pipeline, camera, s.limits, s.plan.class_of_logit);
  FrameBuffer depth;
  depth.width_px = seen.width_px;
  depth.height_px = seen.height_px;
  for (std::size_t i = 0; i < seen.depth_m.size(); ++i)
    depth.depth_m.push_back(seen.opacity[i] > kLeastOpacity ? seen.depth_m[i] / seen.opacity[i] : 0);
  return survey_frame(camera.camera, camera.world_from_camera, depth, 1);
}

// The scene's extent is a guess, a probe is asked for and the run is at least four times as long.
bool probe_is_due(const Session& s) {
  const std::int64_t steps = s.config.load.probe_steps;
  const std::int64_t end = last_step(s.config);  // 0: a time is given, and the probe is no part of it
  return s.scene.extent_is_guessed && steps > 0 && (end == 0 || end >= kShortestRun * steps);
}

// Trains `s` for scene.load.probe_steps steps and surveys the depth that it then renders from the training cameras;
// nothing where it shows no surface.
std::optional<SurveyedExtent> probe_extent(Session& s) {
  Trainer trainer(s);
  const std::int64_t steps = s.config.load.probe_steps;
  while (trainer.step() < steps) {
    trainer.advance(steps - trainer.step());
    tell_load_progress("looking for the bounds", static_cast<std::size_t>(trainer.step()),
                       static_cast<std::size_t>(steps));
  }
  tell_load_progress("read", 1, 1);
  trainer.collect();
  const double downscale = std::sqrt(std::max(1.0, static_cast<double>(trainer.rays().pixel_count()) / kMostPoints));
  std::vector<SurveyPoints> parts;
  for (const int f : s.scene.frames_of(Split::train))
    parts.push_back(look(s, s.scene.info.frames[static_cast<std::size_t>(f)], downscale));
  return extent_of_points(std::move(parts));
}

// The extent of scene and configuration becomes what was seen, inside what was guessed; a note says so.
void use_probed_extent(const SurveyedExtent& seen, LoadedScene& scene, SceneLoadOptions& load,
                       Diagnostics& diagnostics) {
  const Vec3d before = scene.bounds.size();
  const double far_before = scene.far_m;
  Box box;
  for (int a = 0; a < 3; ++a) {
    box.lo[a] = std::max(scene.bounds.lo[a], seen.bounds.lo[a]);
    box.hi[a] = std::min(scene.bounds.hi[a], seen.bounds.hi[a]);
  }
  load.bounds = {box.lo.x, box.lo.y, box.lo.z, box.hi.x, box.hi.y, box.hi.z};
  if (load.far_m <= 0) load.far_m = std::min(scene.far_m, seen.far_m);
  if (load.near_m <= 0) load.near_m = std::min(seen.near_m, 0.5 * load.far_m);
  Diagnostics repeated;
  derive_extent(scene, {}, load, repeated);
  scene.bounds_from = scene.near_far_from = fmt::format("a probe of {} steps", load.probe_steps);
  const Vec3d size = box.size();
  diagnostics.note(
      "scene.bounds.probed", "scene.load.bounds",
      fmt::format("{:.3g} x {:.3g} x {:.3g} and far {:.3g}: where a probe of {} steps shows surfaces; the "
                  "cameras alone gave {:.3g} x {:.3g} x {:.3g} and far {:.3g}, which probe_steps: 0 keeps",
                  size.x, size.y, size.z, load.far_m, load.probe_steps, before.x, before.y, before.z, far_before));
}

// The scene is lent to a session of its own, whose sizes the guess chooses; only what it sees comes back.
// The network of the probe is another one: its tables and grids are sized by the bounds that it is to find.
void probe_bounds(Session& s, Registry& registry, const SessionOptions& options, DeviceId device,
                  std::unique_ptr<Sampler<float>> last, Diagnostics& diagnostics) {
  Diagnostics ignored;
  Session probe;
  probe.config = read_run_config(resolved_config(s.config).without("plugins"), registry, ignored);
  // Heads shape no density, and their axes are found in the frames as they are.
  probe.config.heads.clear();
  std::erase_if(probe.config.losses, [](const LossEntry& entry) { return reads_heads(entry.loss->traits()); });
  probe.scene = std::move(s.scene);
  probe.labels = std::move(s.labels);
  probe.manifest = s.manifest;
  probe.plan = s.plan;
  probe.config.train.time_s = 0;  // its steps are counted
  fix_extent(probe, device);
  SessionOptions alone = options;
  alone.ranks = nullptr;
  build_session(probe, registry, alone, {device, options.trainable}, std::move(last));
  const std::optional<SurveyedExtent> seen = probe_extent(probe);
  s.scene = std::move(probe.scene);
  s.labels = std::move(probe.labels);
  if (seen) use_probed_extent(*seen, s.scene, s.config.load, diagnostics);
}

// The network of rank 0's session, without its scene.
void serve_session(Ranks& ranks, Registry& registry, const std::string& config) {
  std::string manifest;
  Place place;
  broadcast(ranks, manifest);
  broadcast(ranks, place);
  Session s;
  try {
    agree(ranks, [&] {
      s.config = run_config_of(parse_config_text(config, "the configuration of rank 0"), registry);
      const KnownScene known = read_manifest_text(manifest);
      s.manifest = known.manifest;
      place.device = device_of(ranks, place.device);
      if (place.device.kind != Device::cpu) add_cuda_kernels(registry);
      s.extent = extent_of(s.config, known.pixel_footprint_m);
      std::unique_ptr<Sampler<float>> last = make_last_sampler(s.config, registry, s.extent);
      BuildRequest request = build_request(s.config, registry, last->traits());
      request.no_cuda.clear();
      s.plan = plan_build(s.manifest, request, s.config.runtime.keep);
      s.pipeline = assemble(make_parts<float>(s.config, registry, s.plan, s.extent, std::move(last)), class_weights(s),
                            place.trainable);
    });
    run_on({place.device, place.trainable, &ranks}, s.config, registry, s.plan, s.extent, *s.pipeline);
  } catch (const RankLost&) {
    throw;
  } catch (const Error&) {  // rank 0 throws it too
    return;
  }
  const WorkSettings work = s.work();
  const WorkScope scope(work);
  static_cast<RanksExecutor&>(s.pipeline->executor()).serve();
}

}  // namespace

void keep_components(RunConfig& config, const std::vector<std::string>& components) {
  for (const std::string& component : components) {
    if (!keeps(config, component)) config.runtime.keep.push_back(component);
  }
}

Session open_session(RunConfig config, Registry& registry, const SessionOptions& options, Diagnostics& diagnostics) {
  keep_components(config, options.keep);
  if (config.labels.selection.class_room > 0) keep_components(config, {"semantics", "absent_classes"});
  const InputLimits limits = config.limits;
  WorkSettings work = work_settings();
  work.limits = &limits;
  work.threads = config.runtime.threads;
  if (options.progress) work.load_progress = &options.progress;
  const WorkScope scope(work);
  const ChosenDevice chosen = chosen_device(config, registry, diagnostics);
  const DeviceId device = chosen.device;
  if (config.runtime.precision == Precision::automatic) {
    config.runtime.precision = precision_of(config, registry, device);  // what run.yaml says from here on
    diagnostics.note("train.precision.chosen", "runtime.precision",
                     config.runtime.precision == Precision::bf16 ? "auto is bf16 here, which is faster on this machine"
                                                                 : "auto is fp32 here: no faster kernels of bf16");
  }
  std::vector<std::string> by_device = choose_for_device(config, device.kind);
  if (options.trainable) {
    if (const std::string length = resolve_length(config, device.kind); !length.empty() && options.build)
      diagnostics.note("train.steps.chosen", "train.steps", length);
    Diagnostics never;
    check_length(config, never);
    never.throw_if_errors(ErrorKind::config, "");
  }
  std::unique_ptr<Sampler<float>> last;  // a probe takes it along, for its extent is another one
  Session s = load_session(std::move(config), registry, options, chosen, last, diagnostics);
  s.chosen_by_device = std::move(by_device);
  if (options.probe && probe_is_due(s)) probe_bounds(s, registry, options, device, std::move(last), diagnostics);
  fix_extent(s, device);
  if (options.trainable) say_slow_paths(s.config, registry, device, bf16_is_native(), diagnostics);
  if (options.trainable && !s.plan.semantics && !s.config.self_training.at.empty()) {
    diagnostics.warning("labels.training.none", "train.self_training",
                        "there are no labels to begin with, so no round gives any",
                        "give the scene labels, or set train.self_training.at to []");
  }
  Diagnostics* const slow_fields = options.trainable ? &diagnostics : nullptr;
  if (options.build)
    build_session(s, registry, options, {device, options.trainable, nullptr, slow_fields}, std::move(last));
  return s;
}

WorkSettings Session::work() const {
  WorkSettings work = pipeline ? pipeline->options().work : WorkSettings();
  work.threads = config.runtime.threads;
  work.limits = &config.limits;
  return work;
}

std::vector<std::string> Session::choices() const {
  std::vector<std::string> lines = chosen_by_device;
  lines.insert(lines.end(), chosen.begin(), chosen.end());
  lines.insert(lines.end(), chosen_by_labels.begin(), chosen_by_labels.end());
  return lines;
}

EvalJob Session::eval_job(std::vector<int> frames) const {
  EvalJob job;
  job.infos = &scene.info.frames;
  job.buffers = &scene.frames;
  job.frames = std::move(frames);
  job.classes = classes();
  job.undistort = plan.undistortion;
  job.fit_colors = config.cameras.colors == CameraTrust::learned;
  return job;
}

SplitScore Session::evaluate(const EvalJob& job) const {
  return semfield::evaluate(*pipeline, job, limits, plan.class_of_logit);
}

std::vector<std::int16_t> Session::logit_of_class() const {
  std::vector<std::int16_t> logit(static_cast<std::size_t>(classes()), kVoid);
  for (std::size_t l = 0; l < plan.class_of_logit.size(); ++l) {
    logit[static_cast<std::size_t>(plan.class_of_logit[l])] = static_cast<std::int16_t>(l);
  }
  return logit;
}

std::vector<int> Session::drawn_frames() const {
  std::vector<int> drawn = scene.frames_of(Split::train);
  std::erase_if(drawn, [&](int f) { return scene.frames[static_cast<std::size_t>(f)].is_unusable(); });
  return drawn;
}

std::unique_ptr<RaySource> Session::make_ray_source() const {
  std::vector<TrainFrame> frames;
  for (const int index : drawn_frames()) {
    const auto f = static_cast<std::size_t>(index);
    const FrameInfo& info = scene.info.frames[f];
    frames.push_back(
        {{info.camera, info.world_from_camera, plan.undistortion}, &scene.frames[f], &labels.frames[f], info.name});
  }
  RaySourceOptions options;
  options.train = config.train;
  options.targets = targets_of(config.losses);
  if (pipeline->cameras() != nullptr) options.targets.emplace_back(channel::camera);
  const std::vector<std::int64_t>& pixels = manifest.train_class_pixels;
  const bool none = std::all_of(pixels.begin(), pixels.end(), [](std::int64_t count) { return count == 0; });
  options.labels_may_come = config.labels.selection.class_room > 0 || (plan.semantics && none);
  options.seed = config.runtime.seed;
  options.tile_rays = pipeline->executor().tile_rays(config.train.rays);
  return std::make_unique<RaySource>(std::move(frames), plan.semantics ? logit_of_class() : std::vector<std::int16_t>{},
                                     limits, options);
}

ConfusionMatrix score_training_labels(const Session& s, const std::vector<int>& frames) {
  ConfusionMatrix score(s.classes());
  std::vector<ConfusionMatrix> parts(frames.size(), score);
  parallel_for(std::ssize(frames), [&](std::int64_t k) {
    const auto f = static_cast<std::size_t>(frames[static_cast<std::size_t>(k)]);
    const TrainingLabels::Frame& labels = s.labels.frames[f];
    if (labels.empty() || s.scene.frames[f].label.empty()) return;
    std::vector<std::int16_t> given(labels.size());
    for (std::size_t i = 0; i < given.size(); ++i) given[i] = labels[i];
    parts[static_cast<std::size_t>(k)].add(s.scene.frames[f].label.expand(), given);
  });
  for (const ConfusionMatrix& part : parts) score.merge(part);
  return score;
}

std::string describe_session(const Session& s) {
  const WorkSettings work = s.work();
  const WorkScope scope(work);
  std::string out;
  const auto add = [&](const std::string& line) { out += line + "\n"; };
  const std::vector<int> train = s.scene.frames_of(Split::train), test = s.scene.frames_of(Split::test);
  const FrameInfo& first = s.scene.info.frames.at(static_cast<std::size_t>(train.empty() ? 0 : train.front()));
  const Vec3d size = s.extent.bounds.size();
  add(fmt::format(
      "scene     {}: {} training and {} test frames of {} x {} pixels, {} classes, labels on {} training frames",
      s.scene.info.name, train.size(), test.size(), first.camera.width_px, first.camera.height_px, s.classes(),
      s.manifest.labelled_frames));
  if (s.config.labels.from.reader) add("labels    from " + s.config.labels.from.type);
  for (const TrainingLabels::Step& step : s.labels.steps) {
    std::vector<std::string> facts;
    for (const auto& [name, value] : step.facts) facts.push_back(name + " " + value);
    add("labels    " + step.type + ": " + join(facts));
  }
  add(fmt::format("bounds    {:.3g} x {:.3g} x {:.3g} {} (from {}), near {:.3g}, far {:.3g} (from {})", size.x, size.y,
                  size.z, s.scene.info.metric ? "m" : "units of the poses", s.scene.bounds_from, s.extent.near_m,
                  s.extent.far_m, s.scene.near_far_from));
  if (s.pipeline) {
    for (const Pass<float>& pass : s.pipeline->passes()) {
      std::string slots;
      for (const PassConfig& p : s.config.passes) {
        if (p.name != pass.parts().name) continue;
        slots = p.sampler.entry->name + ", " + p.position.entry->name + " (" +
                std::to_string(pass.parts().position->traits().out_dims) + ")";
        if (pass.parts().direction) slots += ", direction " + p.direction.entry->name;
        slots += ", " + p.field.entry->name;
        if (pass.parts().branch) {
          slots += ", semantics by " + p.branch()->position.entry->name + " (" +
                   std::to_string(pass.parts().branch->position->traits().out_dims) + ") and " +
                   p.branch()->field.entry->name;
        }
      }
      add(fmt::format("pass      {}: {}{}", pass.parts().name, slots,
                      pass.parts().head ? fmt::format(", {} classes", pass.parts().head->width()) : ", no semantics"));
    }
    for (const HeadConfig& head : s.config.heads) {
      add(fmt::format("head      {}: {} columns{}, by {}, {} and {}", head.channel, head.width,
                      head.source_width > 0 ? fmt::format(" (principal axes of {})", head.source_width) : "",
                      head.head.entry->name, head.position.entry->name, head.field.entry->name));
    }
    add(fmt::format("learned   {} parameters; {} of {} rays, tiles of {}, {} lanes, {} threads",
                    s.pipeline->store().learned_count(),
                    (last_step(s.config) > 0 ? "" : "as many steps as fit into ") + length_text(s.config),
                    s.config.train.rays, s.pipeline->tile_rays(), s.config.runtime.lanes, thread_count()));
  }
  for (const std::string& line : s.choices()) add("chosen    " + line);
  for (const LeftOut& row : s.plan.left_out)
    if (row.component == "cuda") add("device    cpu: " + row.evidence);
  for (const std::string& name : s.plan.kept) add("kept      " + name + " (--keep)");
  return out;
}

void follow(Ranks& ranks, Registry& registry) {
  for (std::string config;;) {
    broadcast(ranks, config);
    if (config.empty()) return;
    serve_session(ranks, registry, config);
  }
}

void dismiss(Ranks& ranks) {
  std::string none;
  broadcast(ranks, none);
}

std::string prepare_ranks(Ranks& ranks, const std::string& version) {
  const std::vector<std::string> versions = texts_of(ranks, version);
  const std::vector<std::string> sets = texts_of(ranks, std::string(isa_name(isa())));
  for (int r = 1; r < ranks.size(); ++r) {
    const auto i = static_cast<std::size_t>(r);
    if (versions[i] != versions[0])
      throw Error(ErrorKind::unavailable, "ranks.version.differs",
                  ranks.name_of(r) + " runs " + versions[i] + ", and " + ranks.name_of(0) + " " + versions[0],
                  "install the same version on all hosts");
    if (sets[i] != sets[0])
      throw Error(
          ErrorKind::unavailable, "ranks.isa.differs",
          ranks.name_of(r) + " computes with " + sets[i] + " instructions, and " + ranks.name_of(0) + " with " +
              sets[0] + ": their results would differ in the last bits",
          "set the environment variable SEMFIELD_ISA to the weaker of both for all ranks (mpirun -x SEMFIELD_ISA=" +
              std::min(sets[i], sets[0]) + ")");
  }
  cpu_set_t own;
  CPU_ZERO(&own);
  (void)sched_getaffinity(0, sizeof own, &own);
  const std::vector<cpu_set_t> all = all_of(ranks, own);
  const auto host = [&](int r) { return ranks.name_of(r).substr(ranks.name_of(r).rfind(' ')); };
  int together = 0;
  for (int r = 0; r < ranks.size(); ++r) {
    if (host(r) == host(ranks.rank()) && CPU_EQUAL(&all[static_cast<std::size_t>(r)], &own)) ++together;
  }
  const int threads = std::max(1, hardware_threads() / std::max(1, together));
  set_thread_count(threads);
  const auto cores = static_cast<int>(sysconf(_SC_NPROCESSORS_ONLN));
  std::string text = std::to_string(ranks.size()) + " processes, " + std::to_string(ranks.local_size()) +
                     " of them on this host, each with " + std::to_string(threads) +
                     (threads == 1 ? " thread" : " threads") + " by default";
  // Launchers bind processes to cores, Open MPI to a single one where there are two processes.
  if (CPU_COUNT(&own) < cores && threads * ranks.local_size() < cores)
    text += ": the launcher lets it use " + std::to_string(CPU_COUNT(&own)) + " of " + std::to_string(cores) +
            " cores (mpirun --bind-to none: all)";
  return text;
}

}  // namespace semfield
