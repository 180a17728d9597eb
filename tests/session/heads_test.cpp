// Heads beside that of class logits: gradients, what they leave alone, principal axes, settings, and what is left out.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "core/error.h"
#include "eval/evaluator.h"
#include "session/assembly.h"
#include "session/trainer.h"
#include "session/training.h"
#include "tests/session/oracle.h"

namespace semfield {
namespace {

using namespace testing_train;

const std::string kBranch =
    "branch: {position: {type: frequency, frequencies: 3}, field: {type: tiny_mlp, hidden_width: 12, hidden_layers: 2}";

std::string head_yaml(const std::string& of_head = "", const std::string& of_branch = "") {
  return "heads:\n  - {type: feature_map, channel: albedo, hidden_width: 11" + of_head + ", " + kBranch + of_branch +
         "}}\nlosses: [{type: cosine_distance, channel: albedo, weight: 0.7}]\n";
}

// The dataset offers `albedo`, three columns.
std::string config_of(const std::string& more, const std::string& of_pass = "") {
  return stratified_config("type: analytic_room, with_albedo: true", of_pass, "rays: 24", more);
}
const std::string kSemanticBranch =
    "    semantic: {position: {type: frequency, frequencies: 2}, field: {type: tiny_mlp}}\n";

TEST(Heads, GradientsAreThoseOfFiniteDifferences) {
  for (const char* of_branch : {"", ", reads_feature: true", ", dropout: 0.3", ", least_weight: 0.02"}) {
    SCOPED_TRACE(of_branch);
    Registry registry = make_channel_registry();
    Oracle oracle(config_of(head_yaml("", of_branch)), registry);
    expect_finite_differences(oracle, 2e-4, "/heads/albedo", 8 * 3);  // two layers of branch and of head
  }
}

// With a semantic branch or without one: colour, geometry and class logits learn as they do alone, to the last bit.
TEST(Heads, ChangeNoOtherGradient) {
  for (const auto& [of_pass, of_branch] :
       std::vector<std::pair<std::string, std::string>>{{"", ""},
                                                        {"", ", reads_feature: true"},
                                                        {kSemanticBranch, ""},
                                                        {kSemanticBranch, ", reads_feature: true"}}) {
    Registry registry = make_channel_registry();
    Oracle with(config_of(head_yaml("", of_branch), of_pass), registry), without(config_of("", of_pass), registry);
    const StepLosses a = with.gradients(), b = without.gradients();
    EXPECT_EQ(a.color, b.color);
    EXPECT_EQ(a.semantic, b.semantic);
    EXPECT_GT(a.terms[0], 0);
    int compared = 0;
    for (const Tensor<double>& t : without.pipeline->store().all()) {
      if (!t.learned()) continue;
      const Tensor<double>* other = with.pipeline->store().find(t.name);
      ASSERT_NE(other, nullptr) << t.name;
      ASSERT_TRUE(std::equal(t.grad.data(), t.grad.data() + t.size(), other->grad.data())) << t.name;
      ++compared;
    }
    EXPECT_GT(compared, 8);
  }
}

TEST(Heads, TilesAndLanesChangeNoGradient) {
  Registry registry = make_channel_registry();
  Oracle one(config_of(head_yaml() + "runtime: {lanes: 1, tile_rays: 24}\n"), registry);
  Oracle many(config_of(head_yaml() + "runtime: {lanes: 3, tile_rays: 4}\n"), registry);
  EXPECT_NEAR(one.gradients().total, many.gradients().total, 1e-12);
  for (const Tensor<double>& t : one.pipeline->store().all()) {
    if (!t.learned() || t.name.find("/heads/") == std::string::npos) continue;
    const Tensor<double>* other = many.pipeline->store().find(t.name);
    for (std::int64_t i = 0; i < t.size(); ++i) ASSERT_NEAR(t.grad.data()[i], other->grad.data()[i], 1e-10) << t.name;
  }
}

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
  Registry registry = make_channel_registry();
  std::string yaml = hash_config(head_yaml("", ", learning_rate: 0.3"));
  yaml.replace(yaml.find("type: analytic_room"), 19, "type: analytic_room, with_albedo: true");
  yaml.replace(yaml.find("hidden_width: 12"), 16, "hidden_width: 32");
  Session session = open_text(yaml, registry);
  const std::unique_ptr<RaySource> rays = session.make_ray_source();
  Trainer trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule, session.config.train.steps);
  const double first = trainer.advance().terms[0];
  double last = first;
  while (trainer.step() < 200) last = trainer.advance().terms[0];
  EXPECT_LT(last, 0.5 * first);
  FrameOptions options;
  options.channels = {"albedo"};
  const int test = session.scene.frames_of(Split::test).front();
  const FrameInfo& info = session.scene.info.frames[static_cast<std::size_t>(test)];
  const RenderedFrame frame = render_frame(*session.pipeline, {info.camera, info.world_from_camera, false},
                                           session.limits, session.plan.class_of_logit, {}, options);
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
  Registry registry = make_channel_registry();
  Session session = open_text(config_of(head_yaml()), registry);
  Tensor<float>* bias = session.pipeline->store().find("main/heads/albedo/output/bias");
  ASSERT_NE(bias, nullptr);
  bias->value.data()[1] = std::numeric_limits<float>::quiet_NaN();
  session.pipeline->executor().upload(0);
  const FrameInfo& info = session.scene.info.frames.front();
  FrameOptions options;
  options.channels = {"albedo"};
  EXPECT_HAS(error_of([&] {
               (void)render_frame(*session.pipeline, {info.camera, info.world_from_camera, false}, session.limits,
                                  session.plan.class_of_logit, {}, options);
             }),
             "channel of a head");
}

TEST(Heads, ARunWithOneHasTheSameBitsOnAnyThreads) {
  const std::string yaml = config_of(head_yaml(", width: 2"), kSemanticBranch);
  Registry registry = make_channel_registry();
  const auto after = [&](int threads) {
    Session session = open_text(yaml + "runtime: {threads: " + std::to_string(threads) + "}\n", registry);
    const WorkSettings work = session.work();
    const WorkScope scope(work);
    const std::unique_ptr<RaySource> rays = session.make_ray_source();
    Trainer trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule, 10);
    while (trainer.step() < 10) trainer.advance();
    return fingerprint(session.pipeline->store());
  };
  EXPECT_EQ(after(1), after(3));
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
  try {
    (void)principal_axes({&map}, 2);
    FAIL() << "axes of nothing";
  } catch (const Error& error) {
    EXPECT_NE(error.message().find("'empty'"), std::string::npos) << error.what();
  }
}

// The axes are state: a session that goes on takes those of the checkpoint, and its frames with them.
TEST(ChannelAxes, GoWithTheCheckpoint) {
  Registry registry = make_channel_registry();
  SessionOptions options;
  const std::string yaml = config_of(head_yaml(", width: 2"));
  const auto opened = [&] { return open_text(yaml, registry); };
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

std::string error_of(const std::string& more) {
  Registry registry = make_channel_registry();
  try {
    (void)open_text(config_of(more), registry);
  } catch (const Error& error) {
    return error.what();
  }
  return "accepted";
}

TEST(Heads, WrongSettingsAreNamed) {
  const auto expect = [](const std::string& more, const std::string& said) {
    const std::string found = error_of(more);
    EXPECT_NE(found.find(said), std::string::npos) << found;
  };
  const std::string head = "{type: feature_map, channel: albedo, " + kBranch + "}}";
  expect("heads: {type: feature_map}\n", "heads: expected a list of heads");
  expect("heads: [{type: feature_map, channel: albedo}]\n", "heads.0: key 'branch' is missing");
  expect("heads: [{type: feature_mpa, channel: albedo}]\n", "did you mean 'feature_map'?");
  expect("heads: [{type: feature_map, chanel: albedo, " + kBranch + "}}]\n", "did you mean 'channel'?");
  expect("heads: [{type: feature_map, " + kBranch + "}}]\n", "heads.0.channel: the head names no channel");
  expect("heads: [{type: feature_map, channel: depth, " + kBranch + "}}]\n", "'depth' is a channel of the framework");
  expect("heads: [{type: feature_map, channel: A-B, " + kBranch + "}}]\n", "'A-B' cannot name a channel");
  expect("heads: [" + head + ", " + head + "]\n", "heads.1.channel: 'albedo' is made by heads.0 already");
  expect("losses: [{type: cosine_distance, channel: clip}]\n",
         "'cosine_distance' reads the channel 'clip', which no head makes");
  expect(head_yaml(", width: 4"), "heads.0.width: 4 columns are asked for, and the dataset's channel 'albedo' has 3");
  expect("heads: [{type: feature_map, channel: clip, " + kBranch + "}}]\nruntime: {keep: [head_clip]}\n",
         "heads.0.width: no training frame has a channel 'clip'");
}

TEST(Heads, OneThatNoLossReadsIsLeftOutAndKeptByName) {
  const std::string head = "heads: [{type: feature_map, channel: albedo, width: 2, " + kBranch + "}}]\n";
  Registry registry = make_channel_registry();
  const Session left = open_text(config_of(head), registry);
  EXPECT_TRUE(left.config.heads.empty());
  const auto& rows = left.plan.left_out;
  EXPECT_TRUE(std::any_of(rows.begin(), rows.end(), [](const LeftOut& r) { return r.component == "head_albedo"; }));
  const Session kept = open_text(config_of(head), registry, {"head_albedo"});
  EXPECT_EQ(kept.pipeline->passes().back().parts().heads.size(), 1U);
}

TEST(Heads, TheResolvedConfigurationHoldsThem) {
  Registry registry = make_channel_registry();
  const Session session = open_text(config_of(head_yaml(", width: 2")), registry);
  Diagnostics diagnostics;
  const RunConfig again = read_run_config(resolved_config(session.config), registry, diagnostics);
  EXPECT_TRUE(diagnostics.all().empty());
  ASSERT_EQ(again.heads.size(), 1U);
  EXPECT_EQ(again.heads[0].width, 2);
  EXPECT_EQ(again.heads[0].source_width, 3);
  EXPECT_EQ(again.heads[0].field.entry->name, "tiny_mlp");
}

}  // namespace
}  // namespace semfield
