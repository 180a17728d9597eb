// Predicted memory against what runs take, the refusal of what does not fit, and how many lanes a run gets.
#include "session/memory_plan.h"

#include <regex>

#include "compute/parallel.h"
#include "datasets/obj_room/raycast.h"
#include "execution/lane_executor.h"
#include "session/assembly.h"
#include "session/settings/run_identity.h"
#include "session/trainer.h"
#include "tests/program.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;
using testing_program::semfield_run;

TEST(MemoryPlan, TensorsArePredictedToTheByte) {
  Registry registry = make_registry();
  for (const std::string& config : {hash_config(), two_pass_config()}) {
    const Session s = open_text(config, registry);
    const NetworkPlan plan = make_parts<float>(s.config, registry, s.plan, s.extent).plan(s.config, true);
    EXPECT_EQ(plan.tensors.total(), s.pipeline->store().bytes());
  }
}

TEST(MemoryPlan, CheckpointIsPredictedToTheByte) {
  Registry registry = make_registry();
  Session s = open_text(hash_config(), registry);
  const auto rays = s.make_ray_source();
  const Trainer trainer(*s.pipeline, *rays, s.config.adam, s.config.schedule);
  std::size_t bytes = 0;
  for (const TensorRef& tensor : trainer.state()) bytes += tensor.bytes.size();
  EXPECT_EQ(make_parts<float>(s.config, registry, s.plan, s.extent).plan(s.config, true).tensors.stored, bytes);
}

TEST(MemoryPlan, SettingsThatFitLeaveTheConfigurationAsItWas) {
  Registry registry = make_registry();
  Session s = open_text(hash_config(), registry);
  const std::string before = write_config(resolved_config(s.config));
  const std::size_t peak = s.memory.peak();
  const std::vector<std::string> settings =
      settings_that_fit(s.config, registry, s.plan, s.extent, s.memory_facts, s.memory_facts.loaded + 4'000'000);
  EXPECT_GE(peak, s.memory_facts.loaded);
  EXPECT_LE(settings.size(), 3u);
  EXPECT_EQ(write_config(resolved_config(s.config)), before);
}

// The shipped room, few small frames: what the network takes counts.
struct RealRun {
  const char* name;
  const char* config;
  const char* set;
  int steps;          ///< until every thread has met the largest tiles
  double over = 0.1;  ///< fraction by which the plan may lie above
};
const RealRun kRuns[] = {
    // How many samples a branch keeps is not known before: the plan counts all of them.
    {"preset", "quickstart.yaml", "", 5, 0.3},
    {"hash", "quickstart.yaml", "--set passes.0.semantic=null", 5},
    {"hash, 2^19", "quickstart.yaml",
     "--set passes.0.semantic=null --set passes.0.position.log2_entries=19 --set "
     "passes.0.position.finest_resolution=512",
     5},
    {"hash, 32 lanes, 4096 rays", "quickstart.yaml",
     "--set passes.0.semantic=null --set runtime.lanes=32 --set train.rays=4096", 60},
    {"semantic branch", "quickstart.yaml",
     "--set 'passes.0.semantic={position: {type: one_blob}, field: {type: tiny_mlp, hidden_width: 128, "
     "hidden_layers: 3}, dropout: 0.2}' --set train.labelled_share=1 --set train.rays=4096",
     5},
    {"frequency", "quickstart_frequency.yaml", "", 12},
    {"frequency, 8 x 256", "quickstart_frequency.yaml",
     "--set passes.0.field.width=256 --set passes.1.field.width=256 --set passes.0.field.depth=8 "
     "--set passes.1.field.depth=8 --set train.rays=64",
     12},
};

double number_behind(const std::string& text, const std::string& pattern) {
  std::smatch match;
  return std::regex_search(text, match, std::regex(pattern)) ? std::stod(match[1]) : NAN;
}

std::string words_for(const RealRun& run) {
  return " " + shell_word(std::string(SEMFIELD_SOURCE_DIR "/configs/") + run.config) +
         " --set scene.frames=10 --set scene.test_frames=1 --set scene.width_px=64 --set scene.height_px=48 --threads "
         "2 " +
         run.set;  // how many of a machine's threads find work in five steps is a matter of its load
}

// A sanitizer's own memory is several times the program's and grows with every allocation.
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
#define SEMFIELD_NEEDS_PLAIN_MEMORY() GTEST_SKIP() << "a sanitizer's memory would be counted as the program's"
#else
#define SEMFIELD_NEEDS_PLAIN_MEMORY() static_assert(true)
#endif

class MemoryPlanOfRuns : public testing::Test {
 protected:
  void SetUp() override {
    if (!raycast_available()) GTEST_SKIP() << "this build reads no meshes, so the shipped room is not at hand";
  }
};

TEST_F(MemoryPlanOfRuns, PeakIsPredictedWithinATenth) {
  SEMFIELD_NEEDS_PLAIN_MEMORY();
  const TempDir folder;
  for (const RealRun& run : kRuns) {
    const auto plan = semfield_run("train" + words_for(run) + " --dry-run", folder.path());
    ASSERT_EQ(plan.code, 0) << run.name << plan.err;
    const auto real = semfield_run("train" + words_for(run) + " --steps " + std::to_string(run.steps) + " --out " +
                                       std::to_string(&run - kRuns) + " -q",
                                   folder.path());
    ASSERT_EQ(real.code, 0) << run.name << real.err;
    const double predicted = number_behind(plan.out, "memory +([0-9.]+) MB at the peak");
    const double measured = number_behind(real.out, "peak_mb=([0-9]+)");
    RecordProperty(run.name, std::to_string(predicted) + " " + std::to_string(measured));
    EXPECT_GE(predicted, 0.9 * measured) << run.name << "\n" << plan.out;
    EXPECT_LE(predicted, (1 + run.over) * measured) << run.name << "\n" << plan.out;
  }
}

TEST_F(MemoryPlanOfRuns, WhatDoesNotFitIsRefusedWithSettingsThatFit) {
  SEMFIELD_NEEDS_PLAIN_MEMORY();
  const TempDir folder;
  const RealRun run{"hash, 2^19", "quickstart.yaml", kRuns[2].set, 0};
  const std::string words = "train" + words_for(run) + " --dry-run --memory 0.16";
  const auto refused = semfield_run(words, folder.path());
  EXPECT_EQ(refused.code, 69);
  EXPECT_TRUE(std::regex_search(
      refused.err, std::regex("would take [0-9]+ MB of memory at its peak, 164 MB are available .*the largest part is "
                              "'model: [a-z A-Z]+' with [0-9]+ MB")))
      << refused.err;
  int tried = 0;
  const std::regex setting("--set ([a-z0-9_.]+=[0-9]+)");
  for (std::sregex_iterator it(refused.err.begin(), refused.err.end(), setting), end; it != end; ++it, ++tried) {
    const auto fits = semfield_run(words + " --set " + (*it)[1].str(), folder.path());
    EXPECT_EQ(fits.code, 0) << (*it)[1] << ": " << fits.err;
  }
  EXPECT_EQ(tried, 3) << refused.err;
}

TEST_F(MemoryPlanOfRuns, PixelsThatDoNotFitAreRefusedBeforeTheyAreRead) {
  SEMFIELD_NEEDS_PLAIN_MEMORY();
  const TempDir folder;
  const auto refused = semfield_run("train " + shell_word(SEMFIELD_SOURCE_DIR "/configs/quickstart.yaml") +
                                        " --dry-run --memory 0.2 --set scene.frames=900 --set "
                                        "scene.width_px=1600 --set scene.height_px=1200",
                                    folder.path());
  EXPECT_EQ(refused.code, 69);
  EXPECT_HAS(refused.err, "frames would take", "scene.load.downscale=");
}

TEST_F(MemoryPlanOfRuns, WhereTheProgramAloneDoesNotFitNoSceneIsProposed) {
  const TempDir folder;
  const auto refused = semfield_run("train" + words_for(kRuns[0]) + " --dry-run --memory 0.01", folder.path());
  EXPECT_EQ(refused.code, 69);
  EXPECT_TRUE(std::regex_search(refused.err, std::regex("the program alone holds [0-9]+ MB: raise --memory")))
      << refused.err;
  EXPECT_LACKS(refused.err, "scene.");
}

// How many gradient lanes a run gets, the units of work that threads share, and the memory that they take.

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
  SceneExtent extent{.bounds = {{-3, -3, -1}, {3, 3, 2}}, .near_m = 0.1, .far_m = 10, .pixel_footprint_m = 0.01};
  SceneManifest manifest{.classes = 13, .train_pixels = 1'000'000, .train_frames = 100, .labelled_frames = 100};
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
  const Session s = open_text(hash_config());
  const int lanes = s.pipeline->options().lanes;
  EXPECT_GT(lanes, 0);
  EXPECT_EQ(s.config.runtime.lanes, lanes);
  EXPECT_HAS(write_config(resolved_config(s.config)), "lanes: " + std::to_string(lanes));
  const Session same = open_text(hash_config("runtime: {lanes: " + std::to_string(lanes) + "}\n"));
  EXPECT_EQ(identity_hash(same.config), identity_hash(s.config));
  EXPECT_HAS(describe_session(s), std::to_string(lanes) + " lanes");
}

TEST(Lanes, ARunThatNamesItsNumberKeepsIt) {
  const Session s = open_text(hash_config("runtime: {lanes: 8}\n"));
  EXPECT_EQ(s.pipeline->options().lanes, 8);
  const Session again = open_text(write_config(resolved_config(s.config)));
  EXPECT_EQ(again.pipeline->options().lanes, 8);
}

std::size_t scratch_of(const std::string& yaml) {
  Session s = open_text(yaml);
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
      for (std::int64_t k = 0; k < 64; ++k) done[i] += mine(k, 0) == i ? 1 : 0;
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
