// Every bitwise and certified leave-out pair on a small room, and the page that is made of what pairs find.
#include <fcntl.h>
#include <sys/mman.h>
#include <unistd.h>

#include <algorithm>
#include <filesystem>

#include "core/error.h"
#include "datasets/obj_room/raycast.h"
#include "plugin/linked_plugins.h"
#include "run/leave_out_proofs.h"
#include "studies/leave_out_page.h"
#include "studies/leave_out_side.h"
#include "system/files.h"
#include "tests/says.h"

namespace semfield {
namespace {

std::string in_source(const std::string& file) { return std::string(SEMFIELD_SOURCE_DIR) + "/" + file; }

// Statistical pairs need seeds and minutes: `semfield-study pairs`.
std::vector<LeaveOutPair> quick_pairs() {
  std::vector<LeaveOutPair> out;
  for (const LeaveOutPair& pair : leave_out_pairs()) {
    if (pair.kind != PairKind::quality && pair.name != "empty_space_lagging") out.push_back(pair);
  }
  return out;
}

class Pairs : public testing::TestWithParam<LeaveOutPair> {};

TEST_P(Pairs, Holds) {
  if (!raycast_available()) GTEST_SKIP() << "this build reads no meshes, so the shipped room is not at hand";
  Registry registry;
  register_linked_plugins(registry);
  LeaveOutPair pair = GetParam();
  pair.steps = std::min(pair.steps, 40);
  PairOptions options{
      .set = {"scene.frames=10", "scene.test_frames=2", "scene.width_px=40", "scene.height_px=30", "train.rays=96"},
      .rounds = 2,
      .steps_a_round = 4,
      .frames = 1};
  const PairResult result = run_pair(pair, options, registry, in_source);
  if (pair.kind == PairKind::library && result.result == "this build has none") GTEST_SKIP() << result.result;
  EXPECT_TRUE(result.holds) << result.result;
  EXPECT_TRUE(!result.idle || pair.name == "late_samples_room") << result.result;
  EXPECT_GT(result.cost.kept_s, 0);
  RecordProperty("result", result.result);
}

INSTANTIATE_TEST_SUITE_P(LeaveOut, Pairs, testing::ValuesIn(quick_pairs()),
                         [](const auto& param) { return param.param.name; });

const char* const kEmptyPage =
    "# A title\n\n<!-- study pairs: measured begin --><!-- study pairs: measured end -->\n\nWords between.\n\n"
    "<!-- study pairs: left out begin -->\nold\n<!-- study pairs: left out end -->\n"
    "<!-- study pairs: kept begin --><!-- study pairs: kept end -->\n";

LeaveOutFindings two_findings() {
  return LeaveOutFindings{
      .about = "a machine",
      .rows = {{"undistortion", "undistortion", "a rule", "B", "`--keep`", "", true, "hash", "1 % of a step"},
               {"semantics", "semantics", "a | rule", "B", "`--keep`", "", false, "hash", "2 % of a step"}}};
}

TEST(LeaveOutPage, TheTableSurvivesWritingAndMerging) {
  const LeaveOutFindings f = two_findings();
  const LeaveOutFindings read = parse_findings(findings_json(f), "leave_out.json");
  EXPECT_EQ(read.about, f.about);
  ASSERT_EQ(read.rows.size(), 2U);
  EXPECT_EQ(read.rows[0].saving, "1 % of a step");
  EXPECT_FALSE(read.rows[1].holds);
  LeaveOutFindings fresh = two_findings();
  fresh.rows.erase(fresh.rows.begin());
  fresh.rows[0].result = "anew";
  const LeaveOutFindings both = merged(f, fresh);
  ASSERT_EQ(both.rows.size(), 2U);
  EXPECT_EQ(both.rows[0].name, "semantics") << "in the order of the pairs";
  EXPECT_EQ(both.rows[0].result, "anew");
  EXPECT_EQ(both.rows[1].result, "hash");
  EXPECT_THROW(parse_findings("[]", "leave_out.json"), Error);
  EXPECT_THROW(parse_findings("{\"about\": 1, \"rows\": []}", "leave_out.json"), Error);
  const std::string page = with_findings(kEmptyPage, f, "leave_out.md");
  EXPECT_HAS(page, "a \\| rule") << "a bar would end the cell";
  EXPECT_HAS(page, "**does not hold**");
}

TEST(LeaveOutPage, WordsStayAndTablesAreReplaced) {
  const LeaveOutFindings f = two_findings();
  const std::string once = with_findings(kEmptyPage, f, "leave_out.md");
  EXPECT_EQ(with_findings(once, f, "leave_out.md"), once);
  EXPECT_EQ(once.rfind("# A title", 0), 0U);
  EXPECT_HAS(once, "Words between.\n", "a machine");
  LeaveOutFindings fewer = f;
  fewer.rows.erase(fewer.rows.begin());
  const std::string twice = with_findings(once, fewer, "leave_out.md");
  EXPECT_LACKS(twice, "`undistortion`");
  EXPECT_HAS(error_of(ErrorKind::data, [&] { with_findings("# A title\n", f, "folder/leave_out.md"); }),
             "folder/leave_out.md", "<!-- study pairs: measured begin -->");
}

TEST(LeaveOutPage, ASavingBelowItsNoiseIsSaidToBeNone) {
  PairCost cost{.of = "step", .out_s = 1e-3, .kept_s = 1.01e-3, .share = 0.01, .noise = 0.02};
  EXPECT_EQ(saving_text(cost), "no more than its noise: +1.0 ± 2.0 % of a step (1 ms)");
  cost.noise = 0.002;
  cost.kept_bytes = 2000000;
  EXPECT_EQ(saving_text(cost), "1.0 ± 0.2 % of a step (1 ms against 1.01 ms), 2.0 MB");
}

// What the library has of the table, of the last row of each component, is what the table in docs/ says.
TEST(LeaveOutPage, TheLibraryHasTheShippedTable) {
  const std::string json = in_source("docs/reference/leave_out.json");
  std::map<std::string, std::string> last;
  for (const LeaveOutFinding& row : parse_findings(read_text_file(json), json).rows) last[row.component] = row.saving;
  last.erase("");
  EXPECT_GE(last.size(), 10U);
  for (const auto& [component, saving] : last)
    EXPECT_EQ(shipped_saving(component), saving + "; of docs/reference/leave_out.md, not of this run");
  EXPECT_EQ(shipped_saving("no such component"), "");
}

TEST(LeaveOutPage, AFileIsSeenWhileItIsMapped) {
  const std::string name = "mapped_by_a_test_" + std::to_string(::getpid());
  const std::string path = testing::TempDir() + "/" + name;
  write_file_atomic(path, "a page");
  EXPECT_FALSE(is_mapped(name)) << "it is there, and not mapped";
  const int file = ::open(path.c_str(), O_RDONLY | O_CLOEXEC);
  ASSERT_GE(file, 0);
  void* const page = ::mmap(nullptr, 6, PROT_READ, MAP_PRIVATE, file, 0);
  ::close(file);
  ASSERT_NE(page, MAP_FAILED);
  EXPECT_TRUE(is_mapped(name));
  ::munmap(page, 6);
  EXPECT_FALSE(is_mapped(name));
  std::filesystem::remove(path);
}

}  // namespace
}  // namespace semfield
