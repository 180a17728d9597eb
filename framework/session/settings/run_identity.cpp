// Which settings make a run the run that it is, and which may change while it goes on.
#include "session/settings/run_identity.h"

#include <algorithm>
#include <array>
#include <filesystem>

#include "core/check.h"
#include "core/text.h"
#include "system/checksum.h"
#include "system/files.h"

namespace semfield {

namespace {

// Sections ("report.") and single keys; see is_part_of_identity. Where data lie is no part of it, what they are is: a
// checkpoint keeps that (checkpoint_facts.h).
constexpr std::array<std::string_view, 22> kFree{"name",
                                                 "base_dir",
                                                 "plugins",
                                                 "report.",
                                                 "fuse.",
                                                 "propagate.",
                                                 "limits.",
                                                 "train.steps",
                                                 "train.time_s",
                                                 "train.schedule.decay_steps",
                                                 "train.schedule.hold_steps",
                                                 "train.schedule.legs.",
                                                 "runtime.threads",
                                                 "runtime.memory_gb",
                                                 "runtime.device",
                                                 "scene.root",
                                                 "scene.file",
                                                 "scene.classes",
                                                 "scene.labels.clicks",
                                                 "scene.labels.from.folder",
                                                 "scene.labels.from.file",
                                                 "scene.labels.from.classes"};

// The one cause that can be named better than by a place in a file that is not there: a path of the machine's.
void require_utf8(const std::string& text) {
  for (std::size_t i = 0; i < text.size();) {
    const std::size_t length = utf8_length(text, i);
    if (length == 0) {
      const std::size_t begin = text.rfind('\n', i) + 1, end = text.find('\n', i);
      throw Error(
          ErrorKind::config, "config.text.encoding",
          "run.yaml cannot hold '" + text.substr(begin, end - begin) + "': it is not UTF-8; nothing was written",
          "give the folder or file another name");
    }
    i += length;
  }
}

// Without them a step that fails would fail again after each resume.
constexpr std::array<std::string_view, 4> kRescue{"train.adam.", "train.schedule.", "runtime.seed",
                                                  "runtime.precision"};

template <class List>
bool listed(const List& list, std::string_view key_path) {
  return std::any_of(list.begin(), list.end(), [&](std::string_view entry) {
    return entry.ends_with('.') ? key_path.starts_with(entry) : key_path == entry;
  });
}

}  // namespace

bool is_part_of_identity(std::string_view key_path) { return !listed(kFree, key_path); }

bool may_change_on_resume(std::string_view key_path) {
  return !is_part_of_identity(key_path) || listed(kRescue, key_path);
}

std::string identity_hash(const RunConfig& config) {
  std::string text;
  for (const ConfigSetting& setting : config_settings(resolved_config(config))) {
    if (is_part_of_identity(setting.key)) text += setting.key + ": " + setting.value + "\n";
  }
  return hex64(fnv1a64(text));
}

void require_scene_places(const RunConfig& config, const std::string& run_dir) {
  for (const ConfigSetting& setting : config_settings(resolved_config(config))) {
    if (!setting.key.starts_with("scene.") || is_part_of_identity(setting.key)) continue;
    if (setting.key == "scene.labels.clicks") continue;  // which Run opens
    const std::string place = parse_config_value(setting.value, setting.key).text();
    if (place.empty() || is_there(std::filesystem::path(config.base_dir) / place)) continue;
    throw Error(ErrorKind::no_input, "run.scene.moved",
                "'" + place + "' is not there, where " + setting.key + " of the run '" + run_dir + "' points",
                "if the data moved, add --set " + setting.key + "=NEW_PLACE");
  }
}

std::string run_config_text(const RunConfig& config, Registry& registry) {
  const std::string text = write_config(resolved_config(config));
  require_utf8(text);
  try {
    // Modules are loaded already.
    const ConfigNode tree = parse_config_text(text, "the run's run.yaml").without("plugins");
    Diagnostics diagnostics;
    RunConfig again = read_run_config(tree, registry, diagnostics);
    diagnostics.throw_if_errors(ErrorKind::config, "");
    again.plugins = config.plugins;
    SEMFIELD_CHECK(write_config(resolved_config(again)) == text, "run.yaml reads back as it was written");
  } catch (Error& error) {
    throw error.while_doing("while reading back the run.yaml that this run would write; nothing was written");
  }
  return text;
}

}  // namespace semfield
