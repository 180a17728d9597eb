// The suite: every group's cases in order, and the symbol that `check-numerics` loads.
#include <algorithm>

#include "named_case.h"

namespace semfield::numerics {

namespace {

/// A case's rows on the CPU, then those on a device.
template <void (*kHost)(CaseRun&), void (*kDevice)(CaseRun&)>
void both(CaseRun& run) {
  kHost(run);
  kDevice(run);
}

constexpr Case kCases[] = {
#define CASE(id, name, what, reference, measure) {id, name, what, reference, measure},
#define DEVICE_CASE(id, name, what, reference, on_cpu, on_device) {id, name, what, reference, both<on_cpu, on_device>},
#include "cases.inc"
};

}  // namespace

std::span<const Case> all_cases() { return kCases; }

std::vector<app::NumericsRow> run_suite(const Registry& registry, const std::vector<std::string>& ids) {
  const std::span<const Case> all = all_cases();
  for (const std::string& id : ids) {
    if (std::none_of(all.begin(), all.end(), [&](const Case& one) { return one.id.starts_with(id); }))
      throw Error(ErrorKind::usage, "usage.case.unknown", "no case begins with '" + id + "'",
                  "ids are A01 to I07; A stands for all of its group");
  }
  std::vector<app::NumericsRow> rows;
  for (const Case& one : all) {
    const auto named = [&](const std::string& id) { return one.id.starts_with(id); };
    if (!ids.empty() && std::none_of(ids.begin(), ids.end(), named)) continue;
    for (app::NumericsRow& row : run_case(one, registry)) rows.push_back(std::move(row));
  }
  return rows;
}

}  // namespace semfield::numerics

extern "C" void semfield_numerics_suite(const semfield::Registry& registry, const std::vector<std::string>& ids,
                                        std::vector<semfield::app::NumericsRow>& rows) {
  rows = semfield::numerics::run_suite(registry, ids);
}
