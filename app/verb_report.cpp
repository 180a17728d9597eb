// report: error against run time of one or several runs, one self-contained page.
#include <cstdio>

#include "report/report.h"
#include "system/files.h"
#include "verbs.h"

namespace semfield::app {

int run_report(const std::vector<std::string>& runs, const std::string& out, AppContext&) {
  const std::string path = out.empty() ? runs.front() + "/report.html" : out;
  write_file_atomic(path, make_report(read_report_input(runs)));
  std::printf("report: runs=%zu file=%s\n", runs.size(), path.c_str());
  return 0;
}

}  // namespace semfield::app
