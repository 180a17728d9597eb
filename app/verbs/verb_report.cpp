// report: error against run time of one or several runs, one self-contained page.
#include <fmt/format.h>

#include "app/json_output.h"
#include "app/render/run_surface.h"
#include "app/scene/inspect_report.h"
#include "app/verb.h"
#include "core/error.h"
#include "report/report.h"
#include "run/run_scores.h"
#include "system/files.h"

namespace semfield::app {

namespace {

struct ReportOptions : Options {
  using Options::Options;
  const std::vector<std::string>& runs = operands("run", "run folders");
  const bool& flat = flag("--no-3d", "leave out the view of the first run in 3D");
  const std::string& out = value("--out FILE", "file to write (default: report.html of the first run)");
};

// A report needs no scene, a view of it does: where the run does not open, the note says why.
std::string scene_of(const std::string& run_dir, AppContext& context) {
  try {
    const OpenedRun run = run_of(run_dir, {}, OpenFor::rendering, context);
    return report_scene(run.session, run_dir, run.step, context);
  } catch (const Error& e) {
    print_note(context, "no view in 3D in the report: " + e.message());
    return {};
  }
}

int run(const ReportOptions& options, AppContext& context) {
  const std::string path = options.out.empty() ? options.runs.front() + "/report.html" : options.out;
  const std::string data = read_report(options.runs);
  write_file_atomic(path, report_page(data, options.flat ? "" : scene_of(options.runs.front(), context)));
  print_results(context, {{"runs", options.runs}, {"file", path}},
                fmt::format("report: runs={} file={}", options.runs.size(), path));
  return 0;
}

}  // namespace

Verb verb_report() {
  return make_verb<ReportOptions>("report", 40, "write one HTML page about one or several runs", run);
}

}  // namespace semfield::app
