#include "train/opened_run.h"

#include <fmt/format.h>

#include <algorithm>
#include <set>

#include "config/config_words.h"
#include "config/settings/choices.h"
#include "core/files.h"
#include "core/process.h"
#include "core/text.h"
#include "eval/final_eval.h"
#include "labels/clicks.h"
#include "model/camera_corrections.h"
#include "plugin/loader.h"
#include "scene/camera_rig.h"
#include "train/assembly.h"
#include "train/run.h"
#include "train/trainer.h"

namespace semfield {

namespace {

// What the run settled after the checkpoint, and the legs that were requested, are no changes of a setting.
bool is_of_the_length(const std::string& key, bool was_open) {
  return key.starts_with("train.schedule.legs") ||
         (was_open && (key == "train.steps" || key == "train.time_s" || key == "train.schedule.hold_steps" ||
                       key == "train.schedule.decay_steps"));
}

using Changes = std::vector<ConfigDifference>;

// Settings that are others now than in training: those that would make it another run, and those that may change.
struct ChangedSettings {
  Changes refused, allowed;
};
ChangedSettings changes_since(const RunConfig& trained, const RunConfig& now) {
  ChangedSettings changed;
  for (ConfigDifference& change : config_differences(resolved_config(trained), resolved_config(now))) {
    if (is_of_the_length(change.key, last_step(trained) == 0)) continue;
    (may_change_on_resume(change.key) ? changed.allowed : changed.refused).push_back(std::move(change));
  }
  return changed;
}

std::string texts_of(const Changes& changes) {
  std::string text;
  for (const ConfigDifference& change : changes) text += (text.empty() ? "" : ", ") + change.text();
  return text;
}

// " --set KEY=VALUE" for a shell of each, by its value before or now; nothing for a value that is absent.
std::string words_for(const Changes& changes, std::string ConfigDifference::*value) {
  std::string words;
  for (const ConfigDifference& change : changes)
    if (change.*value != kAbsent) words += " --set " + shell_word(change.key + "=" + change.*value);
  return words;
}

// Keys that --set gives.
std::set<std::string> keys_set(const std::string& config_path, const std::vector<std::string>& overrides) {
  std::set<std::string> keys;
  for (const ConfigSetting& setting : config_settings(compose_config(config_path, overrides)))
    if (setting.from.starts_with("--")) keys.insert(setting.key);
  return keys;
}

// None when a program of another version wrote them and they cannot be read.
std::optional<RunConfig> settings_of_checkpoint(const CheckpointFacts& facts, Registry& registry) {
  try {
    Diagnostics diagnostics;
    // Modules are loaded already, by run.yaml or by the command line.
    RunConfig config =
        read_run_config(parse_config_text(facts.config, "checkpoint").without("plugins"), registry, diagnostics);
    if (!diagnostics.has_errors()) return config;
  } catch (const Error&) {
  }
  return std::nullopt;
}

// For a run that is looked at by `config`, its run.yaml with `overrides`: throws Error(config) naming each setting of
// the run's identity that run.yaml says otherwise than the checkpoint, and notes those that `overrides` say otherwise.
// False where they name other frames, sizes or bounds than those of training: then other inputs are no news.
bool compare_settings_with_training(const CheckpointFacts& facts, const RunConfig& config, const RunFolder& folder,
                                    const std::vector<std::string>& overrides, Registry& registry,
                                    Diagnostics& diagnostics) {
  const std::optional<RunConfig> trained = settings_of_checkpoint(facts, registry);
  if (!trained) return true;
  const std::set<std::string> on_purpose = keys_set(folder.config_path(), overrides);
  bool same_scene = true;
  Changes edited, asked;
  for (ConfigDifference& change : changes_since(*trained, config).refused) {
    same_scene = same_scene && !change.key.starts_with("scene.");
    // The type of a plugin brings the defaults of its other parameters.
    const std::string type = change.key.substr(0, change.key.rfind('.')) + ".type";
    (on_purpose.contains(change.key) || on_purpose.contains(type) ? asked : edited).push_back(std::move(change));
  }
  if (!edited.empty()) {
    throw Error(ErrorKind::config, "run.config.edited",
                fmt::format("'{}' is not as the run was trained: {}", folder.config_path(), texts_of(edited)),
                fmt::format("for the settings of training add{}, or restore the file; for the file's add{}",
                            words_for(edited, &ConfigDifference::left), words_for(edited, &ConfigDifference::right)));
  }
  if (!asked.empty())
    diagnostics.note("run.config.settings", "settings",
                     "they differ from those that the run was trained with: " + texts_of(asked));
  return same_scene;
}

// The scores that ended training, as metrics.jsonl has them: figures, and the part of the split that they are of.
void read_scores(const RunFolder& folder, TrainOutcome& outcome) {
  for (const MetricsRow& row : read_metrics(folder.metrics_path())) {
    if (row.kind != "eval" || row.step != outcome.step || !row.split.starts_with("test")) continue;
    outcome.values.clear();
    outcome.scored = {};
    for (const auto& [name, value] : row.values) {
      const auto number = static_cast<std::int64_t>(value.value_or(0));
      if (name == "frames") {
        outcome.scored.frames = number;
      } else if (name == "split_frames") {
        outcome.scored.of = number;
      } else if (name == "pixel_stride") {
        outcome.scored.stride = static_cast<std::int32_t>(number);
      } else if (name != "pixels") {
        outcome.values.emplace_back(name, value);
      }
    }
    if (outcome.scored.of == 0) outcome.scored.of = outcome.scored.frames;
  }
}

CheckpointStore::Found newest_checkpoint(const RunFolder& folder, Diagnostics& diagnostics) {
  std::optional<CheckpointStore::Found> found =
      CheckpointStore::read(folder.checkpoints_path()).find_latest(diagnostics);
  if (found) return *std::move(found);
  throw Error(ErrorKind::no_input, "checkpoint.none.yet", folder.path() + ": the run has no checkpoint yet",
              "train it from step 0 with `semfield train --resume " + shell_word(folder.path()) + "`");
}

// What training has shown of the scene already is not said again by each verb.
void add_untold(const Diagnostics& found, const std::string& told_path, Diagnostics& diagnostics) {
  std::set<std::string, std::less<>> told;
  const std::string text = fs::exists(told_path) ? read_text_file(told_path) : std::string();
  std::string_view rest = text, line;
  while (next_line(rest, line)) told.emplace(line);
  for (const Diagnostic& finding : found.all()) {
    if (!told.contains(finding.text())) diagnostics.add(finding);
  }
}

void copy_tensors(const ParamStore<float>& from, ParamStore<float>& to) {
  for (const Tensor<float>& t : from.all()) {
    const Tensor<float>* there = to.find(t.name);
    if (there != nullptr && is_stored(t.spec.role)) std::copy_n(t.value.data(), t.value.size(), there->value.data());
  }
}

}  // namespace

ResumePoint find_resume_point(const RunFolder& folder, const RunConfig& config, Registry& registry,
                              Diagnostics& diagnostics) {
  ResumePoint point;
  std::optional<RunConfig> before;
  if (const auto found = CheckpointStore::read(folder.checkpoints_path()).find_latest(diagnostics)) {
    point.facts = read_checkpoint_facts(found->file, found->step);
    point.path = found->path;
    before = settings_of_checkpoint(*point.facts, registry);
  }
  if (!before) before = load_run_config(folder.config_path(), {}, registry);
  if (point.facts && point.facts->seed != before->runtime.seed) {
    throw Error(
        ErrorKind::data, "checkpoint.seed.differs",
        fmt::format("'{}': its seed is {}, its settings say {}", point.path, point.facts->seed, before->runtime.seed),
        "resume from another checkpoint of the run: move this file out of the folder");
  }
  ChangedSettings changed = changes_since(*before, config);
  if (!changed.refused.empty())
    throw Error(
        ErrorKind::config, "run.config.other",
        fmt::format("{}: that would be another run than the one in '{}'", texts_of(changed.refused), folder.path()),
        fmt::format("to resume that one: semfield train --resume {}{}; to train again: semfield train {}{} "
                    "--out NEW_FOLDER",
                    shell_word(folder.path()), words_for(changed.refused, &ConfigDifference::left),
                    shell_word(folder.config_path()), words_for(changed.refused, &ConfigDifference::right)));
  point.changed = std::move(changed.allowed);
  return point;
}

std::optional<TrainOutcome> ended_run(const RunFolder& folder, const RunConfig& config, const ResumePoint& point) {
  if (!point.facts || !point.changed.empty()) return std::nullopt;
  if (last_step(config) == 0 || point.step() < last_step(config)) return std::nullopt;
  if (!fs::exists(folder.report_path())) return std::nullopt;
  // A scene without test frames has no last evaluation.
  if (fs::exists(folder.final_eval_path()) &&
      check_final_eval(read_text_file(folder.final_eval_path()), folder.final_eval_path()) != point.step())
    return std::nullopt;
  TrainOutcome outcome;
  outcome.step = point.step();
  outcome.train_s = point.facts->train_s;
  outcome.run_dir = folder.path();
  outcome.report_path = folder.report_path();
  outcome.peak_bytes = peak_resident_bytes();
  read_scores(folder, outcome);
  return outcome;
}

void compare_with_training(const CheckpointFacts& facts, const SceneInputs& inputs, const Session& session,
                           Diagnostics& diagnostics) {
  warn_of_other_inputs(facts.inputs, inputs, diagnostics);
  warn_of_other_modules(facts.modules, session.config.plugins, diagnostics);
  // Clicks are meant to come, and other labels are reported already where both checksums are known.
  const bool told = !facts.inputs.training_labels.value_or("").empty() && !inputs.training_labels.value_or("").empty();
  Diagnostics ignored;
  compare_training_labels(facts.scene, session.manifest, session.scene.info.classes, session.config.runtime.keep,
                          told || session.config.labels.clicks ? ignored : diagnostics);
}

OpenedRun open_run(const std::string& run_dir, const std::vector<std::string>& overrides, Registry& registry,
                   Diagnostics& diagnostics, OpenFor purpose, Ranks* ranks) {
  OpenedRun run;
  const RunFolder folder = RunFolder::read(run_dir);
  run.run_dir = folder.path();
  const CheckpointStore::Found found = newest_checkpoint(folder, diagnostics);
  const CheckpointFacts facts = read_checkpoint_facts(found.file, found.step);
  RunConfig config = load_run_config(folder.config_path(), overrides, registry);
  require_scene_places(config, run_dir);
  require_clicks({true, facts.clicks}, config.labels, run_dir, diagnostics);
  SessionOptions options;
  options.trained_classes = facts.classes;
  options.trainable = false;
  options.ranks = ranks;
  options.depth = purpose == OpenFor::evaluation                      ? DepthKept::test
                  : purpose == OpenFor::evaluation_of_training_frames ? DepthKept::all
                                                                      : DepthKept::none;
  options.known = facts.scene;
  options.pixels = purpose != OpenFor::rendering;
  options.instances = purpose == OpenFor::objects;
  options.labels = purpose == OpenFor::evaluation_of_training_frames;
  const bool same_scene = compare_settings_with_training(facts, config, folder, overrides, registry, diagnostics);
  Diagnostics of_scene;
  run.session = open_session(std::move(config), registry, options, of_scene);
  add_untold(of_scene, folder.findings_path(), diagnostics);
  if (same_scene) warn_of_other_inputs(facts.inputs, scene_inputs(run.session.scene, run.session.labels), diagnostics);
  warn_of_other_modules(facts.modules, run.session.config.plugins, diagnostics);
  load_pipeline(*run.session.pipeline, found.file);
  use_learned_poses(run.session, found.file, diagnostics);
  run.step = facts.step;
  run.train_s = facts.train_s;
  return run;
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
  Session fitted;  // the field as it is, and cameras that learn
  fitted.pipeline = assemble(std::move(parts), {}, true);
  const std::unique_ptr<Pipeline<float>>& pipeline = fitted.pipeline;
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
  fitted.config.adam = {.learning_rate = how.learning_rate, .beta2 = 0.99, .epsilon = 1e-15};
  fitted.config.schedule = {.kind = ScheduleKind::exponential, .factor = 0.1, .decay_steps = how.steps, .legs = {}};
  fitted.config.train.steps = how.steps;
  fitted.config.runtime.threads = s.config.runtime.threads;
  fitted.config.limits = s.config.limits;
  Trainer trainer(
      fitted, nullptr,
      std::make_unique<RaySource>(std::move(drawn), s.plan.semantics ? s.logit_of_class() : std::vector<std::int16_t>{},
                                  s.limits, options));
  trainer.train(how.steps);
  trainer.collect();

  const Tensor<float>* learned = pipeline->store().find(std::string(CameraCorrections<float>::kPoseName) + "/learned");
  std::vector<Pose> poses;
  for (std::size_t i = 0; i < frames.size(); ++i)
    poses.push_back(corrected(s.scene.info.frames[static_cast<std::size_t>(frames[i])].world_from_camera,
                              learned->value.data() + kPoseNumbers * i, pipeline->options().cameras.distance_m));
  return poses;
}

}  // namespace semfield
