// How many gradient lanes a run gets, the units of work that threads share, and the memory that they take.
#include <gtest/gtest.h>

#include <atomic>

#include "compute/parallel.h"
#include "execution/lane_executor.h"
#include "session/assembly.h"
#include "session/trainer.h"
#include "settings/run_identity.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

class Threads {
 public:
  explicit Threads(int count) { set_thread_count(count); }
  ~Threads() { set_thread_count(0); }
  Threads(const Threads&) = delete;
  Threads& operator=(const Threads&) = delete;
};

// Of a shipped configuration with labels on every frame, without its scene.
int lanes_of_preset(const std::string& name, const std::vector<std::string>& set = {}) {
  Registry registry = make_registry();
  RunConfig config = load_run_config(SEMFIELD_SOURCE_DIR "/configs/" + name, set, registry);
  config.runtime.precision = Precision::fp32;
  SceneExtent extent;
  extent.bounds = {{-3, -3, -1}, {3, 3, 2}};
  extent.near_m = 0.1;
  extent.far_m = 10;
  extent.pixel_footprint_m = 0.01;
  SceneManifest manifest;
  manifest.classes = 13;
  manifest.train_frames = manifest.labelled_frames = 100;
  manifest.train_pixels = 1'000'000;
  manifest.train_class_pixels.assign(13, 70'000);
  std::unique_ptr<Sampler<float>> last = make_last_sampler(config, registry, extent);
  const BuildPlan plan = plan_build(manifest, build_request(config, registry, last->traits()), {});
  return make_parts<float>(config, registry, plan, extent, std::move(last)).options.lanes;
}

TEST(Lanes, AStepOf1024RaysHasWorkFor32AndMoreWhateverTheThreads) {
  for (const char* preset : {"paper.yaml", "quickstart.yaml", "bench/hash_step.yaml"}) {
    const int lanes = lanes_of_preset(preset);
    EXPECT_GE(lanes, 32) << preset;
    EXPECT_LE(lanes, 48) << preset;
    for (const int count : {1, 3, 16}) {
      const Threads threads(count);
      EXPECT_EQ(lanes_of_preset(preset), lanes) << preset << ", " << count << " threads";
    }
  }
}

TEST(Lanes, AreFewForFewRays) {
  EXPECT_EQ(lanes_of_preset("paper.yaml", {"train.rays=5"}), 1);
  EXPECT_LE(lanes_of_preset("quickstart.yaml", {"train.rays=128"}), 8);
  EXPECT_LE(lanes_of_preset("quickstart.yaml", {"train.rays=1024", "runtime.tile_rays=1"}), 48);
}

TEST(Lanes, AreFewerWhereTheirGradientsWouldFillTheMemory) {
  const int wide = lanes_of_preset("paper.yaml", {"passes.0.field.width=1024", "passes.1.field.width=1024"});
  EXPECT_LT(wide, 8);
  EXPECT_GE(wide, 1);
}

TEST(Lanes, TheChosenNumberIsThatOfTheRunAndItsIdentity) {
  Registry registry = make_registry();
  const Session s = open_text(hash_config(), registry);
  const int lanes = s.pipeline->options().lanes;
  EXPECT_GT(lanes, 0);
  EXPECT_EQ(s.config.runtime.lanes, lanes);
  EXPECT_NE(write_config(resolved_config(s.config)).find("lanes: " + std::to_string(lanes)), std::string::npos);
  const Session same = open_text(hash_config("runtime: {lanes: " + std::to_string(lanes) + "}\n"), registry);
  EXPECT_EQ(identity_hash(same.config), identity_hash(s.config));
  EXPECT_NE(describe_session(s).find(std::to_string(lanes) + " lanes"), std::string::npos);
}

TEST(Lanes, ARunThatNamesItsNumberKeepsIt) {
  Registry registry = make_registry();
  const Session s = open_text(hash_config("runtime: {lanes: 8}\n"), registry);
  EXPECT_EQ(s.pipeline->options().lanes, 8);
  const Session again = open_text(write_config(resolved_config(s.config)), registry);
  EXPECT_EQ(again.pipeline->options().lanes, 8);
}

std::size_t scratch_of(const std::string& yaml) {
  Registry registry = make_registry();
  Session s = open_text(yaml, registry);
  const auto source = s.make_ray_source();
  Trainer trainer(*s.pipeline, *source, s.config.adam, s.config.schedule);
  for (int i = 0; i < 2; ++i) trainer.advance();
  return s.pipeline->lanes().workspace_bytes();
}

TEST(Lanes, ScratchGrowsWithThreadsAndNotWithLanes) {
  const std::string rays = "train: {rays: 512}\nruntime: {threads: 2, tile_rays: 8, lanes: ";
  const auto text = [&](const std::string& lanes) {
    std::string yaml = two_pass_config();
    yaml.replace(yaml.find("train:"), std::string::npos, rays + lanes + "}\n");
    return yaml;
  };
  const std::size_t few = scratch_of(text("2"));
  EXPECT_EQ(scratch_of(text("64")), few);
}

TEST(ThreadArenas, EveryThreadGetsRoomForTheUnitThatTakesMost) {
  const Threads threads(4);
  constexpr std::size_t kLarge = std::size_t{8} << 20;
  ThreadArenas arenas;
  const auto round = [&](std::int64_t dearest) {
    arenas.for_units(64, [&](Workspace& arena, std::int64_t i) {
      const Workspace::Scope scope(arena);
      arena.take_bytes(i == dearest ? kLarge : 64);
    });
  };
  round(63);
  EXPECT_EQ(arenas.bytes(), 4 * kLarge) << "whichever thread met it";
  const std::int64_t growths = arenas.growths();
  for (std::int64_t i = 0; i < 64; ++i) round(i);
  EXPECT_EQ(arenas.growths(), growths);
}

TEST(ThreadArenas, EveryUnitIsDoneOnceInAnArenaThatNoOtherThreadHas) {
  for (const int count : {1, 2, 7}) {
    const Threads threads(count);
    ThreadArenas arenas;
    std::vector<std::atomic<int>> done(1000);
    arenas.for_units(1000, [&](Workspace& arena, std::int64_t i) {
      const Workspace::Scope scope(arena);
      const View<std::int64_t> mine = arena.take<std::int64_t>(64, 1);
      for (std::int64_t k = 0; k < 64; ++k) mine(k, 0) = i;
      for (std::int64_t k = 0; k < 64; ++k) done[static_cast<std::size_t>(i)] += mine(k, 0) == i ? 1 : 0;
    });
    for (const auto& times : done) EXPECT_EQ(times, 64);
  }
}

TEST(Determinism, ChosenLanesGiveTheSameBitsFor1And2And3And7ThreadsAndOddRays) {
  const auto with_rays = [](std::string yaml, const std::string& rays) {
    const std::size_t at = yaml.find("rays: ") + 6;
    return yaml.replace(at, yaml.find_first_of(",}", at) - at, rays);
  };
  for (const std::string& yaml : {with_rays(hash_config(), "1021"), with_rays(two_pass_config(), "333")}) {
    const std::uint32_t one = train_fingerprint(yaml, 1, 4);
    for (const int threads : {2, 3, 7}) EXPECT_EQ(train_fingerprint(yaml, threads, 4), one) << threads << " threads";
  }
}

}  // namespace
}  // namespace semfield
