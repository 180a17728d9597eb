// A short training finds where a scene is whose bounds only the cameras tell; and rays that go on beyond the bounds.
#include "session/bounds_probe.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <vector>

#include "config/config_tree.h"
#include "loading/load_progress.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

std::string without_depth(const std::string& more) {
  std::string yaml = hash_config(more);
  yaml.replace(yaml.find("{type: analytic_room}"), 21,
               "{type: analytic_room, with_depth: false, with_labels: false, frames: 24, load: {probe_steps: 128}}");
  yaml.replace(yaml.find("steps: 200"), 10, "steps: 512");
  return yaml;
}

Session open_probing(const std::string& yaml, Registry& registry, Diagnostics& diagnostics) {
  RunConfig config = read_run_config(parse_config_text(yaml, "test.yaml"), registry, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::config, "");
  SessionOptions options;
  options.probe = true;
  return open_session(std::move(config), registry, options, diagnostics);
}

double volume(const Box& box) { return box.size().x * box.size().y * box.size().z; }

// The probe borrows the frames: their channels must come back as they were, for the run to find its axes in them.
TEST(BoundsProbe, LeavesHeadsAndTheirChannelsToTheRun) {
  Registry registry = make_channel_registry();
  Diagnostics d;
  std::string yaml = without_depth(
      "heads:\n  - {type: feature_map, channel: albedo, width: 2, branch: {position: {type: frequency, frequencies: "
      "2}, "
      "field: {type: tiny_mlp, hidden_width: 8, hidden_layers: 1}}}\n"
      "losses: [{type: cosine_distance, channel: albedo}]\n");
  yaml.replace(yaml.find("with_depth: false"), 17, "with_depth: false, with_albedo: true");
  const Session s = open_probing(yaml, registry, d);
  ASSERT_EQ(s.scene.bounds_from, "a probe of 128 steps");
  const View<const float> axes = s.pipeline->passes().back().axes("albedo");
  ASSERT_EQ(axes.rows, 3);
  for (std::int32_t a = 0; a < 2; ++a) {
    for (std::int32_t b = 0; b < 2; ++b) {
      double dot = 0;
      for (std::int64_t row = 0; row < 3; ++row) dot += static_cast<double>(axes(row, a) * axes(row, b));
      EXPECT_NEAR(dot, a == b ? 1 : 0, 1e-5) << a << " " << b;
    }
  }
  const auto train = static_cast<std::size_t>(s.scene.frames_of(Split::train).front());
  EXPECT_EQ(s.scene.frames[train].channels.at(0).cols, 2);
}

// The room is 4 m x 3 m x 2 m.
TEST(BoundsProbe, ShrinksWhatTheCamerasGuessToTheRoom) {
  Registry registry = make_registry();
  Diagnostics d;
  const Session guessed = open_text(without_depth(""), registry);
  EXPECT_TRUE(guessed.scene.extent_is_guessed);
  EXPECT_GT(volume(guessed.extent.bounds), 15 * 24);
  std::vector<std::size_t> told;
  const LoadProgress progress = [&](std::string_view doing, std::size_t done, std::size_t total) {
    if (doing != "looking for the bounds") return;
    told.push_back(done);
    EXPECT_EQ(total, 128u);
  };
  WorkSettings work;
  work.load_progress = &progress;
  const WorkScope scope(work);
  const Session s = open_probing(without_depth(""), registry, d);
  EXPECT_EQ(s.scene.bounds_from, "a probe of 128 steps");
  EXPECT_GT(told.size(), 3u) << "a probe says how far it is";
  EXPECT_TRUE(std::is_sorted(told.begin(), told.end()));
  EXPECT_LT(volume(s.extent.bounds), volume(guessed.extent.bounds) / 10);
  for (int a = 0; a < 3; ++a) {
    const double half = 2 - 0.5 * a;
    EXPECT_LT(s.extent.bounds.lo[a], -0.75 * half) << a;
    EXPECT_GT(s.extent.bounds.hi[a], 0.75 * half) << a;
  }
  EXPECT_LT(s.extent.far_m, guessed.extent.far_m);
  EXPECT_GT(s.extent.far_m, 3);
  // Part of the run: whoever opens it again takes these and probes no more.
  EXPECT_EQ(box_of(s.config.load.bounds).hi, s.extent.bounds.hi);
  EXPECT_FALSE(probe_is_due(s));
  ASSERT_FALSE(d.all().empty());
  EXPECT_NE(d.all().back().text().find("a probe of 128 steps"), std::string::npos);
}

TEST(BoundsProbe, GivesTheSameBitsForAnyThreadsAndOnResuming) {
  Registry registry = make_registry();
  Diagnostics d;
  const std::string more = "runtime: {threads: 1}\n";
  const Session one = open_probing(without_depth(more), registry, d);
  const Session two = open_probing(without_depth("runtime: {threads: 2}\n"), registry, d);
  EXPECT_EQ(one.config.load.bounds, two.config.load.bounds);
  EXPECT_EQ(one.config.load.far_m, two.config.load.far_m);
  const Session again = open_probing(write_config(resolved_config(one.config)), registry, d);
  EXPECT_EQ(again.config.load.bounds, one.config.load.bounds);
  EXPECT_EQ(again.extent.pixel_footprint_m, one.extent.pixel_footprint_m);
  EXPECT_EQ(fingerprint(again.pipeline->store()), fingerprint(one.pipeline->store()));
}

TEST(BoundsProbe, IsMadeOnlyWhereItHelps) {
  Registry registry = make_registry();
  Diagnostics d;
  EXPECT_FALSE(open_probing(hash_config(), registry, d).scene.extent_is_guessed);  // depth tells
  std::string off = without_depth("");
  off.replace(off.find("probe_steps: 128"), 16, "probe_steps: 0");
  EXPECT_TRUE(open_probing(off, registry, d).scene.extent_is_guessed);
  std::string brief = without_depth("");
  brief.replace(brief.find("steps: 512"), 10, "steps: 511");
  EXPECT_TRUE(open_probing(brief, registry, d).scene.extent_is_guessed);
}

TEST(Contraction, RaysGoOnBeyondTheBounds) {
  Registry registry = make_registry();
  std::string yaml = without_depth("");
  yaml.replace(yaml.find("far: background"), 15, "far: background, outside: contracted");
  yaml.replace(yaml.find("resolution: 32"), 14, "resolution: 32, cascades: 7, growth: 0.02");
  const Session s = open_text(yaml, registry);
  EXPECT_FALSE(s.scene.extent_is_guessed);
  EXPECT_FALSE(s.limits.clip);
  EXPECT_EQ(s.extent.far_m, 64 * s.extent.bounds.size().x);
  const DomainMap& map = s.pipeline->passes().front().parts().domain;
  EXPECT_EQ(map.radius, 0.5 * s.extent.bounds.size().x);
  const std::unique_ptr<RaySource> rays = s.make_ray_source();
  BatchBuffers batch;
  rays->fill(0, batch);
  for (std::size_t r = 0; r < batch.label.size(); ++r) EXPECT_EQ(batch.near_far[2 * r + 1], s.extent.far_m);
}

}  // namespace
}  // namespace semfield
