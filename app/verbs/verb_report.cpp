// report: error against run time of one or several runs, one self-contained page.
#include <cstdio>

#include "app/json_output.h"
#include "app/verb.h"
#include "report/report.h"
#include "system/files.h"

namespace semfield::app {

namespace {

struct ReportOptions {
  std::vector<std::string> runs;
  std::string out;
};

int run(const ReportOptions& options, AppContext& context) {
  const std::string path = options.out.empty() ? options.runs.front() + "/report.html" : options.out;
  write_file_atomic(path, make_report(read_report_input(options.runs)));
  if (context.json) {
    print_json(context, {{"runs", options.runs}, {"file", path}});
    return 0;
  }
  std::printf("report: runs=%zu file=%s\n", options.runs.size(), path.c_str());
  return 0;
}

void words(VerbWords& verb, ReportOptions& options) {
  verb.operands("run", options.runs, "run folders");
  verb.value("--out FILE", options.out, "file to write (default: report.html of the first run)");
}

}  // namespace

Verb verb_report() {
  return with_json(make_verb<ReportOptions>("report", 40, "write one HTML page about one or several runs", words, run));
}

}  // namespace semfield::app
