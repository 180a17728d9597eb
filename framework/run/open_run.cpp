#include "run/open_run.h"

#include <filesystem>
#include <functional>
#include <optional>
#include <set>

#include "core/text.h"
#include "labels/clicks/click_file.h"
#include "plugin/check/module_file.h"
#include "run/checkpoint_store.h"
#include "run/run_folder.h"
#include "run/run_resume.h"
#include "session/checkpoint_facts.h"
#include "session/refined_poses.h"
#include "session/settings/run_identity.h"
#include "session/trainer.h"
#include "system/files.h"

namespace semfield {

namespace {

// What training has shown of the scene already is not said again by each verb.
void add_untold(const Diagnostics& found, const std::string& told_path, Diagnostics& diagnostics) {
  std::set<std::string, std::less<>> told;
  const std::string text = std::filesystem::exists(told_path) ? read_text_file(told_path) : std::string();
  std::string_view rest = text, line;
  while (next_line(rest, line)) told.emplace(line);
  for (const Diagnostic& finding : found.all()) {
    if (told.contains(finding.text())) continue;
    if (finding.severity == Severity::warning) {
      diagnostics.warning(finding.code, finding.where, finding.message, finding.remedy);
    } else {
      diagnostics.note(finding.code, finding.where, finding.message);
    }
  }
}

}  // namespace

OpenedRun open_run(const std::string& run_dir, const std::vector<std::string>& overrides, Registry& registry,
                   Diagnostics& diagnostics, OpenFor purpose, Ranks* ranks) {
  OpenedRun run;
  const RunFolder folder = RunFolder::read(run_dir);
  run.run_dir = folder.path();
  const CheckpointStore store = CheckpointStore::read(folder.checkpoints_path());
  std::optional<CheckpointStore::Found> found = store.find_latest(diagnostics);
  if (!found) {
    throw Error(ErrorKind::no_input, "checkpoint.none.yet", run_dir + ": the run has no checkpoint yet",
                "train it from step 0 with `semfield train --resume " + shell_word(run_dir) + "`");
  }
  const CheckpointFacts facts = read_checkpoint_facts(found->file, found->step);
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
  if (facts.inputs && same_scene)
    warn_of_other_inputs(*facts.inputs, scene_inputs(run.session.scene, run.session.labels), diagnostics);
  warn_of_other_modules(facts.modules, run.session.config.plugins, diagnostics);
  load_pipeline(*run.session.pipeline, found->file);
  use_learned_poses(run.session, found->file, diagnostics);
  run.step = facts.step;
  run.train_s = facts.train_s;
  return run;
}

}  // namespace semfield
