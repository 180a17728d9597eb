// Every case as a test of its own; a known failure must still fail.
#include <cctype>

#include "named_case.h"
#include "plugin/loader.h"
#include "tests/says.h"

namespace semfield::numerics {
namespace {

const Registry& linked() {
  static const Registry* registry = [] {
    auto* made = new Registry;
    register_linked_plugins(*made);
    return made;
  }();
  return *registry;
}

class Numerics : public testing::TestWithParam<Case> {};

TEST_P(Numerics, Case) {
  bool any_failed = false;
  for (const app::NumericsRow& row : run_case(GetParam(), linked())) {
    const bool failed = row.status == app::NumericsStatus::failed;
    any_failed = any_failed || failed;
    if (failed && row.known_failure.empty()) {
      ADD_FAILURE() << row.id << " " << row.name << " in " << row.precision << ": error " << row.error << ", tolerance "
                    << row.tolerance << "; " << row.note;
    }
  }
  if (!GetParam().known_failure.empty()) {
    EXPECT_TRUE(any_failed) << "this known failure passes: take its mark away";
  }
}

std::string test_name(const testing::TestParamInfo<Case>& info) {
  std::string name = std::string(info.param.id) + "_" + std::string(info.param.name);
  for (char& c : name) c = std::isalnum(static_cast<unsigned char>(c)) != 0 ? c : '_';
  return name;
}
INSTANTIATE_TEST_SUITE_P(Suite, Numerics, testing::ValuesIn(all_cases()), test_name);

TEST(NumericsSuite, IdsAreUniqueAndInOrder) {
  std::string before;
  for (const Case& one : all_cases()) {
    EXPECT_LT(before, std::string(one.id));
    before = one.id;
  }
}

TEST(NumericsSuite, ARowWithoutChecksFails) {
  const Case empty{"Z01", "empty", "nothing", "none", [](CaseRun& run) { run.row("fp32"); }};
  EXPECT_EQ(run_case(empty, linked()).at(0).status, app::NumericsStatus::failed);
}

TEST(NumericsSuite, NanErrorsAndThrownErrorsFail) {
  const Case nan{"Z02", "nan", "", "", [](CaseRun& run) { run.measure(std::nan(""), 1.0); }};
  EXPECT_EQ(run_case(nan, linked()).at(0).status, app::NumericsStatus::failed);
  const Case thrown{"Z03", "thrown", "", "",
                    [](CaseRun&) { throw Error(ErrorKind::data, "test.error.made", "broken"); }};
  const auto rows = run_case(thrown, linked());
  EXPECT_EQ(rows.at(0).status, app::NumericsStatus::failed);
  EXPECT_HAS(rows.at(0).note, "broken");
}

}  // namespace
}  // namespace semfield::numerics
