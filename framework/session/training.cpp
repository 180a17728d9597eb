#include "session/training.h"

#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <cmath>

#include "core/error.h"
#include "plugin/loader.h"
#include "scene/camera_rig.h"
#include "session/assembly.h"
#include "session/settings/run_identity.h"
#include "system/checksum.h"

namespace semfield {

namespace {

constexpr const char* kSetLabels = "set_labels";

Session opened(RunConfig config, Registry& registry, const SessionOptions& options, TrainingListener* listener) {
  Diagnostics diagnostics;
  Session session = open_session(std::move(config), registry, options, diagnostics);
  if (listener != nullptr) tell_findings(*listener, diagnostics, session);
  return session;
}

Error no_logit(const std::string& place, const std::string& name) {
  return Error(ErrorKind::data, "labels.class.no_logit",
               fmt::format("{}: no label had class '{}' when the session opened, so the network has no logit for it",
                           place, name),
               "open it with runtime.keep: [semantics, absent_classes]");
}

double steady_s() { return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count(); }

void copy_tensors(const ParamStore<float>& from, ParamStore<float>& to) {
  for (const Tensor<float>& t : from.all()) {
    const Tensor<float>* there = to.find(t.name);
    if (there != nullptr && is_stored(t.spec.role)) std::copy_n(t.value.data(), t.value.size(), there->value.data());
  }
}

}  // namespace

double TrainingListener::step_clock_s() { return steady_s(); }

void tell_findings(TrainingListener& listener, const Diagnostics& diagnostics, const Session& session) {
  for (const Diagnostic& finding : folded(diagnostics)) {
    if (finding.severity == Severity::note) {
      listener.note(finding.shown());
    } else {
      listener.warning(finding.shown());
    }
  }
  for (const std::string& line : session.choices()) listener.note(line);
}

Training::Training(RunConfig config, Registry& registry, const SessionOptions& options, TrainingListener* listener)
    : Training(opened(std::move(config), registry, options, listener), listener) {}

Training::Training(Session session, TrainingListener* listener, std::optional<SceneInputs> inputs)
    : session_(std::move(session)),
      work_(session_.work()),
      listener_(listener),
      rays_([this] {
        const WorkScope scope(work_);
        return session_.make_ray_source();
      }()),
      trainer_(*session_.pipeline, *rays_, session_.config.adam, session_.config.schedule, session_.config.train.steps),
      was_set_(session_.scene.frames.size(), false),
      modules_(module_checksums(session_.config.plugins)),
      inputs_(std::move(inputs)) {
  if (session_.config.labels.clicks) clicks_ = session_.config.labels.clicks->known();
  start_pace();
}

std::int64_t Training::last_step() const { return semfield::last_step(session_.config); }

double Training::clock_s() const { return listener_ != nullptr ? listener_->step_clock_s() : steady_s(); }

void Training::start_pace() {
  pace_.reset();
  if (last_step() == 0 && end_s(session_.config) > 0) pace_.emplace(train_s_, end_s(session_.config));
}

void Training::train_more(const AskedLength& asked) {
  ask_more(session_.config, asked, step(), train_s_);
  trainer_.set_length(session_.config.schedule, session_.config.train.steps);
  start_pace();
}

void Training::settle_length() {
  if (!pace_) return;
  const std::optional<std::int64_t> end = pace_->made(step(), train_s_, last_step());
  if (!end) return;
  const bool anew = last_step() > 0;
  RunConfig& config = session_.config;
  settle(config, step(), *end);
  trainer_.set_length(config.schedule, config.train.steps);
  settled_ = true;
  if (listener_ == nullptr) return;
  const double rate = pace_->steps_per_s();
  if (!anew)  // what a later correction says nobody can act on
    listener_->note(
        fmt::format("the length is settled: {} steps for {:.4g} s of training{}; the learning rate falls from step {} "
                    "on, to {:.4g} "
                    "of the first; run.yaml has the numbers, also where the rate of steps changes them",
                    *end, end_s(config), rate > 0 ? fmt::format(" ({:.3g} steps per second)", rate) : "", step(),
                    config.schedule.factor));
  Diagnostics never;
  check_length(config, never);
  for (const Diagnostic& finding : never.all()) listener_->warning(finding.message);
}

const SceneInputs& Training::inputs() {
  const WorkScope scope(work_);
  if (!inputs_) inputs_ = scene_inputs(session_.scene, session_.labels);
  return *inputs_;
}

std::span<const StepLosses> Training::advance(std::int64_t most) {
  const WorkScope scope(work_);
  const double start_s = clock_s();
  const std::span<const StepLosses> made = trainer_.advance_many(most);
  train_s_ += clock_s() - start_s;
  losses_ = made.back();
  settle_length();
  if (listener_ == nullptr) return made;
  for (const std::string& note : session_.pipeline->executor().take_notes()) listener_->note(note);
  listener_->stepped(step(), losses_);
  return made;
}

std::int64_t Training::train(std::int64_t steps) {
  std::int64_t made = 0;
  while (made < steps && !cancelled_) made += std::ssize(advance(steps - made));
  cancelled_ = false;
  return made;
}

void Training::set_gradient_hook(GradientHook<float> hook) {
  session_.pipeline->executor().set_gradient_hook(std::move(hook));
}

RenderedFrame Training::render(const Camera& camera, const Pose& world_from_camera, const FrameOptions& options) const {
  const WorkScope scope(work_);
  FrameOptions counted = options;
  counted.classes = session_.classes();
  return render_frame(*session_.pipeline, {camera, world_from_camera, camera.has_distortion()}, session_.limits,
                      session_.plan.class_of_logit, {}, counted);
}

SplitScore Training::evaluate(std::vector<int> frames) const {
  const WorkScope scope(work_);
  return semfield::evaluate(*session_.pipeline, session_.eval_job(std::move(frames)), session_.limits,
                            session_.plan.class_of_logit);
}

void Training::require_drawn(int frame) const {
  const std::vector<int> drawn = session_.drawn_frames();
  if (std::find(drawn.begin(), drawn.end(), frame) != drawn.end()) return;
  throw Error(ErrorKind::data, "labels.frame.untrained",
              fmt::format("frame {}: it is not a training frame, so none of its labels train", frame),
              "name one of Session::drawn_frames");
}

void Training::set_labels(int frame, std::vector<std::int16_t> labels) {
  require_drawn(frame);
  const auto f = static_cast<std::size_t>(frame);
  const FrameInfo& info = session_.scene.info.frames[f];
  const auto refuse = [&](Code code, const std::string& what, const std::string& remedy) {
    throw Error(ErrorKind::data, code, fmt::format("labels of frame '{}': {}", info.name, what), remedy);
  };
  const std::int32_t width = info.camera.width_px, height = info.camera.height_px;
  if (std::ssize(labels) != std::int64_t{width} * height) {
    refuse("labels.given.size", fmt::format("{} values for {} x {} pixels", labels.size(), width, height),
           "give a class index, or -1 for none, for every pixel, row by row");
  }
  const std::vector<std::int16_t> logit_of_class = session_.logit_of_class();
  std::vector<std::int64_t> counts(static_cast<std::size_t>(session_.classes()) + 1);
  for (std::size_t p = 0; p < labels.size(); ++p) {
    const std::int16_t label = labels[p];
    if (label == kVoid) {
      ++counts.back();
      continue;
    }
    const auto place = [&] {
      return fmt::format("pixel x {}, y {}", p % static_cast<std::size_t>(width), p / static_cast<std::size_t>(width));
    };
    if (label < 0 || label >= session_.classes()) {
      refuse("labels.class.range",
             fmt::format("{}: {} is not a class; there are {}", place(), label, session_.classes()),
             "give class indices, which begin at 0, or -1 for none");
    }
    if (!session_.plan.semantics || logit_of_class[static_cast<std::size_t>(label)] == kVoid) {
      throw no_logit(fmt::format("labels of frame '{}': {}", info.name, place()),
                     session_.scene.info.classes.valid(label).name);
    }
    ++counts[static_cast<std::size_t>(label)];
  }
  const WorkScope scope(work_);
  (void)inputs();  // of the labels that there were
  TrainingLabels::Frame& own = session_.labels.frames[f];
  TrainingLabels::Frame fresh;
  fresh.hard = LabelMap(std::move(labels));
  std::swap(own, fresh);
  try {
    rays_->relabel();
  } catch (const Error&) {
    std::swap(own, fresh);
    rays_->relabel();
    throw;
  }
  session_.labels.class_pixels[f] = std::move(counts);
  was_set_[f] = true;
}

void Training::set_clicks(const Annotations& clicks, std::span<const int> frames) {
  const ClassTable& classes = session_.scene.info.classes;
  if (session_.labels.unclicked.empty() || clicks.classes().valid_count() != classes.valid_count()) {
    throw Error(ErrorKind::data, "labels.clicks.foreign",
                "clicks: they are not those of this session, which was opened for other ones",
                "open it with scene.labels.clicks or .class_room, and apply events to a copy of config.labels.clicks");
  }
  for (const int frame : frames) require_drawn(frame);
  const WorkScope scope(work_);
  TrainingLabels& labels = session_.labels;
  struct Before {
    TrainingLabels::Frame frame;
    std::vector<std::int64_t> counts;
  };
  std::vector<Before> before;
  const auto swap_back = [&] {
    for (std::size_t i = 0; i < before.size(); ++i) {
      const auto f = static_cast<std::size_t>(frames[i]);
      std::swap(labels.frames[f], before[i].frame);
      std::swap(labels.class_pixels[f], before[i].counts);
    }
  };
  try {
    const std::vector<std::int16_t> logit_of_class = session_.logit_of_class();
    for (const int frame : frames) {
      const auto f = static_cast<std::size_t>(frame);
      before.push_back({std::move(labels.frames[f]), std::move(labels.class_pixels[f])});
      paint_clicks(clicks, frame, labels);
      const std::vector<std::int64_t>& counts = labels.class_pixels[f];
      for (std::size_t c = 0; c + 1 < counts.size(); ++c) {
        if (counts[c] > 0 && logit_of_class[c] == kVoid)
          throw no_logit(fmt::format("clicks in frame '{}'", session_.scene.info.frames[f].name),
                         classes.valid(static_cast<int>(c)).name);
      }
    }
    rays_->relabel();
  } catch (...) {
    swap_back();
    rays_->relabel();
    throw;
  }
  for (const int frame : frames)
    was_set_[static_cast<std::size_t>(frame)] = session_.config.labels.selection.clicks.empty();
  session_.scene.info.classes = clicks.classes();
  clicks_ = clicks.known();
}

// "" where none were set.
std::string Training::set_labels_name() const {
  std::uint32_t crc = 0;
  int frames = 0;
  for (std::size_t f = 0; f < was_set_.size(); ++f) {
    if (!was_set_[f]) continue;
    ++frames;
    const std::vector<std::int16_t> labels = session_.labels.frames[f].hard.expand();
    crc = crc32c(std::as_bytes(std::span(session_.scene.info.frames[f].name)), crc);
    crc = crc32c(std::as_bytes(std::span(labels)), crc);
  }
  return frames == 0 ? "" : fmt::format("{} frames, {:08x}", frames, crc);
}

CheckpointFacts Training::facts() {
  CheckpointFacts facts;
  facts.step = step();
  facts.train_s = train_s_;
  facts.seed = session_.config.runtime.seed;
  facts.config = write_config(resolved_config(session_.config));
  facts.classes = session_.scene.info.classes.empty() ? "" : session_.scene.info.classes.to_yaml();
  facts.scene = {session_.manifest, session_.scene.pixel_footprint_m};
  facts.inputs = inputs();
  facts.clicks = clicks_;
  facts.modules = modules_;
  return facts;
}

std::vector<TensorRef> Training::state() {
  const WorkScope scope(work_);
  trainer_.collect();
  trainer_.check_storable();
  return trainer_.state();
}

void Training::save(const std::string& path) {
  TensorMetadata metadata = checkpoint_metadata(facts(), identity_hash(session_.config));
  if (const std::string name = set_labels_name(); !name.empty()) metadata[kSetLabels] = name;
  write_safetensors(path, state(), metadata);
}

void Training::load(const std::string& path) {
  const WorkScope scope(work_);
  const TensorFile file = TensorFile::read(path);
  const CheckpointFacts facts = read_checkpoint_facts(file);
  require_class_table(facts.classes, session_.scene.info.classes, session_.config.labels.clicks);
  const auto named = file.metadata().find(kSetLabels);
  if (named != file.metadata().end() && named->second != set_labels_name()) {
    throw Error(ErrorKind::data, "checkpoint.labels.unset",
                fmt::format("'{}': it was trained on labels that were set while it trained, and these "
                            "are not set here",
                            path),
                "call set_labels with the same labels before load");
  }
  const std::vector<std::vector<float>> axes = axes_of(session_);
  trainer_.load(file, facts.step);
  follow_axes(session_, axes);
  train_s_ = facts.train_s;
  start_pace();
}

void use_learned_poses(Session& s, const TensorFile& checkpoint, Diagnostics& diagnostics) {
  const std::string name = std::string(CameraCorrections<float>::kPoseName) + "/learned";
  const TensorRef* learned = checkpoint.find(name);
  const std::vector<int> frames = s.scene.frames_of(Split::train);
  const std::int64_t rows = std::ssize(frames);
  if (learned == nullptr) return;
  if (learned->shape != std::vector<std::int64_t>{rows, kPoseNumbers}) {
    diagnostics.warning(
        "run.poses.other", "train.cameras",
        fmt::format("the poses that the run has learned are not those of the {} training frames of this scene: those "
                    "given are used",
                    frames.size()),
        "open the run with the scene that it was trained on");
    return;
  }
  const std::vector<float> numbers = checkpoint.floats(name, rows * kPoseNumbers);
  std::vector<float> used(numbers.size());
  cpu_camera_kernels<float>().centre({numbers.data(), rows, kPoseNumbers}, 1, {used.data(), rows, kPoseNumbers}, false);
  const double distance_m = s.pipeline->options().cameras.distance_m;
  double turned_deg = 0, moved_m = 0;
  for (std::size_t i = 0; i < frames.size(); ++i) {
    Pose& pose = s.scene.info.frames[static_cast<std::size_t>(frames[i])].world_from_camera;
    const Pose given = pose;
    pose = corrected(given, &used[kPoseNumbers * i], distance_m);
    turned_deg += angle_deg(given, pose);
    moved_m += length(pose.t - given.t);
  }
  const double each = 1.0 / static_cast<double>(std::max<std::int64_t>(rows, 1));
  diagnostics.note(
      "run.poses.learned", "train.cameras",
      fmt::format("training frames have the poses that the run has learned, {:.2f} degrees and {:.3g} m from "
                  "those given in the mean",
                  turned_deg * each, moved_m * each));
}

std::vector<Pose> refine_poses(Session& s, Registry& registry, const std::vector<int>& frames,
                               const PoseRefinement& how) {
  NetworkParts<float> parts = make_parts<float>(s.config, registry, s.plan, s.extent);
  CameraRules& cameras = parts.options.cameras;
  cameras.count = std::ssize(frames);
  cameras.poses = cameras.alone = true;
  cameras.colors = false;
  cameras.pose_rate = 1;
  parts.options.losses = LossList();
  const std::unique_ptr<Pipeline<float>> pipeline = assemble(std::move(parts), {}, true);
  s.pipeline->executor().download(0);
  copy_tensors(s.pipeline->store(), pipeline->store());
  run_on({s.pipeline->executor().device(), true, nullptr, nullptr}, s.config, registry, s.plan, s.extent, *pipeline);
  pipeline->executor().upload(0);

  std::vector<TrainFrame> drawn;
  for (const int frame : frames) {
    const auto f = static_cast<std::size_t>(frame);
    if (s.scene.frames[f].is_unusable()) continue;
    const FrameInfo& info = s.scene.info.frames[f];
    drawn.push_back(
        {{info.camera, info.world_from_camera, s.plan.undistortion}, &s.scene.frames[f], nullptr, info.name});
  }
  RaySourceOptions options;
  options.train = s.config.train;
  options.train.rays = how.rays;
  options.train.ray_source = RaySourceKind::all_images;
  options.targets = {std::string(channel::camera)};
  options.seed = s.config.runtime.seed;
  options.tile_rays = pipeline->executor().tile_rays(how.rays);
  const RaySource rays(std::move(drawn), s.plan.semantics ? s.logit_of_class() : std::vector<std::int16_t>{}, s.limits,
                       options);
  const AdamParams adam{.learning_rate = how.learning_rate, .beta2 = 0.99, .epsilon = 1e-15};
  const ScheduleParams schedule{.kind = ScheduleKind::exponential, .factor = 0.1, .decay_steps = how.steps, .legs = {}};
  Trainer trainer(*pipeline, rays, adam, schedule, how.steps);
  while (trainer.step() < how.steps) trainer.advance_many(how.steps - trainer.step());
  trainer.collect();

  const Tensor<float>* learned = pipeline->store().find(std::string(CameraCorrections<float>::kPoseName) + "/learned");
  std::vector<Pose> poses;
  for (std::size_t i = 0; i < frames.size(); ++i)
    poses.push_back(corrected(s.scene.info.frames[static_cast<std::size_t>(frames[i])].world_from_camera,
                              learned->value.data() + kPoseNumbers * i, pipeline->options().cameras.distance_m));
  return poses;
}

}  // namespace semfield
