// pack: any dataset into one file.
#include <fmt/format.h>

#include "app/json_output.h"
#include "app/scene/folder_scene.h"
#include "app/scene/inspect_report.h"
#include "app/verb.h"
#include "core/error.h"

namespace semfield::app {

namespace {

struct PackVerbOptions {
  ConfigOptions config;
  std::string out;
};

int run(const PackVerbOptions& options, AppContext& context) {
  OpenedDataset opened = dataset_of(options.config, context);
  Diagnostics diagnostics;
  const PackSummary summary = pack_scene(*opened.dataset, options.out, opened.config.load, PackOptions{}, diagnostics);
  print_findings(context, diagnostics);
  print_results(context, {{"frames", summary.frames}, {"bytes", summary.bytes}, {"file", options.out}},
                fmt::format("pack: frames={} bytes={} file={}", summary.frames, summary.bytes, options.out));
  return 0;
}

void words(VerbWords& verb, PackVerbOptions& options) {
  verb.config(options.config);
  verb.threads(options.config.set);
  verb.required("--out FILE", options.out, "file to write (.sfpack)");
}

}  // namespace

Verb verb_pack() {
  return make_verb<PackVerbOptions>("pack", 90, "write a scene as one file, for machines without image libraries",
                                    words, run);
}

}  // namespace semfield::app
