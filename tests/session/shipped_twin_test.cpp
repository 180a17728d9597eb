// The shipped twin of the quickstart with frequency encodings keeps its density.
#include <gtest/gtest.h>

#include <utility>

#include "session/training.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

// A network that loses all density within its first hundred steps is refused by the trainer.
TEST(ShippedConfigurations, TheFrequencyTwinOfTheQuickstartTrainsPastItsFirstSteps) {
  Registry registry = make_registry();
  if (registry.find(PluginKind::dataset, "obj_room") == nullptr) GTEST_SKIP() << "this build casts no rays into meshes";
  for (const char* seed : {"runtime.seed=1", "runtime.seed=2"}) {
    RunConfig config = load_run_config(
        SEMFIELD_SOURCE_DIR "/configs/quickstart_frequency.yaml",
        {seed, "train.rays=128", "scene.frames=12", "scene.test_frames=2", "scene.width_px=48", "scene.height_px=36"},
        registry);
    Training training(std::move(config), registry);
    training.train(1);
    const double first = training.losses().total;
    EXPECT_EQ(training.train(129), 129) << seed;
    EXPECT_LT(training.losses().total, first) << seed;
  }
}

}  // namespace
}  // namespace semfield
