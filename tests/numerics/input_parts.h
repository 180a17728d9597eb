// What the files of group G share.
#pragma once

#include <ctime>
#include <fstream>

#include "named_case.h"
#include "testkit/laws.h"

namespace semfield::numerics {

/// CPU time of this thread and growth of the process's largest memory since it was made.
class ResourceUse {
 public:
  ResourceUse() : begin_s_(cpu_s()) {
    std::ofstream("/proc/self/clear_refs") << "5";  // the largest memory so far starts anew
    begin_kib_ = status_kib("VmRSS:");
  }
  double seconds() const { return cpu_s() - begin_s_; }
  /// 0 where the system does not state it, and under a sanitizer, whose own memory would be counted.
  double grown_mib() const {
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
    return 0;
#endif
    const double most = status_kib("VmHWM:");
    return begin_kib_ > 0 && most > begin_kib_ ? (most - begin_kib_) / 1024 : 0;
  }

 private:
  static double cpu_s() {
    timespec now{};
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
  }
  static double status_kib(const std::string& key) {
    std::ifstream status("/proc/self/status");
    for (std::string word; status >> word;) {
      double value = 0;
      if (word == key && status >> value) return value;
    }
    return 0;
  }
  double begin_s_, begin_kib_ = 0;
};

inline std::unique_ptr<Dataset> dataset_of(const CaseRun& run, const char* name, const testkit::Settings& settings) {
  const PluginEntry& entry = run.registry().get(PluginKind::dataset, name);
  return entry.dataset(*testkit::make_params(entry, settings), {});
}

/// Whether a finding of that severity holds the words.
inline bool told(const Diagnostics& diagnostics, Severity severity, std::string_view words) {
  for (const Diagnostic& d : diagnostics.all()) {
    if (d.severity == severity && d.text().find(words) != std::string::npos) return true;
  }
  return false;
}

}  // namespace semfield::numerics
