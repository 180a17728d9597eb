// A stiff or extreme case: what it feeds in, what it compares with, and the rows it gives.
#pragma once

#include <chrono>
#include <ctime>
#include <fstream>

#include "app/bench/bench.h"
#include "core/error.h"
#include "core/rng.h"
#include "plugin/registry.h"
#include "testkit/laws.h"

namespace semfield::numerics {

/// Collects what one case measured. A row without a single check fails, and so does one whose error is NaN.
class CaseRun : NonCopyable {
 public:
  CaseRun(const Registry& registry, app::NumericsRow blank);
  ~CaseRun();

  const Registry& registry() const { return registry_; }
  /// Opens a row; what follows belongs to it. "fp32", "float64", "bf16", "-".
  void row(std::string_view precision);
  /// error <= tolerance (0: exactly). The row shows the error with the worst ratio; `what` names it when it fails.
  void measure(double error, double tolerance, std::string_view what = {});
  /// The same of |got - want|, and of that over |want|, in long double.
  void near(long double got, long double want, double tolerance, std::string_view what = {});
  void relative(long double got, long double want, double tolerance, std::string_view what = {});
  /// A claim without a number.
  void expect(bool holds, std::string_view claim);
  /// `call` throws Error of `kind` whose text holds every one of `words`.
  void expect_error(ErrorKind kind, const std::vector<std::string>& words, const std::function<void()>& call);
  /// A figure worth seeing beside the row; several are joined.
  void note(std::string_view text);
  /// What the row is about does not exist in this build.
  void absent(std::string_view reason);
  /// An empty folder of this case, removed with it.
  const std::string& folder();

  /// Closes the last row; a case that threw fails with `thrown`.
  std::vector<app::NumericsRow> finish(std::string_view thrown = {});

 private:
  app::NumericsRow& current();
  void fail(std::string_view text);
  void close();
  const Registry& registry_;
  app::NumericsRow blank_;
  std::vector<app::NumericsRow> rows_;
  std::chrono::steady_clock::time_point begin_;
  double worst_ratio_ = -1;
  bool failed_ = false, absent_ = false;
  std::string failures_, folder_;
};

struct Case {
  std::string_view id, name;
  std::string_view what;       ///< the input, one short sentence
  std::string_view reference;  ///< closed form, long double, __float128, exact, ...
  void (*run)(CaseRun&);
  std::string_view known_failure = {};  ///< why it fails today; it is then shown as failing, and must fail
};

// The functions that measure them.
#define CASE(id, name, what, reference, measure) void measure(CaseRun& run);
#define DEVICE_CASE(id, name, what, reference, on_cpu, on_device) \
  void on_cpu(CaseRun& run);                                      \
  void on_device(CaseRun& run);
#include "cases.inc"
#include "core/non_copyable.h"
#undef CASE
#undef DEVICE_CASE

/// In the order of ids.
std::span<const Case> all_cases();
std::vector<app::NumericsRow> run_case(const Case& one, const Registry& registry);

template <class Real>
constexpr std::string_view precision_name() {
  return std::is_same_v<Real, float> ? "fp32" : "float64";
}
/// The tolerance of Real: as given in fp32, at most 1e-12 in float64 (an absolute or relative error as the case says).
template <class Real>
constexpr double tolerance_of(double fp32, double float64 = 1e-12) {
  return std::is_same_v<Real, float> ? fp32 : float64;
}
/// Calls body(float{}) and body(double{}), each in a row of its own.
template <class Body>
void in_both_precisions(CaseRun& run, const Body& body) {
  run.row(precision_name<float>());
  body(float{});
  run.row(precision_name<double>());
  body(double{});
}
/// Begins the function of a case whose body is the same for both values of Real, each in a row of its own.
#define IN_BOTH_PRECISIONS(name)                                              \
  template <class Real>                                                       \
  void name##_in(CaseRun& run);                                               \
  void name(CaseRun& run) {                                                   \
    in_both_precisions(run, [&]<class Real>(Real) { name##_in<Real>(run); }); \
  }                                                                           \
  template <class Real>                                                       \
  void name##_in(CaseRun& run)
template <class T>
constexpr long double long_double(T x) {
  return static_cast<long double>(x);
}
/// |a - b| / |b|; |a| where b is 0.
inline double relative_error(long double a, long double b) {
  const long double difference = a > b ? a - b : b - a;
  const long double scale = b < 0 ? -b : b;
  return static_cast<double>(scale == 0 ? difference : difference / scale);
}

/// Uniform numbers for inputs, by address; float64 with all 53 bits.
class Numbers {
 public:
  explicit Numbers(std::uint64_t seed) : seed_(seed) {}
  double in(double low, double high) { return low + (high - low) * uniform(); }
  double uniform() {
    const PhiloxBlock b = random_block({seed_, 0, stream_id("stiff cases")}, next_++);
    return static_cast<double>((std::uint64_t{b.v[0]} << 21) ^ (b.v[1] >> 11)) * 0x1p-53;
  }

 private:
  std::uint64_t seed_, next_ = 0;
};

// What the files of group G share.

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
