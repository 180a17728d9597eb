// What a resumed run goes on from.
#include "run/run_resume.h"

#include <fmt/format.h>

#include <algorithm>
#include <set>

#include "config/compose.h"
#include "core/text.h"
#include "plugin/check/module_file.h"
#include "run/checkpoint_store.h"
#include "session/settings/run_identity.h"
#include "session/settings/run_length.h"

namespace semfield {

namespace {

// " --set KEY=VALUE" for a shell; nothing for a value that is absent.
std::string set_text(const std::string& key, const std::string& value) {
  return value == kAbsent ? std::string() : " --set " + shell_word(key + "=" + value);
}

void require_same_run(const std::vector<ConfigDifference>& identity, const RunFolder& folder) {
  if (identity.empty()) return;
  std::string changes, keep, anew;
  for (const ConfigDifference& change : identity) {
    changes += (changes.empty() ? "" : ", ") + change.text();
    keep += set_text(change.key, change.left);
    anew += set_text(change.key, change.right);
  }
  throw Error(ErrorKind::config, "run.config.other",
              fmt::format("{}: that would be another run than the one in '{}'", changes, folder.path()),
              fmt::format("to resume that one: semfield train --resume {}{}; to train again: semfield train {}{} "
                          "--out NEW_FOLDER",
                          shell_word(folder.path()), keep, shell_word(folder.config_path()), anew));
}

// What the run settled after the checkpoint, and the legs that were requested, are no changes of a setting.
bool is_of_the_length(const std::string& key, bool was_open) {
  return key.starts_with("train.schedule.legs") ||
         (was_open && (key == "train.steps" || key == "train.time_s" || key == "train.schedule.hold_steps" ||
                       key == "train.schedule.decay_steps"));
}

}  // namespace

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
  std::vector<ConfigDifference> refused;
  for (ConfigDifference& change : changed_settings(resolved_config(*before), resolved_config(config))) {
    if (is_of_the_length(change.key, last_step(*before) == 0)) continue;
    (may_change_on_resume(change.key) ? point.changed : refused).push_back(std::move(change));
  }
  require_same_run(refused, folder);
  return point;
}

void compare_with_training(const CheckpointFacts& facts, const SceneInputs& inputs, const Session& session,
                           Diagnostics& diagnostics) {
  if (facts.inputs) warn_of_other_inputs(*facts.inputs, inputs, diagnostics);
  warn_of_other_modules(facts.modules, session.config.plugins, diagnostics);
  if (!facts.scene) return;
  // Clicks are meant to come, and other labels are reported already where both checksums are known.
  const bool told = facts.inputs && !facts.inputs->training_labels.value_or("").empty() &&
                    !inputs.training_labels.value_or("").empty();
  Diagnostics ignored;
  compare_training_labels(*facts.scene, session.manifest, session.scene.info.classes, session.config.runtime.keep,
                          told || session.config.labels.clicks ? ignored : diagnostics);
}

namespace {

// Keys that --set gives.
std::set<std::string> keys_set(const std::string& config_path, const std::vector<std::string>& overrides) {
  std::set<std::string> keys;
  for (const ConfigSetting& setting : config_settings(compose_config(config_path, overrides)))
    if (setting.from.starts_with("--")) keys.insert(setting.key);
  return keys;
}

}  // namespace

bool compare_settings_with_training(const CheckpointFacts& facts, const RunConfig& config, const RunFolder& folder,
                                    const std::vector<std::string>& overrides, Registry& registry,
                                    Diagnostics& diagnostics) {
  const std::optional<RunConfig> trained = settings_of_checkpoint(facts, registry);
  if (!trained) return true;
  const std::set<std::string> on_purpose = keys_set(folder.config_path(), overrides);
  bool same_scene = true;
  std::vector<std::string> edited, asked;
  std::string back, keep;
  for (const ConfigDifference& change : changed_settings(resolved_config(*trained), resolved_config(config))) {
    if (may_change_on_resume(change.key) || is_of_the_length(change.key, last_step(*trained) == 0)) continue;
    same_scene = same_scene && !change.key.starts_with("scene.");
    if (on_purpose.contains(change.key)) {
      asked.push_back(change.text());
      continue;
    }
    edited.push_back(change.text());
    back += set_text(change.key, change.left);
    keep += set_text(change.key, change.right);
  }
  if (!edited.empty()) {
    throw Error(
        ErrorKind::config, "run.config.edited",
        fmt::format("'{}' is not as the run was trained: {}", folder.config_path(), join(edited)),
        fmt::format("for the settings of training add{}, or restore the file; for the file's add{}", back, keep));
  }
  if (!asked.empty())
    diagnostics.note("run.config.settings", "settings",
                     "they differ from those that the run was trained with: " + join(asked));
  return same_scene;
}

}  // namespace semfield
