// runs: questions about finished runs; `equal` compares two.
#include <cstdio>

#include "run/run_compare.h"
#include "verbs.h"

namespace semfield::app {

int run_runs_equal(const std::string& a, const std::string& b, AppContext& context) {
  Diagnostics diagnostics;
  const RunComparison found = compare_runs(a, b, diagnostics);
  for (const Diagnostic& finding : diagnostics.all()) print_note(context, finding.text());
  if (!found.difference.empty()) {
    std::printf("runs: different: %s\n", found.difference.c_str());
    return static_cast<int>(ErrorKind::failure);
  }
  std::printf("runs: equal step=%lld tensors=%zu\n", static_cast<long long>(found.step), found.tensors);
  return 0;
}

}  // namespace semfield::app
