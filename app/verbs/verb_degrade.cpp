// degrade: the labels that would train, written out as images with a manifest.
#include <fmt/format.h>

#include <cstdio>

#include "app/json_output.h"
#include "app/scene/folder_scene.h"
#include "app/scene/inspect_report.h"
#include "app/verb.h"
#include "core/error.h"

namespace semfield::app {

namespace {

struct DegradeOptions {
  ConfigOptions config;
  std::string out;
};

int run(const DegradeOptions& options, AppContext& context) {
  refuse_used_folder(options.out);
  OpenedDataset opened = dataset_of(options.config, context);
  Diagnostics diagnostics;
  const LoadedScene scene = load_for_labels(opened, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::data, "the scene has problems:");
  const TrainingLabels labels = make_training_labels(scene, opened.config.labels, diagnostics);
  print_findings(context, diagnostics);
  const DegradeSource source{write_config(resolved_config(opened.config)), opened.config.labels.from.type,
                             opened.config.labels.selection.seed};
  const DegradeReport report = write_degraded(scene, labels, source, options.out);
  const auto number = [](const std::optional<double>& value) { return value ? fmt::format("{:.4f}", *value) : "-"; };
  print_results(context,
                {{"frames", report.frames},
                 {"labelled_px", report.labelled_px},
                 {"accuracy", number_json<Json>(report.accuracy)},
                 {"miou_present", number_json<Json>(report.miou_present)},
                 {"folder", options.out}},
                fmt::format("degrade: frames={} labelled_px={} accuracy={} miou_present={} folder={}", report.frames,
                            report.labelled_px, number(report.accuracy), number(report.miou_present), options.out));
  return 0;
}

void words(VerbWords& verb, DegradeOptions& options) {
  verb.config(options.config);
  verb.threads(options.config.set);
  verb.required("--out FOLDER", options.out, "folder to create");
}

}  // namespace

Verb verb_degrade() {
  return make_verb<DegradeOptions>("degrade", 100, "write the training labels, degraded as the configuration says",
                                   words, run);
}

}  // namespace semfield::app
