// inspect, capture, degrade, pack: a configuration's scene without training.
#include <fmt/format.h>

#include <algorithm>
#include <cstdio>

#include "compute/parallel.h"
#include "core/findings.h"
#include "progress_line.h"
#include "session/ray_source.h"
#include "settings/run_config.h"
#include "verb_capture.h"
#include "verb_degrade.h"
#include "verb_inspect.h"
#include "verb_pack.h"
#include "verbs.h"

namespace semfield::app {

namespace {

struct OpenedDataset {
  RunConfig config;
  std::unique_ptr<Dataset> dataset;
};

OpenedDataset dataset_of(const ConfigOptions& options, AppContext& context) {
  OpenedDataset opened;
  opened.config = load_run_config(options.config, options.set, context.registry);
  context.adopt(opened.config);
  DatasetBuild build;
  build.config_dir = opened.config.base_dir;
  opened.dataset = opened.config.dataset.entry->dataset(*opened.config.dataset.params, build);
  return opened;
}

// The scene with what its label steps ask for.
LoadedScene load_for_labels(const OpenedDataset& opened, Diagnostics& diagnostics) {
  SceneLoadOptions load = opened.config.load;
  load.depth = opened.config.labels.wants_depth() ? DepthKept::all : DepthKept::none;
  load.with_instances = opened.config.labels.needs_instances();
  LoadedScene scene = load_scene(*opened.dataset, load, diagnostics);
  open_label_files(scene, opened.config.labels, diagnostics);
  return scene;
}

// What an inspection shows of training frames are the labels that would train.
void show_training_labels(LoadedScene& scene, const LabelConfig& config, Diagnostics& diagnostics) {
  read_test_labels(scene, config, diagnostics);
  TrainingLabels labels;
  try {
    labels = make_training_labels(scene, config, diagnostics);
  } catch (const Error& e) {
    if (!diagnostics.has_errors()) diagnostics.error("", e.message(), e.remedy());
    return;
  }
  for (const int f : scene.frames_of(Split::train)) {
    const auto i = static_cast<std::size_t>(f);
    scene.info.frames[i].has_labels = !labels.frames[i].empty();
    scene.class_pixels[i] = labels.class_pixels[i];
  }
}

// Training would refuse it at its first step.
void check_ray_source(const LoadedScene& scene, const TrainParams& params, Diagnostics& diagnostics) {
  if (params.ray_source != RaySourceKind::label_balanced) return;
  for (const int f : scene.frames_of(Split::train)) {
    const std::vector<std::int64_t>& pixels = scene.class_pixels[static_cast<std::size_t>(f)];
    if (!pixels.empty() && std::any_of(pixels.begin(), pixels.end() - 1, [](std::int64_t n) { return n > 0; })) return;
  }
  const Error refused = no_labelled_pixel();
  diagnostics.error("", refused.message(), refused.remedy());
}

}  // namespace

int run_inspect(const ConfigOptions& options, const std::string& frusta_path, AppContext& context) {
  OpenedDataset opened = dataset_of(options, context);
  Diagnostics diagnostics;
  LoadedScene scene = load_for_labels(opened, diagnostics);
  if (!diagnostics.has_errors()) show_training_labels(scene, opened.config.labels, diagnostics);
  if (!diagnostics.has_errors()) check_ray_source(scene, opened.config.train, diagnostics);
  std::fputs(inspect_report(scene, diagnostics).c_str(), stdout);
  if (!frusta_path.empty()) {
    write_frusta_ply(frusta_path, scene);
    print_note(context, "cameras written to " + frusta_path);
  }
  return diagnostics.has_errors() ? static_cast<int>(ErrorKind::data) : 0;
}

int run_capture(const ConfigOptions& options, const std::string& out, AppContext& context) {
  OpenedDataset opened = dataset_of(options, context);
  Diagnostics diagnostics;
  SceneInfo info = opened.dataset->open(diagnostics);
  convert_info(info, opened.config.load.convention);
  for (const Diagnostic& finding : folded(diagnostics)) {
    if (finding.severity != Severity::error) print_note(context, finding.text());
  }
  diagnostics.throw_if_errors(ErrorKind::data, "the scene has problems:");
  CaptureReport report;
  {
    ProgressLine progress(context, "captured");
    report = capture_replica(
        *opened.dataset, info, out, [&](int done, int total) { progress.show(done, total); },
        opened.config.load.convention);
  }
  std::printf("capture: frames=%d bytes=%lld folder=%s\n", report.frames, static_cast<long long>(report.bytes),
              out.c_str());
  return 0;
}

int run_degrade(const ConfigOptions& options, const std::string& out, AppContext& context) {
  refuse_used_folder(out);
  const OpenedDataset opened = dataset_of(options, context);
  Diagnostics diagnostics;
  const LoadedScene scene = load_for_labels(opened, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::data, "the scene has problems:");
  const TrainingLabels labels = make_training_labels(scene, opened.config.labels, diagnostics);
  for (const Diagnostic& finding : folded(diagnostics)) print_note(context, finding.text());
  const DegradeSource source{write_config(resolved_config(opened.config)), opened.config.labels.from.type,
                             opened.config.labels.selection.seed};
  const DegradeReport report = write_degraded(scene, labels, source, out);
  const auto number = [](const std::optional<double>& value) { return value ? fmt::format("{:.4f}", *value) : "-"; };
  std::printf("degrade: frames=%d labelled_px=%lld accuracy=%s miou_present=%s folder=%s\n", report.frames,
              static_cast<long long>(report.labelled_px), number(report.accuracy).c_str(),
              number(report.miou_present).c_str(), out.c_str());
  return 0;
}

int run_pack(const ConfigOptions& options, const std::string& out, AppContext& context) {
  OpenedDataset opened = dataset_of(options, context);
  Diagnostics diagnostics;
  const PackSummary summary = pack_scene(*opened.dataset, out, opened.config.load, PackOptions{}, diagnostics);
  for (const Diagnostic& finding : folded(diagnostics)) print_note(context, finding.text());
  std::printf("pack: frames=%d bytes=%llu file=%s\n", summary.frames, static_cast<unsigned long long>(summary.bytes),
              out.c_str());
  return 0;
}

}  // namespace semfield::app
