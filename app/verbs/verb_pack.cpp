// pack, capture, degrade: a scene as one file or in Replica layout, and its training labels as images.
#include <fmt/format.h>

#include "app/json_output.h"
#include "app/scene/folder_scene.h"
#include "app/scene/inspect_report.h"
#include "app/verb.h"
#include "core/error.h"

namespace semfield::app {

namespace {

struct WriteOptions : Options {
  explicit WriteOptions(const Declaration& at) : Options(at) { threads(set); }
  const std::string& config = operand("config", "configuration file (YAML)");
  std::vector<std::string>& set = settings();
};

struct FileOptions : WriteOptions {
  using WriteOptions::WriteOptions;
  const std::string& out = required("--out FILE", "file to write (.sfpack)");
};

struct FolderOptions : WriteOptions {
  using WriteOptions::WriteOptions;
  const std::string& out = required("--out FOLDER", "folder to create");
};

int pack(const FileOptions& options, AppContext& context) {
  OpenedDataset opened = dataset_of(options.config, options.set, context);
  Diagnostics diagnostics;
  const PackSummary summary = pack_scene(*opened.dataset, options.out, opened.config.load, PackOptions{}, diagnostics);
  print_findings(context, diagnostics);
  print_results(context, {{"frames", summary.frames}, {"bytes", summary.bytes}, {"file", options.out}},
                fmt::format("pack: frames={} bytes={} file={}", summary.frames, summary.bytes, options.out));
  return 0;
}

int capture(const FolderOptions& options, AppContext& context) {
  OpenedDataset opened = dataset_of(options.config, options.set, context);
  Diagnostics diagnostics;
  SceneInfo info = opened.dataset->open(diagnostics);
  convert_info(info, opened.config.load.convention);
  for (const Diagnostic& finding : folded(diagnostics)) {
    if (finding.severity != Severity::error) print_note(context, finding.shown());
  }
  diagnostics.throw_if_errors(ErrorKind::data, "the scene has problems:");
  CaptureReport report;
  {
    ProgressLine progress(context, "captured");
    report = capture_replica(
        *opened.dataset, info, options.out, [&](int done, int total) { progress.show(done, total); },
        opened.config.load.convention);
  }
  print_results(context, {{"frames", report.frames}, {"bytes", report.bytes}, {"folder", options.out}},
                fmt::format("capture: frames={} bytes={} folder={}", report.frames, report.bytes, options.out));
  return 0;
}

int degrade(const FolderOptions& options, AppContext& context) {
  refuse_used_folder(options.out);
  OpenedDataset opened = dataset_of(options.config, options.set, context);
  Diagnostics diagnostics;
  const LoadedScene scene = load_for_labels(opened, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::data, "the scene has problems:");
  const TrainingLabels labels = make_training_labels(scene, opened.config.labels, diagnostics);
  print_findings(context, diagnostics);
  const DegradeReport report = write_degraded(scene, labels, opened.config, options.out);
  print_results(
      context,
      {{"frames", report.frames},
       {"labelled_px", report.labelled_px},
       {"accuracy", number_json<Json>(report.accuracy)},
       {"miou_present", number_json<Json>(report.miou_present)},
       {"folder", options.out}},
      fmt::format("degrade: frames={} labelled_px={} accuracy={} miou_present={} folder={}", report.frames,
                  report.labelled_px, figure_text(report.accuracy), figure_text(report.miou_present), options.out));
  return 0;
}

}  // namespace

Verb verb_pack() {
  return make_verb<FileOptions>("pack", 90, "write a scene as one file, for machines without image libraries", pack);
}

Verb verb_capture() {
  return make_verb<FolderOptions>("capture", 80, "write a scene's frames in Replica layout", capture);
}

Verb verb_degrade() {
  return make_verb<FolderOptions>("degrade", 100, "write the training labels, degraded as the configuration says",
                                  degrade);
}

}  // namespace semfield::app
