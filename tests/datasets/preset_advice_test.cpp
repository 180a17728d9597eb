// The preset that `semfield inspect` advises is the one that trained best: docs/evidence/scenes.md has the figures.
#include "app/scene/preset_advice.h"

#include <gtest/gtest.h>

#include <functional>
#include <memory>

#include "datasets/colmap/colmap.h"
#include "datasets/llff/llff.h"
#include "datasets/replica/replica.h"
#include "datasets/transforms_json/transforms_json.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

std::string data(const std::string& name) { return std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/" + name; }

template <class Reader, class Params>
std::function<std::unique_ptr<Dataset>(const std::string&)> reads() {
  return [](const std::string& root) -> std::unique_ptr<Dataset> {
    Params params;
    params.root = root;
    return std::make_unique<Reader>(params, DatasetBuild{});
  };
}
const auto kTransforms = reads<TransformsJson, TransformsJsonParams>();

struct Measured {
  const char *name, *folder, *preset;
  std::function<std::unique_ptr<Dataset>(const std::string&)> reader;
  int width_px;
};
void PrintTo(const Measured& m, std::ostream* out) { *out << m.name; }

class PresetAdviceOf : public testing::TestWithParam<Measured> {};

TEST_P(PresetAdviceOf, IsWhatTrainedBest) {
  const Measured& scene = GetParam();
  if (!std::filesystem::exists(data(scene.folder)))
    GTEST_SKIP() << "the optional scene " << scene.folder << " is not at hand";
  SceneLoadOptions options;
  options.width_px = scene.width_px;
  options.depth = DepthKept::none;
  Diagnostics d;
  const LoadedScene loaded = load_scene(*scene.reader(data(scene.folder)), options, d);
  EXPECT_FALSE(d.has_errors());
  const std::optional<PresetAdvice> advice = advised_preset(loaded);
  ASSERT_TRUE(advice);
  EXPECT_EQ(advice->preset, std::string("parts/") + scene.preset) << advice->why;
  EXPECT_FALSE(advice->background) << "white is the preset's own";
}

INSTANTIATE_TEST_SUITE_P(
    RealScenes, PresetAdviceOf,
    testing::Values(Measured{"bonsai", "bonsai360", "hash_room.yaml", kTransforms, 400},
                    Measured{"bonsai_llff", "bonsai360", "hash_room.yaml", reads<Llff, LlffParams>(), 400},
                    Measured{"llff_room", "llff_room", "hash_room.yaml", kTransforms, 400},
                    Measured{"studio", "studio_room", "hash_room.yaml", kTransforms, 480},
                    Measured{"studio_colmap", "studio_room", "hash_room.yaml", reads<Colmap, ColmapParams>(), 480},
                    Measured{"hololens", "hololens_room", "hash_room.yaml", kTransforms, 180},
                    Measured{"shelf", "shelf_bin", "hash_room.yaml", kTransforms, 160},
                    Measured{"lego", "lego", "object.yaml", kTransforms, 200},
                    Measured{"replica", "replica_apartment0", "hash_room.yaml", reads<Replica, ReplicaParams>(), 160}),
    [](const auto& row) { return row.param.name; });

// Forward-facing photographs: the box of what is seen and not that of the view cones.
TEST(SceneBounds, CornersTellWhereAForwardFacingRoomIs) {
  if (!std::filesystem::exists(data("llff_room"))) GTEST_SKIP() << "the optional scene llff_room is not at hand";
  SceneLoadOptions options;
  options.width_px = 400;
  Diagnostics d;
  const LoadedScene scene = load_scene(*kTransforms(data("llff_room")), options, d);
  EXPECT_NE(scene.bounds_from.find("corners found again"), std::string::npos) << scene.bounds_from;
  EXPECT_GT(scene.near_m, 3);  // LLFF's own figures are 8.9 to 47
  EXPECT_LT(scene.near_m, 14);
  EXPECT_GT(scene.far_m, 45);
  EXPECT_LT(scene.far_m, 70);
}

LoadedScene inward_scene(double reach, std::size_t corners) {
  LoadedScene scene;
  scene.bounds = {{-1, -1, -1}, {1, 1, 1}};
  scene.rig.inward = true;
  scene.rig.distance_m = 2;
  for (std::size_t i = 0; i < corners; ++i) {
    const double away = i % 3 == 0 ? 2 * reach : 1;
    scene.corners.x.push_back(static_cast<float>(away));
    scene.corners.y.push_back(0);
    scene.corners.z.push_back(0);
    scene.corners.distance.push_back(1);
  }
  return scene;
}

TEST(PresetAdvice, SurroundingsThatEndAreARoom) {
  EXPECT_EQ(advised_preset(inward_scene(3, 600))->preset, "parts/hash_room.yaml");
  EXPECT_EQ(advised_preset(inward_scene(20, 600))->preset, "parts/unbounded.yaml");
  EXPECT_EQ(advised_preset(inward_scene(3, 20))->preset, "parts/unbounded.yaml") << "too few corners to say";
}

}  // namespace
}  // namespace semfield
