// Which semantic branch the labels choose, what a run keeps of it, and rays that are drawn for their labels.
#include <numeric>

#include "core/error.h"
#include "session/ray_source.h"
#include "session/settings/choices.h"
#include "tests/session/oracle.h"
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
    FrameInfo info{.split = split};
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
  EXPECT_EQ(kind(1000000, 1990000, 1600000), LabelKind::dense);
  EXPECT_EQ(kind(500000, 990000, 800000), LabelKind::dense);
  EXPECT_EQ(kind(499999, 990000, 800000), LabelKind::many);
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
        Case{"frames: all", "identity", "dense"},
        Case{"degrade: [{type: super_resolution, factor: 4, mode: dense}]", "identity", "dense"}}) {
    SCOPED_TRACE(c.labels);
    Registry registry = make_registry();
    const Session s = open_text(config_of(kThree, c.labels), registry);
    ASSERT_EQ(s.config.passes[0].semantic.size(), 1U);
    EXPECT_EQ(s.config.passes[0].branch()->position.entry->name, c.position);
    ASSERT_EQ(s.chosen_by_labels.size(), 1U);
    EXPECT_HAS(s.chosen_by_labels[0],
               "passes.main.semantic." + std::string(c.position == std::string("identity") ? "any" : c.kind) + ": " +
                   c.position,
               "labels are " + std::string(c.kind));
    EXPECT_HAS(describe_session(s), s.chosen_by_labels[0]);
    // What a run keeps names one branch, and opens as it is whatever the labels are then.
    Diagnostics diagnostics;
    RunConfig again = read_run_config(resolved_config(s.config), registry, diagnostics);
    EXPECT_EQ(diagnostics.error_count(), 0);
    EXPECT_TRUE(choose_branches(again, {1000, 1, 0, 0}).empty());
    EXPECT_EQ(again.passes[0].branch()->position.entry->name, c.position);
  }
}

// Dense labels are many: a branch for many takes them unless an earlier one is for them.
TEST(BranchChoice, DenseLabelsTakeABranchOfTheirOwnOrThatForMany) {
  const auto key_of = [](const std::string& branches) {
    return open_text(config_of("[" + branches + "]", "frames: all")).config.passes[0].branch()->key;
  };
  const std::string noisy_few = branch("noisy", "frequency") + ", " + branch("few", "one_blob") + ", ";
  const std::string dense = branch("dense", "frequency"), many = branch("many", "identity");
  EXPECT_EQ(key_of(noisy_few + dense + ", " + many), "semantic.dense");
  EXPECT_EQ(key_of(noisy_few + dense + ", " + branch("any", "identity")), "semantic.dense");
  EXPECT_EQ(key_of(noisy_few + many), "semantic.many");
  EXPECT_HAS(error_of([&] { open_text(config_of("[" + noisy_few + many + ", " + dense + "]", "frames: all")); }),
             "an earlier branch takes all labels");
  EXPECT_HAS(error_of([&] { open_text(config_of("[" + noisy_few + dense + "]", "frames: all")); }),
             "no branch is for labels: many");
}

TEST(BranchChoice, AListThatLeavesLabelsOutOrNamesThemTwiceIsRefused) {
  const auto refusal = [](const std::string& branches) {
    return error_of([&] { open_text(config_of(branches, "frames: all")); });
  };
  EXPECT_HAS(refusal("[" + branch("few", "one_blob") + ", " + branch("many", "identity") + "]"),
             "passes.main.semantic: no branch is for labels: noisy");
  EXPECT_HAS(refusal("[" + branch("any", "one_blob") + ", " + branch("few", "identity") + "]"),
             "an earlier branch takes all labels");
  EXPECT_HAS(refusal("[" + branch("few", "one_blob") + ", " + branch("few", "identity") + ", " +
                     branch("any", "frequency") + "]"),
             "an earlier branch takes all labels");
  EXPECT_HAS(refusal("[" + branch("some", "one_blob") + "]"), "passes.main.semantic.some");
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
  EXPECT_HAS(said({1000, 1000, 1900, 1805}), "95 % of neighbouring labels agree");
  EXPECT_HAS(said({1000, 10, 0, 0, 19, 1}), "5.26 % of labels next to each other within 32 pixels agree");
  const std::string clicks = said({1000000, 20, 0, 0, 3, 0});
  EXPECT_HAS(clicks,
             "labels are few (0.002 % of the training pixels have one; too few lie side by side to see "
             "whether many are wrong");
  EXPECT_HAS(said({1000, 0, 0, 0}), "because labels are to come");
}

TEST(BranchChoice, NothingIsSaidOfBranchesWithoutLabels) {
  const Session s = open_text(config_of(kThree, "frames: none"));
  EXPECT_FALSE(s.plan.semantics);
  EXPECT_EQ(s.chosen_by_labels, std::vector<std::string>());
}

TEST(RaySourceChoice, TheLabelsDecideWhereItIsLeftOpen) {
  const auto opened = [&](const std::string& labels, const std::vector<std::string>& keep = {}) {
    return open_text(config_of("{position: {type: one_blob}, field: {type: tiny_mlp, hidden_width: 8}}", labels) +
                         "train: {rays: 64, ray_source: auto, labelled_share: 0.25}\n",
                     keep);
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
    EXPECT_HAS(c.s.chosen_by_labels[0], c.line);
    const std::string name(ChoiceNames<RaySourceKind>::names[static_cast<std::size_t>(c.kind)]);
    EXPECT_HAS(write_config(resolved_config(c.s.config)), "ray_source: " + name);
    (void)c.s.make_ray_source();
  }
}

TEST(RaySourceChoice, EvenlyDrawnRaysWarnWhereTheyHardlyMeetALabel) {
  const auto said = [](RaySourceKind kind, std::int64_t labelled) {
    TrainParams train{.ray_source = kind};
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

// Rays that are drawn for their labels and teach no colour: where they stand in a batch, and what the losses and
// gradients make of them.

// With a branch of the position alone, so labels shape nothing else.
std::string label_config(const std::string& train, const std::string& more = "") {
  return stratified_config(
      "type: analytic_room, labels: {frames: 1}",
      "    semantic: {position: {type: one_blob}, field: {type: tiny_mlp, hidden_width: 8}, reads_feature: false}\n",
      "rays: 26, ray_source: label_balanced, " + train, more);
}
const std::string kApart = "labelled_share: 0.3, label_rays_teach_color: false";

TEST(LabelRays, StandFirstInEveryTileAndAreCountedAlikeForAnyTiles) {
  EXPECT_EQ(label_only_rays(0, 0, 1000), 0);
  EXPECT_EQ(label_only_rays(1, 0, 1000), 1000);
  EXPECT_EQ(label_only_rays(0.3, 0, 26), 7);
  EXPECT_EQ(label_only_rays(0.3, 0, 10) + label_only_rays(0.3, 10, 20) + label_only_rays(0.3, 20, 26), 7);

  Registry registry = make_registry();
  for (const int tile_rays : {26, 8, 5, 1}) {
    SCOPED_TRACE(tile_rays);
    const std::string tiles = "runtime: {tile_rays: " + std::to_string(tile_rays) + "}\n";
    const Oracle apart(label_config(kApart, tiles), registry),
        together(label_config("labelled_share: 0.3", tiles), registry);
    const std::vector<std::int64_t>& apart_of_tile = apart.batch.label_only;
    EXPECT_EQ(std::accumulate(apart_of_tile.begin(), apart_of_tile.end(), std::int64_t{0}), 7);
    EXPECT_TRUE(together.batch.label_only.empty());
    std::int64_t labelled = 0;
    for (std::int64_t begin = 0; begin < 26; begin += tile_rays) {
      const std::int64_t end = std::min<std::int64_t>(begin + tile_rays, 26);
      const std::int64_t first = label_only_rays(0.3, begin, end);
      for (std::int64_t row = begin; row < begin + first; ++row) EXPECT_NE(apart.batch.label[row], kVoid) << row;
      // The same rays as without, in another order at most.
      std::vector<float> with(apart.batch.target.begin() + 3 * begin, apart.batch.target.begin() + 3 * end);
      std::vector<float> without(together.batch.target.begin() + 3 * begin, together.batch.target.begin() + 3 * end);
      std::sort(with.begin(), with.end());
      std::sort(without.begin(), without.end());
      EXPECT_EQ(with, without);
      labelled += first;
    }
    EXPECT_EQ(labelled, 7);
    // A message about a row names the pixel that stands there.
    std::vector<std::string> places;
    for (std::int64_t row = 0; row < 26; ++row) places.push_back(apart.rays->place_of_row(3, row));
    std::vector<std::string> others;
    for (std::int64_t row = 0; row < 26; ++row) others.push_back(together.rays->place_of_row(3, row));
    std::sort(places.begin(), places.end());
    std::sort(others.begin(), others.end());
    EXPECT_EQ(places, others);
  }
}

TEST(LabelRays, TheirColoursCountForNothing) {
  Registry registry = make_registry();
  Oracle oracle(label_config(kApart, "runtime: {tile_rays: 13}\n"), registry);
  const StepLosses before = oracle.gradients();
  EXPECT_GT(before.color, 0);
  EXPECT_GT(before.semantic, 0);
  std::int64_t moved = 0;
  for (std::int64_t row = 0; row < 26; ++row) {
    const bool label_only = row % 13 < label_only_rays(0.3, row / 13 * 13, row / 13 * 13 + 13);
    BatchBuffers changed = oracle.batch;
    changed.target[3 * row] = 1 - changed.target[3 * row];
    std::swap(changed, oracle.batch);
    const StepLosses after = oracle.gradients();
    std::swap(changed, oracle.batch);
    EXPECT_EQ(after.semantic, before.semantic);
    if (label_only) {
      EXPECT_EQ(after.color, before.color) << row;
    } else {
      moved += after.color != before.color ? 1 : 0;
    }
  }
  EXPECT_EQ(moved, 19);
}

// The second difference of a squared error by its target is 2 over what the sum is divided by, whatever was rendered.
TEST(LabelRays, TheColourLossIsTheMeanOverTheOthers) {
  constexpr float kStep = 0.25F;
  Registry registry = make_registry();
  for (const auto& [train, counted] : {std::pair{kApart, 19}, std::pair{std::string("labelled_share: 0.3"), 26}}) {
    Oracle oracle(label_config(train), registry);
    float& target = oracle.batch.target.back();  // of an evenly drawn ray
    const float kept = target;
    const double at = oracle.gradients().color;
    target = kept + kStep;
    const double above = oracle.gradients().color;
    target = kept - kStep;
    const double below = oracle.gradients().color;
    EXPECT_NEAR(above + below - 2 * at, 2 * double{kStep} * double{kStep} / (3 * counted), 1e-9) << train;
  }
}

TEST(LabelRays, GradientsAreThoseOfFiniteDifferencesAndOfAnyTiles) {
  std::string shared = label_config(kApart);  // the head behind the pass's own field: labels shape all of it
  const std::size_t branch = shared.find("    semantic: {");
  shared.erase(branch, shared.find('\n', branch) + 1 - branch);
  expect_finite_differences(shared, 2e-4);
  expect_same_gradients(label_config(kApart, "runtime: {lanes: 1, tile_rays: 26}\n"),
                        label_config(kApart, "runtime: {lanes: 3, tile_rays: 26}\n"));
}

}  // namespace
}  // namespace semfield
