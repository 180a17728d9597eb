// A network of its own for semantics: gradients, what it leaves alone, what leaving samples out may change, its
// settings.

#include <algorithm>
#include <cmath>
#include <numeric>

#include "config/settings/choices.h"
#include "eval/evaluator.h"
#include "tests/session/oracle.h"
#include "train/assembly.h"
#include "train/ray_source.h"
#include "train/trainer.h"

namespace semfield {
namespace {

using namespace testing_train;

// `branch` is the body of the pass's section `semantic`, "" for none.
std::string config_of(const std::string& branch, const std::string& more = "") {
  return stratified_config("type: analytic_room", branch.empty() ? "" : "    semantic: {" + branch + "}\n", "rays: 24",
                           more);
}
const std::string kPlugins =
    "position: {type: frequency, frequencies: 3}, field: {type: tiny_mlp, hidden_width: 12, hidden_layers: 2}";

// Every learned tensor of `some` is in `all`, with the bits of its gradient.
void expect_gradients_of(const Oracle& some, const Oracle& all) {
  int compared = 0;
  for (const Tensor<double>& t : some.pipeline->store().all()) {
    if (!t.learned()) continue;
    const Tensor<double>* other = all.pipeline->store().find(t.name);
    ASSERT_NE(other, nullptr) << t.name;
    ASSERT_TRUE(std::equal(t.grad.data(), t.grad.data() + t.size(), other->grad.data())) << t.name;
    ++compared;
  }
  EXPECT_GT(compared, 8);
}

// Of the tensors of branch and head: weights are constants to them, and so is which samples are left out.
TEST(HeadBranch, GradientsAreThoseOfFiniteDifferences) {
  for (const char* more : {"", ", reads_feature: false", ", dropout: 0.3", ", least_weight: 0.02"}) {
    SCOPED_TRACE(more);
    expect_finite_differences(config_of(kPlugins + more), 2e-4, "/semantic",
                              8 * 3);  // two layers of branch and of head
  }
}

TEST(HeadBranch, TilesLanesAndTheDeferredClassLayerChangeNoGradient) {
  for (const char* more : {"", ", dropout: 0.25", ", least_weight: 0.05"}) {
    expect_same_gradients(config_of(kPlugins + more, "runtime: {lanes: 1, tile_rays: 24}\n"),
                          config_of(kPlugins + more, "runtime: {lanes: 3, tile_rays: 4}\n"));
    expect_same_gradients(config_of(kPlugins + more),
                          config_of(kPlugins + more, "runtime: {deferred_class_layer: false}\n"));
  }
}

// Colour and geometry learn as they do in a scene without labels, to the last bit.
TEST(HeadBranch, LabelsDoNotShapeTheField) {
  Oracle labelled(config_of(kPlugins));
  Oracle unlabelled(with_scene(config_of(kPlugins), "{type: analytic_room, with_labels: false}"));
  ASSERT_FALSE(unlabelled.pipeline->has_semantics());
  EXPECT_GT(labelled.gradients().semantic, 0);
  unlabelled.gradients();
  expect_gradients_of(unlabelled, labelled);
}

// |change of a logit| <= sum of the weights left out times the largest logit of a sample.
TEST(HeadBranch, LeavingSamplesOutChangesLogitsWithinTheBound) {
  const std::string off = "runtime: {deferred_class_layer: false, tile_rays: 24, lanes: 1}\n";
  Oracle all(config_of(kPlugins + ", least_weight: 0", off));
  const auto trace_of = [](Oracle& o, Workspace& arena) {
    StepContext ctx{.workspace = &arena};
    const RayBatch batch = o.batch.view(true);
    return o.pipeline->passes()[0].forward(ctx, 0, {batch.origin, batch.direction, batch.near_far}, nullptr, 0,
                                           {batch.origin.rows});
  };
  Workspace arena_all;
  const PassTrace<double> a = trace_of(all, arena_all);
  std::vector<double> weights(a.weight.data, a.weight.data + a.samples.count);
  std::sort(weights.begin(), weights.end());
  std::int64_t before = 0;
  for (const std::size_t part : {8, 4, 2}) {
    const double least = weights[weights.size() / part];
    ASSERT_LT(least, 0.1);
    Oracle some(config_of(kPlugins + ", least_weight: " + std::to_string(least), off));
    Workspace arena_some;
    const PassTrace<double> b = trace_of(some, arena_some);
    double largest = 0;
    for (std::int64_t k = 0; k < a.semantic.sample_rows.rows; ++k) {
      for (std::int32_t c = 0; c < a.semantic.sample_rows.cols; ++c)
        largest = std::max(largest, std::abs(a.semantic.sample_rows(k, c)));
    }
    double moved = 0;
    for (std::int64_t r = 0; r < a.semantic.rows.rows; ++r) {
      const double left_out = a.semantic.branch.share(r, 0) - b.semantic.branch.share(r, 0);
      EXPECT_GE(left_out, -1e-15);
      for (std::int32_t c = 0; c < a.semantic.rows.cols; ++c) {
        const double change = std::abs(a.semantic.rows(r, c) - b.semantic.rows(r, c));
        EXPECT_LE(change, left_out * largest + 1e-12);
        moved = std::max(moved, change);
      }
    }
    EXPECT_GT(moved, 0);
    const std::int64_t left = a.semantic.branch.samples.count - b.semantic.branch.samples.count;
    EXPECT_GT(left, before) << "samples of weight below " << least;
    before = left;
    EXPECT_GT(b.semantic.branch.samples.count, 0);
  }
}

// One step from the same values: its tensors move by the factor, and lose their part first; all others move alike.
TEST(HeadBranch, ItsRateAndDecayHoldForBranchAndHeadAlone) {
  const auto stepped = [](const std::string& more, std::vector<float>& before, std::vector<float>& after,
                          std::vector<bool>& semantic) {
    TestRun run(config_of(kPlugins + more));
    const auto copy = [&](std::vector<float>& to) {
      for (const Tensor<float>& t : run.store().all())
        if (t.spec.role == TensorRole::dense) to.insert(to.end(), t.value.data(), t.value.data() + t.size());
    };
    for (const Tensor<float>& t : run.store().all()) {
      if (t.spec.role == TensorRole::dense)
        semantic.insert(semantic.end(), static_cast<std::size_t>(t.size()), t.rule.semantic);
    }
    copy(before);
    run.to(1);
    copy(after);
    return run.session.config.adam.learning_rate;
  };
  std::vector<float> start, plain, start_own, own;
  std::vector<bool> semantic, same;
  stepped("", start, plain, semantic);
  const double rate = stepped(", learning_rate: 0.25, weight_decay: 8", start_own, own, same);
  ASSERT_EQ(start, start_own);
  int moved = 0;
  for (std::size_t i = 0; i < start.size(); ++i) {
    if (!semantic[i]) {
      ASSERT_EQ(own[i], plain[i]) << i;
      continue;
    }
    const double was = static_cast<double>(start[i]), step = static_cast<double>(plain[i]) - was;
    ASSERT_NEAR(own[i], was * (1 - rate * 0.25 * 8) + 0.25 * step, 1e-6) << i;
    moved += std::abs(step) > 1e-5 ? 1 : 0;
  }
  EXPECT_GT(moved, 100);
}

// What is wrong in the section is said with the key that is wrong.
TEST(HeadBranch, WrongSettingsAreNamed) {
  const auto refusal = [](const std::string& branch) { return error_of([&] { open_text(config_of(branch)); }); };
  EXPECT_HAS(refusal("field: {type: tiny_mlp}"), "passes.0.semantic: key 'position' is missing");
  EXPECT_HAS(refusal("position: {type: frequency}"), "passes.0.semantic: key 'field' is missing");
  EXPECT_HAS(refusal(kPlugins + ", least_wieght: 0.1"), "least_weight");
  EXPECT_HAS(refusal(kPlugins + ", dropout: 1"), "dropout");
  EXPECT_HAS(refusal("position: {type: hash_grid}, field: {type: tiny_mlp}"), "learned tensors");
  EXPECT_HAS(refusal("position: {type: spherical_harmonics}, field: {type: tiny_mlp}"), "semantic.position");
  EXPECT_EQ(refusal(kPlugins), "");
}

// Heads beside that of class logits: gradients, what they leave alone, principal axes, settings, and what is left out.

const std::string kBranch =
    "branch: {position: {type: frequency, frequencies: 3}, field: {type: tiny_mlp, hidden_width: 12, hidden_layers: 2}";

std::string head_yaml(const std::string& of_head = "", const std::string& of_branch = "") {
  return "heads:\n  - {type: feature_map, channel: albedo, hidden_width: 11" + of_head + ", " + kBranch + of_branch +
         "}}\nlosses: [{type: cosine_distance, channel: albedo, weight: 0.7}]\n";
}

// The dataset offers `albedo`, three columns.
std::string head_config_of(const std::string& more, const std::string& of_pass = "") {
  return stratified_config("type: analytic_room, with_albedo: true", of_pass, "rays: 24", more);
}
const std::string kSemanticBranch =
    "    semantic: {position: {type: frequency, frequencies: 2}, field: {type: tiny_mlp}}\n";

TEST(Heads, GradientsAreThoseOfFiniteDifferences) {
  for (const char* of_branch : {"", ", reads_feature: true", ", dropout: 0.3", ", least_weight: 0.02"}) {
    SCOPED_TRACE(of_branch);
    Oracle oracle(head_config_of(head_yaml("", of_branch)), channel_plugins());
    expect_finite_differences(oracle, 2e-4, "/heads/albedo", 8 * 3);  // two layers of branch and of head
  }
}

// With a semantic branch or without one: colour, geometry and class logits learn as they do alone, to the last bit.
TEST(Heads, ChangeNoOtherGradient) {
  for (const std::string& of_pass : {std::string(), kSemanticBranch}) {
    for (const std::string of_branch : {"", ", reads_feature: true"}) {
      Oracle with(head_config_of(head_yaml("", of_branch), of_pass), channel_plugins()),
          without(head_config_of("", of_pass), channel_plugins());
      const StepLosses a = with.gradients(), b = without.gradients();
      EXPECT_EQ(a.color, b.color);
      EXPECT_EQ(a.semantic, b.semantic);
      EXPECT_GT(a.terms[0], 0);
      expect_gradients_of(without, with);
    }
  }
}

TEST(Heads, TilesAndLanesChangeNoGradient) {
  expect_same_gradients(head_config_of(head_yaml() + "runtime: {lanes: 1, tile_rays: 24}\n"),
                        head_config_of(head_yaml() + "runtime: {lanes: 3, tile_rays: 4}\n"));
}

const FrameOptions kOfAlbedo{.channels = {"albedo"}};

double mean_cosine(const FrameChannel& map, const std::vector<float>& rgb) {
  double sum = 0;
  const std::int64_t cells = std::int64_t{map.height} * map.width;
  for (std::int64_t i = 0; i < cells; ++i) {
    double dot = 0, a = 0, b = 0;
    for (std::int64_t c = 3 * i; c < 3 * i + 3; ++c) {
      const double x = map.values[static_cast<std::size_t>(c)], y = rgb[static_cast<std::size_t>(c)];
      dot += x * y, a += x * x, b += y * y;
    }
    sum += dot / std::sqrt(std::max(a * b, 1e-30));
  }
  return sum / static_cast<double>(cells);
}

// The channel is the colour of every second row: what the head renders points where the colours do.
TEST(Heads, LearnTheChannelAndRenderIt) {
  std::string yaml = replaced(replaced(hash_config(head_yaml("", ", learning_rate: 0.3")), "type: analytic_room",
                                       "type: analytic_room, with_albedo: true"),
                              "hidden_width: 12", "hidden_width: 32");
  TestRun run(yaml, channel_plugins());
  const Session& session = run.session;
  const double first = run.to(1).terms[0];
  EXPECT_LT(run.to(200).terms[0], 0.5 * first);
  const int test = session.scene.frames_of(Split::test).front();
  const RenderedFrame frame = render_frame_of(session, test, kOfAlbedo);
  ASSERT_EQ(frame.channels.size(), 1U);
  EXPECT_EQ(frame.channels[0].cols, 3);
  std::vector<float> truth;
  for (const std::uint8_t value : session.scene.frames[static_cast<std::size_t>(test)].rgb)
    truth.push_back(static_cast<float>(value) / 255);
  FrameChannel gray = frame.channels[0];
  std::fill(gray.values.begin(), gray.values.end(), 1.0F);
  EXPECT_LT(1 - mean_cosine(frame.channels[0], truth), 0.5 * (1 - mean_cosine(gray, truth)));
}

TEST(Heads, AChannelThatIsNotFiniteIsNamed) {
  Session session = open_text(head_config_of(head_yaml()), channel_plugins());
  Tensor<float>* bias = session.pipeline->store().find("main/heads/albedo/output/bias");
  ASSERT_NE(bias, nullptr);
  bias->value.data()[1] = std::numeric_limits<float>::quiet_NaN();
  session.pipeline->executor().upload(0);
  EXPECT_HAS(error_of([&] { (void)render_frame_of(session, 0, kOfAlbedo); }), "channel of a head");
}

TEST(ChannelAxes, KeepWhatTheRowsHaveMostOf) {
  // Rows (a, 0, b, 0, 0) with a well above b.
  FrameChannel map{"wide", 4, 5, 5, std::vector<float>(100, 0)};
  for (std::size_t i = 0; i < 20; ++i) {
    map.values[5 * i] = 3 + 0.1F * static_cast<float>(i % 3);
    map.values[5 * i + 2] = (i % 2 == 0 ? 1.0F : -1.0F);
  }
  std::fill_n(map.values.begin() + 5 * 7, 5, 0.0F);
  const FrameChannel before = map;
  const std::vector<float> axes = principal_axes({&map}, 2);
  const View<const float> matrix(axes.data(), 5, 2);
  EXPECT_NEAR(matrix(0, 0), 1, 0.02) << "the largest is positive";
  EXPECT_NEAR(std::abs(matrix(2, 1)), 1, 0.02);
  multiply_rows(map, matrix);
  EXPECT_EQ(map.cols, 2);
  for (std::size_t i = 0; i < 20; ++i) {
    double wide = 0, narrow = 0;
    for (std::size_t c = 0; c < 5; ++c) wide += std::pow(static_cast<double>(before.values[5 * i + c]), 2);
    for (std::size_t c = 0; c < 2; ++c) narrow += std::pow(static_cast<double>(map.values[2 * i + c]), 2);
    EXPECT_NEAR(narrow, wide, 1e-4) << i << ": all of it lies on two axes, and a row of zeros stays one";
  }
}

TEST(ChannelAxes, AChannelOfZerosIsNamed) {
  const FrameChannel map{"empty", 2, 2, 3, std::vector<float>(12, 0)};
  EXPECT_HAS(error_of([&] { (void)principal_axes({&map}, 2); }), "'empty'");
}

// The axes are state: a session that goes on takes those of the checkpoint, and its frames with them.
TEST(ChannelAxes, GoWithTheCheckpoint) {
  const std::string yaml = head_config_of(head_yaml(", width: 2"));
  const auto opened = [&] { return open_text(yaml, channel_plugins()); };
  Session first = opened();
  ASSERT_EQ(first.config.heads[0].source_width, 3);
  const std::vector<std::vector<float>> axes = axes_of(first);
  ASSERT_EQ(axes[0].size(), 6U);
  Session other = opened();
  const auto channel_of = [](Session& s) -> FrameChannel& {
    return s.scene.frames[static_cast<std::size_t>(s.scene.frames_of(Split::train).front())].channels[0];
  };
  EXPECT_EQ(channel_of(other).cols, 2);
  // The same span by turned axes, as another machine may find it.
  const View<float> now = other.pipeline->passes().back().axes("albedo");
  for (std::int64_t d = 0; d < 3; ++d) {
    const float a = now(d, 0), b = now(d, 1);
    now(d, 0) = 0.6F * a - 0.8F * b;
    now(d, 1) = 0.8F * a + 0.6F * b;
  }
  const std::vector<float> before = channel_of(other).values;
  follow_axes(other, axes);
  const std::vector<float>& after = channel_of(other).values;
  for (std::size_t i = 0; i + 1 < after.size(); i += 2) {
    EXPECT_NEAR(after[i], 0.6F * before[i] - 0.8F * before[i + 1], 1e-5);
    EXPECT_NEAR(after[i + 1], 0.8F * before[i] + 0.6F * before[i + 1], 1e-5);
  }
}

TEST(Heads, WrongSettingsAreNamed) {
  const auto expect = [&](const std::string& more, const std::string& said) {
    EXPECT_HAS(error_of([&] { (void)open_text(head_config_of(more), channel_plugins()); }), said);
  };
  const auto map = [](const std::string& keys) { return "{type: feature_map, " + keys + kBranch + "}}"; };
  const auto heads = [](const std::string& list) { return "heads: [" + list + "]\n"; };
  const std::string head = map("channel: albedo, ");
  expect("heads: {type: feature_map}\n", "heads: expected a list of heads");
  expect(heads("{type: feature_map, channel: albedo}"), "heads.0: key 'branch' is missing");
  expect(heads("{type: feature_mpa, channel: albedo}"), "did you mean 'feature_map'?");
  expect(heads(map("chanel: albedo, ")), "did you mean 'channel'?");
  expect(heads(map("")), "heads.0.channel: the head names no channel");
  expect(heads(map("channel: depth, ")), "'depth' is a channel of the framework");
  expect(heads(map("channel: A-B, ")), "'A-B' cannot name a channel");
  expect(heads(head + ", " + head), "heads.1.channel: 'albedo' is made by heads.0 already");
  expect("losses: [{type: cosine_distance, channel: clip}]\n", "reads the channel 'clip', which no head makes");
  expect(head_yaml(", width: 4"), "heads.0.width: 4 columns are asked for, and the dataset's channel 'albedo' has 3");
  expect(heads(map("channel: clip, ")) + "runtime: {keep: [head_clip]}\n", "no training frame has a channel 'clip'");
}

TEST(Heads, OneThatNoLossReadsIsLeftOutAndKeptByName) {
  const std::string head = "heads: [{type: feature_map, channel: albedo, width: 2, " + kBranch + "}}]\n";
  const Session left = open_text(head_config_of(head), channel_plugins());
  EXPECT_TRUE(left.config.heads.empty());
  EXPECT_NO_THROW(left_out_row(left, "head_albedo"));
  const Session kept = open_text(head_config_of(head), channel_plugins(), {"head_albedo"});
  EXPECT_EQ(kept.pipeline->passes().back().parts().heads.size(), 1U);
}

// Which semantic branch the labels choose, what a run keeps of it, and rays that are drawn for their labels.

std::string branches_config_of(const std::string& branches, const std::string& labels) {
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
    const Session s = open_text(branches_config_of(kThree, c.labels));
    ASSERT_EQ(s.config.passes[0].semantic.size(), 1U);
    EXPECT_EQ(s.config.passes[0].branch()->position.entry->name, c.position);
    ASSERT_EQ(s.chosen_by_labels.size(), 1U);
    EXPECT_HAS(s.chosen_by_labels[0],
               "passes.main.semantic." + std::string(c.position == std::string("identity") ? "any" : c.kind) + ": " +
                   c.position,
               "labels are " + std::string(c.kind));
    EXPECT_HAS(describe_session(s), s.chosen_by_labels[0]);
    // What a run keeps names one branch, and opens as it is whatever the labels are then.
    RunConfig again = run_config_of(resolved_config(s.config), all_plugins());
    EXPECT_TRUE(choose_branches(again, {1000, 1, 0, 0}).empty());
    EXPECT_EQ(again.passes[0].branch()->position.entry->name, c.position);
  }
}

// Dense labels are many: a branch for many takes them unless an earlier one is for them.
TEST(BranchChoice, DenseLabelsTakeABranchOfTheirOwnOrThatForMany) {
  const auto key_of = [](const std::string& branches) {
    return open_text(branches_config_of("[" + branches + "]", "frames: all")).config.passes[0].branch()->key;
  };
  const std::string noisy_few = branch("noisy", "frequency") + ", " + branch("few", "one_blob") + ", ";
  const std::string dense = branch("dense", "frequency"), many = branch("many", "identity");
  EXPECT_EQ(key_of(noisy_few + dense + ", " + many), "semantic.dense");
  EXPECT_EQ(key_of(noisy_few + dense + ", " + branch("any", "identity")), "semantic.dense");
  EXPECT_EQ(key_of(noisy_few + many), "semantic.many");
}

TEST(BranchChoice, AListThatLeavesLabelsOutOrNamesThemTwiceIsRefused) {
  const auto refusal = [](const std::vector<std::string>& branches) {
    std::string list;
    for (const std::string& one : branches) list += (list.empty() ? "[" : ", ") + one;
    return error_of([&] { open_text(branches_config_of(list + "]", "frames: all")); });
  };
  const std::string noisy = branch("noisy", "frequency"), few = branch("few", "one_blob"),
                    many = branch("many", "identity"), any = branch("any", "identity"),
                    dense = branch("dense", "frequency"), twice = "an earlier branch takes all labels";
  EXPECT_HAS(refusal({few, many}), "passes.main.semantic: no branch is for labels: noisy");
  EXPECT_HAS(refusal({noisy, few, dense}), "no branch is for labels: many");
  EXPECT_HAS(refusal({any, few}), twice);
  EXPECT_HAS(refusal({few, few, any}), twice);
  EXPECT_HAS(refusal({noisy, few, many, dense}), twice);
  EXPECT_HAS(refusal({branch("some", "one_blob")}), "passes.main.semantic.some");
  EXPECT_EQ(refusal({noisy, few, any}), "");
}

TEST(BranchChoice, WhatLabelsCannotShowIsSaid) {
  const auto said = [&](const LabelStatistics& statistics) {
    RunConfig config =
        run_config_of(parse_config_text(branches_config_of(kThree, "frames: all"), "a.yaml"), all_plugins());
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

TEST(RaySourceChoice, TheLabelsDecideWhereItIsLeftOpen) {
  const auto opened = [&](const std::string& labels, const std::vector<std::string>& keep = {}) {
    return open_text(
        branches_config_of("{position: {type: one_blob}, field: {type: tiny_mlp, hidden_width: 8}}", labels) +
            "train: {rays: 64, ray_source: auto, labelled_share: 0.25}\n",
        keep);
  };
  const auto expect = [](const Session& s, RaySourceKind kind, const std::string& because) {
    SCOPED_TRACE(because);
    EXPECT_EQ(s.config.train.ray_source, kind);
    ASSERT_EQ(s.chosen_by_labels.size(), 1u);
    const std::string name = choice_name(kind);
    EXPECT_HAS(s.chosen_by_labels[0], "train.ray_source: " + name + " was chosen, because ", because);
    EXPECT_HAS(write_config(resolved_config(s.config)), "ray_source: " + name);
    (void)s.make_ray_source();
  };
  expect(opened("frames: none"), RaySourceKind::all_images, "because no training pixel has a label");
  expect(opened("frames: none", {"semantics", "absent_classes"}), RaySourceKind::label_balanced,
         "because labels may come; until then rays come from all pixels");
  expect(opened("frames: 1"), RaySourceKind::label_balanced,
         "of the training pixels have a label; they get 25 % of the rays");
  expect(opened("frames: all"), RaySourceKind::label_balanced, "get 25 % of the rays");
}

TEST(RaySourceChoice, EvenlyDrawnRaysWarnWhereTheyHardlyMeetALabel) {
  const auto said = [](RaySourceKind kind, std::int64_t labelled) {
    TrainParams train{.ray_source = kind};
    Diagnostics diagnostics;
    warn_of_rare_labels(train, {labelled, 100000, false}, diagnostics);
    return diagnostics.all().empty() ? "" : diagnostics.all()[0].text();
  };
  EXPECT_HAS(said(RaySourceKind::all_images, 400), "0.4", "4.1", "1024");
  EXPECT_NE(said(RaySourceKind::one_image, 4999), "");
  EXPECT_EQ(said(RaySourceKind::all_images, 5000), "");
  EXPECT_EQ(said(RaySourceKind::all_images, 0), "");
  EXPECT_EQ(said(RaySourceKind::label_balanced, 400), "");
  EXPECT_EQ(said(RaySourceKind::automatic, 400), "");
}

TEST(RaySourceChoice, RaysThatTeachNoColourAreRefused) {
  const auto errors = [](const std::string& train) {
    Diagnostics diagnostics;
    const std::string branch_of_all = "{position: {type: one_blob}, field: {type: tiny_mlp, hidden_width: 8}}";
    read_run_config(
        parse_config_text(branches_config_of(branch_of_all, "frames: all") + "train: {" + train + "}\n", "a.yaml"),
        all_plugins(), diagnostics);
    return diagnostics.all().empty() ? "" : diagnostics.all()[0].text();
  };
  const std::string apart = "labelled_share: 1, label_rays_teach_color: false, ray_source: ";
  for (const char* source : {"label_balanced", "auto"})
    EXPECT_HAS(errors(apart + source), "a.yaml:9:25: train.labelled_share: ", "train.label_rays_teach_color: true");
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

  for (const int tile_rays : {26, 8, 5, 1}) {
    SCOPED_TRACE(tile_rays);
    const std::string tiles = "runtime: {tile_rays: " + std::to_string(tile_rays) + "}\n";
    const Oracle apart(label_config(kApart, tiles)), together(label_config("labelled_share: 0.3", tiles));
    const std::vector<std::int64_t>& apart_of_tile = apart.batch.label_only;
    EXPECT_EQ(std::accumulate(apart_of_tile.begin(), apart_of_tile.end(), std::int64_t{0}), 7);
    EXPECT_TRUE(together.batch.label_only.empty());
    std::int64_t labelled = 0;
    for (std::int64_t begin = 0; begin < 26; begin += tile_rays) {
      const std::int64_t end = std::min<std::int64_t>(begin + tile_rays, 26);
      const std::int64_t first = label_only_rays(0.3, begin, end);
      for (std::int64_t row = begin; row < begin + first; ++row) EXPECT_NE(apart.batch.label[row], kVoid) << row;
      // The same rays as without, in another order at most.
      const auto colors = [&](const std::vector<float>& target) {
        return std::multiset<float>(target.begin() + 3 * begin, target.begin() + 3 * end);
      };
      EXPECT_EQ(colors(apart.batch.target), colors(together.batch.target));
      labelled += first;
    }
    EXPECT_EQ(labelled, 7);
    // A message about a row names the pixel that stands there.
    std::multiset<std::string> places, others;
    for (std::int64_t row = 0; row < 26; ++row) {
      places.insert(apart.rays->place_of_row(3, row));
      others.insert(together.rays->place_of_row(3, row));
    }
    EXPECT_EQ(places, others);
  }
}

TEST(LabelRays, TheirColoursCountForNothing) {
  Oracle oracle(label_config(kApart, "runtime: {tile_rays: 13}\n"));
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
  for (const auto& [train, counted] : {std::pair{kApart, 19}, std::pair{std::string("labelled_share: 0.3"), 26}}) {
    Oracle oracle(label_config(train));
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
