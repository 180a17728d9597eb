// check-numerics: the stiff and extreme cases as a table or a JSON object.
#include <fmt/format.h>

#include <cstdio>
#include <map>
#include <nlohmann/json.hpp>
#include <set>

#include "app/json_output.h"
#include "app/numerics_suite.h"
#include "app/verb.h"
#include "system/process.h"

namespace semfield::app {

namespace {

struct CheckNumericsOptions : Options {
  using Options::Options;
  const std::vector<std::string>& only = list("--only LIST", "case ids or prefixes of them: --only A,C03");
};

// By case: failed in one precision is failed; absent only when no precision of it exists.
std::map<NumericsStatus, int> count_cases(const std::vector<NumericsRow>& rows) {
  std::map<std::string, std::set<NumericsStatus>> cases;
  for (const NumericsRow& row : rows) cases[row.id].insert(row.status);
  std::map<NumericsStatus, int> counts{
      {NumericsStatus::passed, 0}, {NumericsStatus::failed, 0}, {NumericsStatus::absent, 0}};
  for (const auto& [id, of] : cases) {
    ++counts[of.contains(NumericsStatus::failed)   ? NumericsStatus::failed
             : of.contains(NumericsStatus::passed) ? NumericsStatus::passed
                                                   : NumericsStatus::absent];
  }
  return counts;
}

const char* status_text(const NumericsRow& row) {
  switch (row.status) {
    case NumericsStatus::passed:
      return "passed";
    case NumericsStatus::absent:
      return "absent";
    case NumericsStatus::failed:
      break;
  }
  return row.known_failure.empty() ? "FAILED" : "FAILED (known)";
}

std::string number(const NumericsRow& row, double value) {
  if (row.status == NumericsStatus::absent) return "-";
  if (row.error == 0 && row.tolerance == 0) return "exact";
  return value == 0 ? "0" : fmt::format("{:.2g}", value);
}

std::string time_text(double seconds) {
  return seconds >= 1 ? fmt::format("{:.2f} s", seconds) : fmt::format("{:.2f} ms", 1e3 * seconds);
}

void print_table(const std::vector<NumericsRow>& rows) {
  std::printf("%-4s %-22s %-8s %-18s %9s %9s %7s %10s  %s\n", "id", "case", "", "reference", "error", "allowed",
              "checks", "time", "status");
  for (const NumericsRow& row : rows) {
    std::printf("%-4s %-22s %-8s %-18s %9s %9s %7d %10s  %s\n", row.id.c_str(), row.name.c_str(), row.precision.c_str(),
                row.reference.c_str(), number(row, row.error).c_str(), number(row, row.tolerance).c_str(), row.checks,
                time_text(row.seconds).c_str(), status_text(row));
    if (row.status == NumericsStatus::failed) std::printf("     %s\n", row.note.c_str());
    if (row.status == NumericsStatus::failed && !row.known_failure.empty()) {
      std::printf("     known: %s\n", row.known_failure.c_str());
    }
  }
}

Json results(const std::vector<NumericsRow>& rows, int passed, int failed, int absent) {
  Json out = {{"passed", passed}, {"failed", failed}, {"absent", absent}, {"cases", passed + failed + absent}};
  out["rows"] = Json::array();
  for (const NumericsRow& row : rows) {
    out["rows"].push_back({{"id", row.id},
                           {"name", row.name},
                           {"precision", row.precision},
                           {"what", row.what},
                           {"reference", row.reference},
                           {"error", row.error},
                           {"tolerance", row.tolerance},
                           {"checks", row.checks},
                           {"seconds", row.seconds},
                           {"status", status_text(row)},
                           {"note", row.note},
                           {"known_failure", row.known_failure}});
  }
  return out;
}

int run(const CheckNumericsOptions& options, AppContext& context) {
  const auto suite = reinterpret_cast<NumericsSuite>(
      part_symbol("semfield_numerics", kNumericsSuiteSymbol, "the suite of numerical cases cannot be loaded"));
  std::vector<NumericsRow> rows;
  suite(context.registry, options.only, rows);
  const std::map<NumericsStatus, int> counts = count_cases(rows);
  const int passed = counts.at(NumericsStatus::passed), failed = counts.at(NumericsStatus::failed);
  const int absent = counts.at(NumericsStatus::absent);
  if (context.json) {
    print_json(context, results(rows, passed, failed, absent));
  } else {
    print_table(rows);
    std::printf("check-numerics: passed=%d failed=%d cases=%d%s\n", passed, failed, passed + failed + absent,
                absent > 0 ? fmt::format(" absent={}", absent).c_str() : "");
  }
  return failed == 0 ? 0 : static_cast<int>(ErrorKind::failure);
}

}  // namespace

Verb verb_check_numerics() {
  return make_verb<CheckNumericsOptions>("check-numerics", 190,
                                         "check stiff and extreme cases against their references", run);
}

}  // namespace semfield::app
