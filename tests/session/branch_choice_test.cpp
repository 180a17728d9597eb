// Which semantic branch the labels choose: what is counted of them, where the borders lie, and what a run keeps.
#include "session/branch_choice.h"

#include <gtest/gtest.h>

#include <string>
#include <vector>

#include "core/error.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

std::string config_of(const std::string& branches, const std::string& labels) {
  return "scene: {type: analytic_room, labels: {" + labels +
         "}}\n"
         "semantics: {hidden_width: 8}\n"
         "passes:\n"
         "  - name: main\n"
         "    sampler: {type: stratified, samples: 8}\n"
         "    position: {type: hash_grid, levels: 3, log2_entries: 8, finest_resolution: 32}\n"
         "    field: {type: tiny_mlp, hidden_width: 8, color_width: 8}\n"
         "    semantic: " +
         branches + "\n";
}
std::string branch(const std::string& labels, const std::string& position) {
  return "{labels: " + labels + ", position: {type: " + position + "}, field: {type: tiny_mlp, hidden_width: 8}}";
}
const std::string kThree =
    "[" + branch("noisy", "frequency") + ", " + branch("few", "one_blob") + ", " + branch("any", "identity") + "]";

LoadedScene frames_of(std::int32_t width_px, std::int32_t height_px, std::vector<Split> splits) {
  LoadedScene scene;
  for (const Split split : splits) {
    FrameInfo info;
    info.split = split;
    scene.info.frames.push_back(info);
    StoredFrame frame;
    frame.width_px = width_px;
    frame.height_px = height_px;
    scene.frames.push_back(frame);
  }
  return scene;
}

// Two rows of three pixels: pairs beside and above one another, void in none, the end of a row is no neighbour of the
// next one's start.
TEST(BranchChoice, CountsLabelledPixelsAndNeighboursThatAgree) {
  const LoadedScene scene = frames_of(3, 2, {Split::train, Split::train, Split::test});
  TrainingLabels labels;
  labels.frames.resize(3);
  labels.frames[0].hard = LabelMap({1, 1, 2, 2, kVoid, 2});
  labels.frames[2].hard = LabelMap({0, 1, 0, 1, 0, 1});
  const LabelStatistics s = label_statistics(scene, labels);
  EXPECT_EQ(s.pixels, 12);
  EXPECT_EQ(s.labelled, 5);
  EXPECT_EQ(s.neighbours, 4);  // 1-1, 1-2 in the first row; 1 above 2, 2 above 2
  EXPECT_EQ(s.equal, 2);
  EXPECT_DOUBLE_EQ(s.share(), 5.0 / 12);
  EXPECT_DOUBLE_EQ(s.agreement(), 0.5);
}

TEST(BranchChoice, KindsHaveTheirBorders) {
  const auto kind = [](std::int64_t labelled, std::int64_t neighbours, std::int64_t equal) {
    return kind_of({1000000, labelled, neighbours, equal});
  };
  EXPECT_EQ(kind(1000000, 1990000, 1600000), LabelKind::many);
  EXPECT_EQ(kind(1000000, 1990000, 1580000), LabelKind::noisy);
  EXPECT_EQ(kind(1999, 0, 0), LabelKind::few);
  EXPECT_EQ(kind(2000, 0, 0), LabelKind::many);
  EXPECT_EQ(kind(1000, 1600, 1000), LabelKind::noisy) << "few and seen to be wrong";
  EXPECT_EQ(kind(1000, 400, 100), LabelKind::few) << "too few neighbours to tell";
  EXPECT_EQ(kind_of({}), LabelKind::few);
}

TEST(BranchChoice, ASessionBuildsTheBranchForItsLabelsAndSaysSo) {
  struct Case {
    const char *labels, *position, *kind;
  };
  for (const Case& c : {Case{"frames: 1, degrade: [{type: propagation, share: 0}]", "one_blob", "few"},
                        Case{"degrade: [{type: pixel_noise, ratio: 0.6}]", "frequency", "noisy"},
                        Case{"frames: all", "identity", "many"},
                        Case{"degrade: [{type: super_resolution, factor: 4, mode: dense}]", "identity", "many"}}) {
    SCOPED_TRACE(c.labels);
    Registry registry = make_registry();
    const Session s = open_text(config_of(kThree, c.labels), registry);
    ASSERT_EQ(s.config.passes[0].semantic.size(), 1U);
    EXPECT_EQ(s.config.passes[0].branch()->position.entry->name, c.position);
    ASSERT_EQ(s.chosen_branches.size(), 1U);
    EXPECT_NE(
        s.chosen_branches[0].find("passes.main.semantic." +
                                  std::string(c.kind == std::string("many") ? "any" : c.kind) + ": " + c.position),
        std::string::npos);
    EXPECT_NE(s.chosen_branches[0].find("labels are " + std::string(c.kind)), std::string::npos);
    EXPECT_NE(describe_session(s).find(s.chosen_branches[0]), std::string::npos);
    // What a run keeps names one branch, and opens as it is whatever the labels are then.
    Diagnostics diagnostics;
    RunConfig again = read_run_config(resolved_config(s.config), registry, diagnostics);
    EXPECT_EQ(diagnostics.error_count(), 0);
    EXPECT_TRUE(choose_branches(again, {1000, 1, 0, 0}).empty());
    EXPECT_EQ(again.passes[0].branch()->position.entry->name, c.position);
  }
}

TEST(BranchChoice, AListThatLeavesLabelsOutOrNamesThemTwiceIsRefused) {
  const auto refusal = [](const std::string& branches) {
    Registry registry = make_registry();
    try {
      open_text(config_of(branches, "frames: all"), registry);
    } catch (const Error& error) {
      return std::string(error.what());
    }
    return std::string();
  };
  EXPECT_NE(refusal("[" + branch("few", "one_blob") + ", " + branch("many", "identity") + "]")
                .find("passes.main.semantic: no branch is for labels: noisy"),
            std::string::npos);
  EXPECT_NE(refusal("[" + branch("any", "one_blob") + ", " + branch("few", "identity") + "]")
                .find("an earlier branch takes all labels"),
            std::string::npos);
  EXPECT_NE(refusal("[" + branch("few", "one_blob") + ", " + branch("few", "identity") + ", " +
                    branch("any", "frequency") + "]")
                .find("an earlier branch takes all labels"),
            std::string::npos);
  EXPECT_NE(refusal("[" + branch("some", "one_blob") + "]").find("passes.main.semantic.some"), std::string::npos);
  EXPECT_EQ(refusal(kThree), "");
}

}  // namespace
}  // namespace semfield
