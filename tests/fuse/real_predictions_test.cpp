// Real predictions of two networks on frames of Replica, fused with the true depth, where the data are at hand.
#include <gtest/gtest.h>

#include "datasets/replica/replica.h"
#include "loading/frame_source.h"
#include "surface/fuse/scene_fusion.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

const std::string kRoot = std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/replica_apartment0";

LoadedScene apartment(const std::string& label_dir, int train_step) {
  ReplicaParams p;
  p.root = kRoot;
  p.label_dir = label_dir;
  p.train_step = train_step;
  p.test_step = 0;
  Replica replica(p, {});
  Diagnostics diagnostics;
  return load_scene(replica, {}, diagnostics);
}

// Total accuracy and mean IoU over the classes present, of the monocular predictions and of their fusion.
struct Figures {
  double monocular = 0, bayesian = 0, average = 0;
  double miou_monocular = 0, miou_bayesian = 0;
};

Figures fuse_predictions(const std::string& network, int train_step) {
  const LoadedScene scene = apartment("semantic_class", train_step);
  const LoadedScene predicted = apartment(network, train_step);
  TrainingLabels labels;
  for (const StoredFrame& frame : predicted.frames) labels.frames.push_back({frame.label, {}});
  const SceneFusion fusion = fuse_scene(scene, labels, true_depth(scene), {}, nullptr);
  EXPECT_EQ(fusion.scores.size(), 3u);
  const auto accuracy = [&](std::size_t k) { return *fusion.scores[k].confusion.total_accuracy(); };
  const auto miou = [&](std::size_t k) { return *fusion.scores[k].confusion.miou_present(); };
  return {accuracy(0), accuracy(1), accuracy(2), miou(0), miou(1)};
}

TEST(RealPredictions, MonocularIsAsItsMakersMeasured) {
  if (!std::filesystem::exists(kRoot)) GTEST_SKIP() << "the optional Replica frames are not at hand";
  for (const auto& [network, accuracy] : {std::pair{"cnn_strong", 0.859}, std::pair{"cnn_weak", 0.428}}) {
    const LoadedScene scene = apartment("semantic_class", 1), predicted = apartment(network, 1);
    ConfusionMatrix all(scene.info.classes.valid_count());
    for (std::size_t f = 0; f < scene.frames.size(); ++f)
      all.add(scene.frames[f].label.expand(), predicted.frames[f].label.expand());
    EXPECT_NEAR(*all.total_accuracy(), accuracy, 0.001) << network;
  }
}

TEST(RealPredictions, FusionImprovesAStrongNetwork) {
  if (!std::filesystem::exists(kRoot)) GTEST_SKIP() << "the optional Replica frames are not at hand";
  const Figures f = fuse_predictions("cnn_strong", 2);
  EXPECT_NEAR(f.monocular, 0.8596, 0.0005);
  EXPECT_GT(f.bayesian, f.monocular + 0.01);
  EXPECT_GT(f.miou_bayesian, f.miou_monocular);
  EXPECT_EQ(f.bayesian, f.average);  // labels without probabilities: both count votes
}

TEST(RealPredictions, MistakesThatAllViewsShareStay) {
  if (!std::filesystem::exists(kRoot)) GTEST_SKIP() << "the optional Replica frames are not at hand";
  const Figures f = fuse_predictions("cnn_weak", 2);
  EXPECT_NEAR(f.monocular, 0.426, 0.001);
  EXPECT_NEAR(f.bayesian, f.monocular, 0.005);
}

}  // namespace
}  // namespace semfield
