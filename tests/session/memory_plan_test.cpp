// Predicted memory against what runs take, and the refusal of what does not fit.
#include "session/memory_plan.h"

#include <gtest/gtest.h>

#include <cmath>
#include <regex>

#include "datasets/obj_room/raycast.h"
#include "session/trainer.h"
#include "system/memory_limit.h"
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
  double over = 0.1;  ///< share by which the plan may lie above
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
  EXPECT_NE(refused.err.find("frames would take"), std::string::npos) << refused.err;
  EXPECT_NE(refused.err.find("scene.load.downscale="), std::string::npos) << refused.err;
}

TEST_F(MemoryPlanOfRuns, WhereTheProgramAloneDoesNotFitNoSceneIsProposed) {
  const TempDir folder;
  const auto refused = semfield_run("train" + words_for(kRuns[0]) + " --dry-run --memory 0.01", folder.path());
  EXPECT_EQ(refused.code, 69);
  EXPECT_TRUE(std::regex_search(refused.err, std::regex("the program alone holds [0-9]+ MB: raise --memory")))
      << refused.err;
  EXPECT_EQ(refused.err.find("scene."), std::string::npos) << refused.err;
}

}  // namespace
}  // namespace semfield
