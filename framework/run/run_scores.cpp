#include "run/run_scores.h"

#include <fmt/format.h>

#include <filesystem>
#include <functional>
#include <set>

#include "core/text.h"
#include "eval/final_eval.h"
#include "labels/clicks/click_file.h"
#include "plugin/loader.h"
#include "run/run.h"
#include "session/checkpoint_facts.h"
#include "session/settings/choices.h"
#include "session/trainer.h"
#include "system/files.h"

namespace semfield {

namespace {

CheckpointStore::Found newest_checkpoint(const RunFolder& folder, Diagnostics& diagnostics) {
  std::optional<CheckpointStore::Found> found =
      CheckpointStore::read(folder.checkpoints_path()).find_latest(diagnostics);
  if (found) return *std::move(found);
  throw Error(ErrorKind::no_input, "checkpoint.none.yet", folder.path() + ": the run has no checkpoint yet",
              "train it from step 0 with `semfield train --resume " + shell_word(folder.path()) + "`");
}

struct Side {
  TensorFile file;
  CheckpointFacts facts;
  std::optional<ConfigNode> settings;  // of the checkpoint, with defaults of now; none: this program cannot read them
  ConfigNode text() const { return parse_config_text(facts.config, file.name()); }
};

std::vector<ConfigDifference> changes_of_identity(const ConfigNode& a, const ConfigNode& b) {
  std::vector<ConfigDifference> changes = config_differences(a, b);
  std::erase_if(changes, [](const ConfigDifference& change) { return !is_part_of_identity(change.key); });
  return changes;
}

// Those of the checkpoint are what trained. `config diff` compares run.yaml, so a difference from it is reported.
std::optional<ConfigNode> settings_of(const RunFolder& folder, const Side& side, Registry& registry,
                                      Diagnostics& diagnostics) {
  std::optional<RunConfig> written, trained;
  try {
    written = load_run_config(folder.config_path(), {}, registry);
    trained = settings_of_checkpoint(side.facts, registry);
  } catch (const Error&) {  // a plugin that is not loaded, for one: then their texts are compared
  }
  if (!written || !trained) return std::nullopt;
  ConfigNode settings = resolved_config(*trained);
  std::string edited;
  for (const ConfigDifference& change : changes_of_identity(settings, resolved_config(*written)))
    edited += (edited.empty() ? "" : ", ") + change.text();
  if (!edited.empty()) {
    diagnostics.warning("run.config.edited", folder.config_path(),
                        "it differs from what the run was trained with: " + edited,
                        "restore it; the settings in the checkpoints are compared");
  }
  return settings;
}

Side read_side(const std::string& run_dir, Registry& registry, Diagnostics& diagnostics) {
  const RunFolder folder = RunFolder::read(run_dir);
  CheckpointStore::Found found = newest_checkpoint(folder, diagnostics);
  Side side;
  side.facts = read_checkpoint_facts(found.file, found.step);
  side.file = std::move(found.file);
  side.settings = settings_of(folder, side, registry, diagnostics);
  return side;
}

// Of one tensor that both have.
std::string difference_of(const TensorRef& a, const TensorRef& b) {
  if (a.type != b.type || a.shape != b.shape) return fmt::format("tensor '{}' has another shape", a.name);
  const auto [left, right] = std::mismatch(a.bytes.begin(), a.bytes.end(), b.bytes.begin());
  if (left == a.bytes.end()) return {};
  const auto element = static_cast<std::size_t>(left - a.bytes.begin()) / tensor_type_bytes(a.type);
  return fmt::format("tensor '{}' differs from element {} on", a.name, element);
}

std::string difference_of_tensors(const TensorFile& a, const TensorFile& b) {
  for (const TensorRef& tensor : a.tensors()) {
    const TensorRef* other = b.find(tensor.name);
    if (other == nullptr) return fmt::format("tensor '{}' is in the first alone", tensor.name);
    if (const std::string found = difference_of(tensor, *other); !found.empty()) return found;
  }
  for (const TensorRef& tensor : b.tensors()) {
    if (a.find(tensor.name) == nullptr) return fmt::format("tensor '{}' is in the second alone", tensor.name);
  }
  return {};
}

std::string first_difference(const Side& a, const Side& b) {
  const bool read = a.settings && b.settings;
  const std::vector<ConfigDifference> changes =
      changes_of_identity(read ? *a.settings : a.text(), read ? *b.settings : b.text());
  if (!changes.empty()) return changes.front().text();
  if (a.facts.classes != b.facts.classes) return "the class tables differ";
  const std::vector<std::string> others = other_inputs(a.facts.inputs, b.facts.inputs);
  if (!others.empty()) return "the scenes differ: " + join(others);
  if (a.facts.step != b.facts.step) return fmt::format("step: {} -> {}", a.facts.step, b.facts.step);
  return difference_of_tensors(a.file, b.file);
}

// What training has shown of the scene already is not said again by each verb.
void add_untold(const Diagnostics& found, const std::string& told_path, Diagnostics& diagnostics) {
  std::set<std::string, std::less<>> told;
  const std::string text = std::filesystem::exists(told_path) ? read_text_file(told_path) : std::string();
  std::string_view rest = text, line;
  while (next_line(rest, line)) told.emplace(line);
  for (const Diagnostic& finding : found.all()) {
    if (!told.contains(finding.text())) diagnostics.add(finding);
  }
}

}  // namespace

// Two runs' newest checkpoints against each other.

RunComparison compare_runs(const std::string& folder_a, const std::string& folder_b, Registry& registry,
                           Diagnostics& diagnostics) {
  const Side a = read_side(folder_a, registry, diagnostics), b = read_side(folder_b, registry, diagnostics);
  return {first_difference(a, b), a.facts.step, a.file.tensors().size()};
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
  options.depth = purpose == OpenFor::evaluation                                 ? DepthKept::test
                  : purpose == OpenFor::rendering || purpose == OpenFor::objects ? DepthKept::none
                                                                                 : DepthKept::all;
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

}  // namespace semfield
