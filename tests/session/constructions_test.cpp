// How often opening a session makes each part of its network, and the bounds that a short training finds.
#include <cstdlib>

#include "compute/parallel.h"
#include "config/config_tree.h"
#include "core/rng.h"
#include "eval/evaluator.h"
#include "loading/frame_source.h"
#include "model/render_rules.h"
#include "session/session.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

using Counts = std::map<std::string, int>;

// Counts what a maker makes under the name of its plugin.
template <class Maker>
void count_calls(Maker& maker, const std::string& name, const std::shared_ptr<Counts>& counts) {
  if (!maker) return;
  maker = [inner = maker, name, counts](const auto&... arguments) {
    ++(*counts)[name];
    return inner(arguments...);
  };
}

// make_registry(), where each encoder, field and sampler NAME has a twin counted_NAME.
struct CountingRegistry {
  Registry registry = make_registry();
  std::shared_ptr<Counts> counts = std::make_shared<Counts>();

  CountingRegistry() {
    std::vector<PluginEntry> twins;
    for (const PluginEntry* entry : registry.entries()) {
      PluginEntry twin = *entry;
      count_calls(twin.encoder32, entry->name, counts);
      count_calls(twin.field32, entry->name, counts);
      count_calls(twin.sampler32, entry->name, counts);
      twin.name = "counted_" + entry->name;
      twins.push_back(std::move(twin));
    }
    for (PluginEntry& twin : twins) registry.add(std::move(twin));
  }

  // What opening makes of `yaml`, whose slots name twins.
  Counts opened(const std::string& yaml, bool probe = false) {
    counts->clear();
    Diagnostics diagnostics;
    SessionOptions options{.probe = probe};
    RunConfig config = read_run_config(parse_config_text(yaml, "test.yaml"), registry, diagnostics);
    diagnostics.throw_if_errors(ErrorKind::config, "");
    const Session session = open_session(std::move(config), registry, options, diagnostics);
    EXPECT_TRUE(session.pipeline);
    return *counts;
  }
};

std::string with_twins(std::string yaml, const std::vector<std::string>& names) {
  for (const std::string& name : names)
    for (std::size_t at = 0; (at = yaml.find("type: " + name, at)) != std::string::npos; at += 6)
      yaml.replace(at, 6, "type: counted_");
  return yaml;
}

TEST(Constructions, APartIsMadeOnce) {
  CountingRegistry counting;
  const Counts made =
      counting.opened(with_twins(hash_config(), {"hash_grid", "spherical_harmonics", "tiny_mlp", "occupancy_grid"}));
  EXPECT_EQ(made, (Counts{{"hash_grid", 1}, {"occupancy_grid", 1}, {"spherical_harmonics", 1}, {"tiny_mlp", 1}}));
}

TEST(Constructions, EachPassHasItsOwn) {
  CountingRegistry counting;
  const Counts made =
      counting.opened(with_twins(two_pass_config(), {"frequency", "nerf_mlp", "stratified", "importance"}));
  // Two passes; position and direction of each.
  EXPECT_EQ(made, (Counts{{"frequency", 4}, {"importance", 1}, {"nerf_mlp", 2}, {"stratified", 1}}));
}

// The probe's tables and grids are sized by the bounds that it is to replace.
TEST(Constructions, AProbeOfTheBoundsHasANetworkOfItsOwn) {
  CountingRegistry counting;
  std::string yaml =
      with_scene(hash_config(), "{type: analytic_room, with_depth: false, with_labels: false, load: {probe_steps: 8}}");
  const Counts made = counting.opened(
      with_twins(std::move(yaml), {"hash_grid", "spherical_harmonics", "tiny_mlp", "occupancy_grid"}), true);
  EXPECT_EQ(made, (Counts{{"hash_grid", 2}, {"occupancy_grid", 2}, {"spherical_harmonics", 2}, {"tiny_mlp", 2}}));
}

// The map from the world to encoders: affine inside, all of space drawn in outside, against its own inverse.

const Box kBounds{{-1, 2, 3}, {3, 4, 5}};  // longest side 4, centre (1, 3, 4)

DomainMap contracted() { return DomainMap::make(Domain::unit_cube, kBounds, 0, true); }

// Addressed places from `least` to `most` radii (2 each) away, in all directions.
Vec3d place(int i, double least, double most) {
  const auto random = [i](int k) {
    return static_cast<double>(uniform01({5, 0, 2}, static_cast<std::uint64_t>(8 * i + k)));
  };
  const Vec3d way = normalized(Vec3d{random(0) - 0.5, random(1) - 0.5, random(2) - 0.5});
  return kBounds.center() + way * (2 * least * std::pow(most / least, random(3)));
}

double reach(Vec3d p) {
  const Vec3d q = p - kBounds.center();
  return std::max({std::abs(q.x), std::abs(q.y), std::abs(q.z)});
}

TEST(DomainMap, WithoutContractionItIsAffine) {
  const DomainMap map = DomainMap::make(Domain::unit_cube, kBounds, 0);
  EXPECT_EQ(map.radius, 0);
  const Vec3d far = map({101, 3, 4});
  EXPECT_EQ(far.x, 25.5);
  EXPECT_EQ(DomainMap::make(Domain::metric, kBounds, 0.1)({7, 8, 9}).y, 8 * 0.1);
}

TEST(DomainMap, BoundsTakeTheInnerHalfAndKeepTheirShape) {
  const DomainMap map = contracted();
  EXPECT_EQ(map({-1, 3, 4}), (Vec3d{0.25, 0.5, 0.5}));
  EXPECT_EQ(map({3, 4, 5}), (Vec3d{0.75, 0.625, 0.625}));
  const DomainMap metric = DomainMap::make(Domain::metric, kBounds, 0.1, true);
  EXPECT_EQ(metric({3, 3, 4}), (Vec3d{0.5, 0, 0}));
}

TEST(DomainMap, AllOfSpaceFitsTheCube) {
  const DomainMap map = contracted();
  for (int i = 0; i < 3000; ++i) {
    const Vec3d x = map(place(i, 1e-3, 1e12));
    for (int a = 0; a < 3; ++a) {
      EXPECT_GE(x[a], 0);
      EXPECT_LE(x[a], 1);
    }
  }
  EXPECT_EQ(map({1e300, 3, 4}).x, 1);  // as good as infinity: the face, and no NaN
  EXPECT_EQ(map({-1e300, -1e300, 1e300}), (Vec3d{0, 0, 1}));
}

TEST(DomainMap, ExpandIsTheInverse) {
  const DomainMap map = contracted();
  for (int i = 0; i < 3000; ++i) {
    const Vec3d p = place(i, 1e-2, 1e4), back = map.expand(map.contract(p));
    // An ulp near the face of the cube is a large part of the distance to it.
    const double steep = std::max(1.0, reach(p) / map.radius);
    EXPECT_LT(length(back - p), 1e-14 * steep * length(p)) << i;
  }
}

TEST(DomainMap, ItIsContinuousAcrossTheBordersAndItsSlopeIsBounded) {
  const DomainMap map = contracted();
  double steepest = 0, flattest_inside = 1;
  for (int i = 0; i < 2000; ++i) {
    const Vec3d on = place(i, 0.5, 50);
    const double h = 1e-6 * reach(on);
    // On the border itself, where the formula changes.
    const Vec3d border = kBounds.center() + (on - kBounds.center()) * (map.radius / reach(on));
    const Vec3d within = map.contract(kBounds.center() + (border - kBounds.center()) * (1 - 1e-9));
    const Vec3d beyond = map.contract(kBounds.center() + (border - kBounds.center()) * (1 + 1e-9));
    EXPECT_LT(length(beyond - within), 1e-8 * map.radius);
    for (int a = 0; a < 3; ++a) {
      Vec3d step;
      step[a] = h;
      const Vec3d slope = (map.contract(on + step) - map.contract(on - step)) * (1 / (2 * h));
      steepest = std::max(steepest, length(slope));
      if (reach(on) < 0.99 * map.radius) flattest_inside = std::min(flattest_inside, length(slope));
    }
    // Farther places stay farther: nothing is folded.
    EXPECT_GT(reach(map.contract(kBounds.center() + (on - kBounds.center()) * 1.01)), reach(map.contract(on)));
  }
  EXPECT_NEAR(flattest_inside, 1, 1e-6);
  EXPECT_LE(steepest, 1.25);  // |(2 - 1/m) / m| <= 1 along, at most 1/2 more across each of two other axes
}

// A short training finds where a scene is whose bounds only the cameras show; and rays that go on beyond the bounds.

std::string without_depth(const std::string& more) {
  std::string yaml =
      with_scene(hash_config(more),
                 "{type: analytic_room, with_depth: false, with_labels: false, frames: 24, load: {probe_steps: 128}}");
  yaml.replace(yaml.find("steps: 200"), 10, "steps: 512");
  return yaml;
}

Session open_probing(const std::string& yaml, Registry& registry, Diagnostics& diagnostics) {
  RunConfig config = read_run_config(parse_config_text(yaml, "test.yaml"), registry, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::config, "");
  SessionOptions options{.probe = true};
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
  WorkSettings work{.load_progress = &progress};
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
  EXPECT_HAS(d.all().back().text(), "a probe of 128 steps");
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
  EXPECT_FALSE(open_probing(hash_config(), registry, d).scene.extent_is_guessed);  // depth shows it
  std::string off = without_depth("");
  off.replace(off.find("probe_steps: 128"), 16, "probe_steps: 0");
  EXPECT_TRUE(open_probing(off, registry, d).scene.extent_is_guessed);
  std::string brief = without_depth("");
  brief.replace(brief.find("steps: 512"), 10, "steps: 511");
  EXPECT_TRUE(open_probing(brief, registry, d).scene.extent_is_guessed);
}

TEST(Contraction, RaysGoOnBeyondTheBounds) {
  std::string yaml = without_depth("");
  yaml.replace(yaml.find("far: background"), 15, "far: background, outside: contracted");
  yaml.replace(yaml.find("resolution: 32"), 14, "resolution: 32, cascades: 7, growth: 0.02");
  const Session s = open_text(yaml);
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
