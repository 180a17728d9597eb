// capture: any dataset written out in Replica layout.
#include <fmt/format.h>

#include "app/json_output.h"
#include "app/scene/folder_scene.h"
#include "app/scene/inspect_report.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "core/error.h"

namespace semfield::app {

namespace {

struct CaptureOptions {
  ConfigOptions config;
  std::string out;
};

int run(const CaptureOptions& options, AppContext& context) {
  OpenedDataset opened = dataset_of(options.config, context);
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

void words(VerbWords& verb, CaptureOptions& options) {
  verb.config(options.config);
  verb.threads(options.config.set);
  verb.required("--out FOLDER", options.out, "folder to create");
}

}  // namespace

Verb verb_capture() {
  return make_verb<CaptureOptions>("capture", 80, "write a scene's frames in Replica layout", words, run);
}

}  // namespace semfield::app
