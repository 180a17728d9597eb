#include "named_case.h"

#include <stdlib.h>

#include <algorithm>
#include <filesystem>

namespace semfield::numerics {

CaseRun::CaseRun(const Registry& registry, app::NumericsRow blank) : registry_(registry), blank_(std::move(blank)) {}

CaseRun::~CaseRun() {
  std::error_code ignored;
  if (!folder_.empty()) std::filesystem::remove_all(folder_, ignored);
}

void CaseRun::row(std::string_view precision) {
  close();
  rows_.push_back(blank_);
  rows_.back().precision = precision;
  worst_ratio_ = -1;
  failed_ = absent_ = false;
  failures_.clear();
  begin_ = std::chrono::steady_clock::now();
}

app::NumericsRow& CaseRun::current() {
  if (rows_.empty()) row("-");
  return rows_.back();
}

void CaseRun::fail(std::string_view text) {
  failed_ = true;
  if (failures_.size() > 400) return;  // the first failures say enough
  if (!failures_.empty()) failures_ += "; ";
  failures_ += text;
}

void CaseRun::measure(double error, double tolerance, std::string_view what) {
  app::NumericsRow& row = current();
  ++row.checks;
  const double infinity = std::numeric_limits<double>::infinity();
  const double ratio = std::isnan(error) ? infinity : error == 0 ? 0 : tolerance > 0 ? error / tolerance : infinity;
  if (ratio > worst_ratio_) {
    worst_ratio_ = ratio;
    row.error = error;
    row.tolerance = tolerance;
  }
  if (!(error <= tolerance))
    fail(std::string(what.empty() ? "error" : what) + " " + std::to_string(ratio) + " times its tolerance");
}

void CaseRun::near(long double got, long double want, double tolerance, std::string_view what) {
  measure(static_cast<double>(std::abs(got - want)), tolerance, what);
}

void CaseRun::relative(long double got, long double want, double tolerance, std::string_view what) {
  measure(relative_error(got, want), tolerance, what);
}

void CaseRun::expect(bool holds, std::string_view claim) {
  ++current().checks;
  if (!holds) fail("not so: " + std::string(claim));
}

void CaseRun::expect_error(ErrorKind kind, const std::vector<std::string>& words, const std::function<void()>& call) {
  ++current().checks;
  try {
    call();
  } catch (const Error& error) {
    if (error.kind() != kind) fail("another kind of error: " + std::string(error.what()));
    for (const std::string& word : words) {
      if (std::string_view(error.what()).find(word) == std::string_view::npos)
        fail("no '" + word + "' in: " + error.what());
    }
    return;
  }
  fail("no error was thrown" + (words.empty() ? std::string() : ", expected one with '" + words.front() + "'"));
}

void CaseRun::note(std::string_view text) {
  std::string& note = current().note;
  if (!note.empty()) note += "; ";
  note += text;
}

void CaseRun::absent(std::string_view reason) {
  note(reason);
  absent_ = true;
}

const std::string& CaseRun::folder() {
  if (folder_.empty()) {
    std::string name = (std::filesystem::temp_directory_path() / "semfield_case_XXXXXX").string();
    if (::mkdtemp(name.data()) == nullptr)
      throw Error(ErrorKind::cannot_create, "files.output.create", "no folder for a case: " + name);
    folder_ = name;
  }
  return folder_;
}

void CaseRun::close() {
  if (rows_.empty()) return;
  app::NumericsRow& row = rows_.back();
  row.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin_).count();
  if (!absent_ && row.checks == 0) fail("nothing was checked");
  row.status = failed_   ? app::NumericsStatus::failed
               : absent_ ? app::NumericsStatus::absent
                         : app::NumericsStatus::passed;
  if (!failures_.empty()) row.note = row.note.empty() ? failures_ : failures_ + "; " + row.note;
}

std::vector<app::NumericsRow> CaseRun::finish(std::string_view thrown) {
  current();
  if (!thrown.empty()) fail(thrown);
  close();
  return std::move(rows_);
}

std::vector<app::NumericsRow> run_case(const Case& one, const Registry& registry) {
  app::NumericsRow blank;
  blank.id = one.id;
  blank.name = one.name;
  blank.what = one.what;
  blank.reference = one.reference;
  blank.known_failure = one.known_failure;
  CaseRun run(registry, blank);
  try {
    one.run(run);
  } catch (const std::exception& error) {
    return run.finish(std::string("thrown: ") + error.what());
  }
  return run.finish();
}

// The suite: every group's cases in order, and the symbol that `bench numerics` loads.

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
