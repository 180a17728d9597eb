// Which semantic branch the labels choose: what is counted of them, where the borders lie, and what a run keeps.
#include "settings/label_choices.h"

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
  EXPECT_EQ(s.apart, 1);  // 2, none, 2 in the second row
  EXPECT_EQ(s.apart_equal, 1);
}

TEST(BranchChoice, KindsHaveTheirBorders) {
  const auto kind = [](std::int64_t labelled, std::int64_t neighbours, std::int64_t equal) {
    return kind_of({1000000, labelled, neighbours, equal});
  };
  const auto sparse = [](std::int64_t labelled, std::int64_t apart, std::int64_t equal) {
    return kind_of({1000000, labelled, 0, 0, apart, equal});
  };
  EXPECT_EQ(sparse(4000, 7500, 5600), LabelKind::many);
  EXPECT_EQ(sparse(4000, 7500, 1200), LabelKind::noisy) << "on a grid, and most of them wrong";
  EXPECT_EQ(sparse(4000, 1000, 0), LabelKind::many) << "too far from each other to tell";
  EXPECT_EQ(sparse(1000, 1900, 0), LabelKind::few) << "clicks: a class each, and so none agrees";
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
  for (const Case& c :
       {Case{"frames: 1, degrade: [{type: propagation, share: 0}]", "one_blob", "few"},
        Case{"degrade: [{type: pixel_noise, ratio: 0.6}]", "frequency", "noisy"},
        Case{"degrade: [{type: super_resolution, factor: 4, mode: sparse}]", "identity", "many"},
        Case{"degrade: [{type: super_resolution, factor: 4, mode: sparse}, {type: pixel_noise, ratio: 0.9}]",
             "frequency", "noisy"},
        Case{"frames: all", "identity", "many"},
        Case{"degrade: [{type: super_resolution, factor: 4, mode: dense}]", "identity", "many"}}) {
    SCOPED_TRACE(c.labels);
    Registry registry = make_registry();
    const Session s = open_text(config_of(kThree, c.labels), registry);
    ASSERT_EQ(s.config.passes[0].semantic.size(), 1U);
    EXPECT_EQ(s.config.passes[0].branch()->position.entry->name, c.position);
    ASSERT_EQ(s.chosen_by_labels.size(), 1U);
    EXPECT_NE(
        s.chosen_by_labels[0].find("passes.main.semantic." +
                                   std::string(c.kind == std::string("many") ? "any" : c.kind) + ": " + c.position),
        std::string::npos);
    EXPECT_NE(s.chosen_by_labels[0].find("labels are " + std::string(c.kind)), std::string::npos);
    EXPECT_NE(describe_session(s).find(s.chosen_by_labels[0]), std::string::npos);
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

TEST(BranchChoice, WhatLabelsCannotShowIsSaid) {
  Registry registry = make_registry();
  const auto said = [&](const LabelStatistics& statistics) {
    Diagnostics diagnostics;
    RunConfig config =
        read_run_config(parse_config_text(config_of(kThree, "frames: all"), "a.yaml"), registry, diagnostics);
    return choose_branches(config, statistics).at(0);
  };
  EXPECT_NE(said({1000, 1000, 1900, 1805}).find("95 % of neighbouring labels agree"), std::string::npos);
  EXPECT_NE(said({1000, 10, 0, 0, 19, 1}).find("5.26 % of labels next to each other within 32 pixels agree"),
            std::string::npos);
  const std::string clicks = said({1000000, 20, 0, 0, 3, 0});
  EXPECT_NE(clicks.find("labels are few (0.002 % of the training pixels have one; too few lie side by side to see "
                        "whether many are wrong"),
            std::string::npos)
      << clicks;
  EXPECT_NE(said({1000, 0, 0, 0}).find("because labels are to come"), std::string::npos);
}

TEST(BranchChoice, NothingIsSaidOfBranchesWithoutLabels) {
  Registry registry = make_registry();
  const Session s = open_text(config_of(kThree, "frames: none"), registry);
  EXPECT_FALSE(s.plan.semantics);
  EXPECT_EQ(s.chosen_by_labels, std::vector<std::string>());
}

TEST(RaySourceChoice, TheLabelsDecideWhereItIsLeftOpen) {
  Registry registry = make_registry();
  const auto opened = [&](const std::string& labels, const std::vector<std::string>& keep = {}) {
    return open_text(config_of("{position: {type: one_blob}, field: {type: tiny_mlp, hidden_width: 8}}", labels) +
                         "train: {rays: 64, ray_source: auto, labelled_share: 0.25}\n",
                     registry, keep);
  };
  struct Case {
    Session s;
    RaySourceKind kind;
    std::string line;
  };
  std::vector<Case> cases;
  cases.push_back({opened("frames: none"), RaySourceKind::all_images,
                   "train.ray_source: all_images was chosen, because no training pixel has a label"});
  cases.push_back(
      {opened("frames: none", {"semantics", "absent_classes"}), RaySourceKind::label_balanced,
       "train.ray_source: label_balanced was chosen, because labels may come; until then rays come from all "
       "pixels"});
  cases.push_back({opened("frames: 1"), RaySourceKind::label_balanced,
                   "of the training pixels have a label; they get 25 % of the rays"});
  cases.push_back({opened("frames: all"), RaySourceKind::label_balanced, "get 25 % of the rays"});
  for (const Case& c : cases) {
    SCOPED_TRACE(c.line);
    EXPECT_EQ(c.s.config.train.ray_source, c.kind);
    ASSERT_EQ(c.s.chosen_by_labels.size(), 1u);
    EXPECT_NE(c.s.chosen_by_labels[0].find(c.line), std::string::npos) << c.s.chosen_by_labels[0];
    const std::string name(ChoiceNames<RaySourceKind>::names[static_cast<std::size_t>(c.kind)]);
    EXPECT_NE(write_config(resolved_config(c.s.config)).find("ray_source: " + name), std::string::npos);
    (void)c.s.make_ray_source();
  }
}

TEST(RaySourceChoice, EvenlyDrawnRaysWarnWhereTheyHardlyMeetALabel) {
  const auto said = [](RaySourceKind kind, std::int64_t labelled) {
    TrainParams train;
    train.ray_source = kind;
    Diagnostics diagnostics;
    warn_of_rare_labels(train, {labelled, 100000, false}, diagnostics);
    return diagnostics.all().empty() ? "" : diagnostics.all()[0].text();
  };
  EXPECT_EQ(
      said(RaySourceKind::all_images, 400),
      "train.ray_source: all_images draws pixels evenly, and 0.4 % of them have a label: about 4.1 of the 1024 rays "
      "of a step see one, so classes are hardly learned; set train.ray_source: auto");
  EXPECT_NE(said(RaySourceKind::one_image, 4999), "");
  EXPECT_EQ(said(RaySourceKind::all_images, 5000), "");
  EXPECT_EQ(said(RaySourceKind::all_images, 0), "");
  EXPECT_EQ(said(RaySourceKind::label_balanced, 400), "");
  EXPECT_EQ(said(RaySourceKind::automatic, 400), "");
}

TEST(RaySourceChoice, RaysThatTeachNoColourAreRefused) {
  const auto errors = [](const std::string& train) {
    Registry registry = make_registry();
    Diagnostics diagnostics;
    const std::string branch_of_all = "{position: {type: one_blob}, field: {type: tiny_mlp, hidden_width: 8}}";
    read_run_config(parse_config_text(config_of(branch_of_all, "frames: all") + "train: {" + train + "}\n", "a.yaml"),
                    registry, diagnostics);
    return diagnostics.all().empty() ? "" : diagnostics.all()[0].text();
  };
  const std::string apart = "labelled_share: 1, label_rays_teach_color: false, ray_source: ";
  const std::string refusal =
      ": train.labelled_share: 1 draws every ray for its label, and label_rays_teach_color is false: nothing would "
      "teach "
      "colour; lower labelled_share, or set train.label_rays_teach_color: true";
  EXPECT_EQ(errors(apart + "label_balanced"), "a.yaml:9:25" + refusal);
  EXPECT_EQ(errors(apart + "auto"), "a.yaml:9:25" + refusal);
  EXPECT_EQ(errors(apart + "all_images"), "");
  EXPECT_EQ(errors("labelled_share: 0.999, label_rays_teach_color: false, ray_source: label_balanced"), "");
}

}  // namespace
}  // namespace semfield
