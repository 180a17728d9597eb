#include "run/run_start.h"

#include <fmt/chrono.h>
#include <fmt/format.h>

#include <algorithm>
#include <ctime>
#include <filesystem>
#include <optional>

#include "compute/parallel.h"
#include "labels/clicks/click_file.h"
#include "run/ended_run.h"
#include "run/leave_out_proofs.h"
#include "scene/classes/class_names.h"
#include "session/settings/run_identity.h"
#include "system/files.h"

namespace semfield {

namespace {

void write_left_out(const RunFolder& folder, const Session& session) {
  std::vector<LeftOutRow> rows;
  for (const LeftOut& out : session.plan.left_out) {
    rows.push_back({out.component, out.rule, out.evidence, std::string(1, static_cast<char>(out.proof)), out.saving,
                    out.measured.empty() ? shipped_saving(out.component) : out.measured});
  }
  write_file_atomic(folder.left_out_path(), left_out_json(rows));
}

// Those of earlier resumes, which the file holds that is about to be written again, and this one's.
std::vector<std::string> settings_changed(const RunFolder& folder, const ResumePoint& point) {
  std::vector<std::string> changes;
  const std::string path = folder.environment_path();
  if (std::filesystem::exists(path)) changes = parse_settings_changed(read_text_file(path), path);
  for (const ConfigDifference& change : point.changed) {
    const std::string line = fmt::format("step {}: {}", point.step(), change.text());
    if (std::find(changes.begin(), changes.end(), line) == changes.end()) changes.push_back(line);
  }
  return changes;
}

void write_environment(const RunFolder& folder, Training& training, const Registry& registry,
                       const ResumePoint& point) {
  const Session& session = training.session();
  Environment environment = this_environment();
  environment.threads = thread_count();
  environment.seed = session.config.runtime.seed;
  environment.input_hash = training.inputs().hash();
  environment.settings_changed = settings_changed(folder, point);
  for (const PluginEntry* entry : registry.entries()) environment.modules.push_back(entry->module);
  environment.more.emplace_back("started", fmt::format("{:%Y-%m-%d %H:%M} UTC", fmt::gmtime(std::time(nullptr))));
  environment.more.emplace_back("device", session.pipeline->executor().description());
  environment.more.emplace_back("matrix products", session.pipeline->executor().matrix_products());
  environment.more.emplace_back("precision", std::string(precision_name(session.config.runtime.precision)));
  write_file_atomic(folder.environment_path(), environment_json(environment));
}

}  // namespace

OpenedForTraining open_for_training(RunConfig config, Registry& registry, const TrainRequest& request,
                                    TrainingListener& listener) {
  Diagnostics diagnostics;
  SessionOptions options;
  options.keep = request.keep;
  options.probe = true;
  options.ranks = request.ranks;
  if (config.report.training_frames > 0) options.depth = DepthKept::all;
  if (!request.out_dir.empty()) settle_click_file(config.labels, request.out_dir);
  // A new run's folder is made when nothing can refuse the run any more; a resumed one is locked first.
  if (!request.resume && !request.out_dir.empty()) RunFolder::require_new(request.out_dir);
  std::optional<RunFolder> folder;
  ResumePoint point;
  if (request.resume) {
    folder.emplace(RunFolder::resume(request.out_dir));
    keep_components(config, request.keep);
    point = find_resume_point(*folder, config, registry, diagnostics);
    if (request.more.any()) {
      const std::string before = length_text(config);
      ask_more(config, request.more, point.step(), point.facts ? point.facts->train_s : 0);
      point.changed.push_back({"length", before, length_text(config)});
    }
    require_scene_places(config, folder->path());
    require_clicks({point.facts.has_value(), point.facts ? point.facts->clicks : std::nullopt}, config.labels,
                   folder->path(), diagnostics);
    if (point.facts) options.trained_classes = point.facts->classes;
  }
  const std::size_t before = diagnostics.all().size();
  Session session = open_session(std::move(config), registry, options, diagnostics);
  std::string findings;
  for (std::size_t i = before; i < diagnostics.all().size(); ++i) findings += diagnostics.all()[i].text() + "\n";
  SceneInputs inputs = scene_inputs(session.scene, session.labels);
  if (point.facts) compare_with_training(*point.facts, inputs, session, diagnostics);
  tell_findings(listener, diagnostics, session);
  if (request.out_dir.empty()) return {std::nullopt, std::move(session), std::move(inputs), std::move(point)};
  if (folder) {
    if (std::optional<TrainOutcome> ended = ended_run(*folder, session.config, point))
      return {std::move(*folder), std::move(session), std::move(inputs), std::move(point), std::move(ended)};
  }
  if (!folder) {
    (void)run_config_text(session.config, registry);  // what cannot be stored leaves no folder
    folder.emplace(RunFolder::create(request.out_dir));
  }
  write_run_config(*folder, session.config, registry);
  if (!findings.empty() || std::filesystem::exists(folder->findings_path()))
    write_file_atomic(folder->findings_path(), findings);
  return {std::move(*folder), std::move(session), std::move(inputs), std::move(point)};
}

void write_run_config(const RunFolder& folder, const RunConfig& config, Registry& registry) {
  const std::string text = run_config_text(config, registry);
  std::error_code unknown;
  if (std::filesystem::exists(folder.config_path(), unknown) && read_text_file(folder.config_path()) == text) return;
  write_file_atomic(folder.config_path(), text);
}

void write_label_counts(const RunFolder& folder, const Session& session, const SelfTraining& self_training) {
  LabelCounts counts = label_counts(session.manifest, session.scene.info.classes, session.labels.steps);
  counts.rounds = self_training.rounds();
  write_file_atomic(folder.labels_path(), label_counts_json(counts));
}

void write_run_records(const RunFolder& folder, Training& training, const Registry& registry,
                       const ResumePoint& point) {
  const Session& session = training.session();
  const WorkSettings work = session.work();
  const WorkScope scope(work);
  if (!session.scene.info.classes.empty())
    write_file_atomic(folder.classes_path(), named_classes(session.scene.info.classes).to_yaml());
  write_left_out(folder, session);
  write_environment(folder, training, registry, point);
}

}  // namespace semfield
