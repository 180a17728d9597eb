// Rays that are drawn for their labels and teach no colour: where they stand in a batch, and what the losses and
// gradients make of them.
#include <gtest/gtest.h>

#include <algorithm>
#include <numeric>
#include <string>
#include <vector>

#include "session/ray_source.h"
#include "tests/session/oracle.h"

namespace semfield {
namespace {

using namespace testing_train;

// With a branch of the position alone, so labels shape nothing else.
std::string config_of(const std::string& train, const std::string& more = "") {
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

  Registry registry = make_registry();
  for (const int tile_rays : {26, 8, 5, 1}) {
    SCOPED_TRACE(tile_rays);
    const std::string tiles = "runtime: {tile_rays: " + std::to_string(tile_rays) + "}\n";
    const Oracle apart(config_of(kApart, tiles), registry), together(config_of("labelled_share: 0.3", tiles), registry);
    const std::vector<std::int64_t>& apart_of_tile = apart.batch.label_only;
    EXPECT_EQ(std::accumulate(apart_of_tile.begin(), apart_of_tile.end(), std::int64_t{0}), 7);
    EXPECT_TRUE(together.batch.label_only.empty());
    std::int64_t labelled = 0;
    for (std::int64_t begin = 0; begin < 26; begin += tile_rays) {
      const std::int64_t end = std::min<std::int64_t>(begin + tile_rays, 26);
      const std::int64_t first = label_only_rays(0.3, begin, end);
      for (std::int64_t row = begin; row < begin + first; ++row)
        EXPECT_NE(apart.batch.label[static_cast<std::size_t>(row)], kVoid) << row;
      // The same rays as without, in another order at most.
      std::vector<float> with(apart.batch.target.begin() + 3 * begin, apart.batch.target.begin() + 3 * end);
      std::vector<float> without(together.batch.target.begin() + 3 * begin, together.batch.target.begin() + 3 * end);
      std::sort(with.begin(), with.end());
      std::sort(without.begin(), without.end());
      EXPECT_EQ(with, without);
      labelled += first;
    }
    EXPECT_EQ(labelled, 7);
    // A message about a row names the pixel that stands there.
    std::vector<std::string> places;
    for (std::int64_t row = 0; row < 26; ++row) places.push_back(apart.rays->place_of_row(3, row));
    std::vector<std::string> others;
    for (std::int64_t row = 0; row < 26; ++row) others.push_back(together.rays->place_of_row(3, row));
    std::sort(places.begin(), places.end());
    std::sort(others.begin(), others.end());
    EXPECT_EQ(places, others);
  }
}

TEST(LabelRays, TheirColoursCountForNothing) {
  Registry registry = make_registry();
  Oracle oracle(config_of(kApart, "runtime: {tile_rays: 13}\n"), registry);
  const StepLosses before = oracle.gradients();
  EXPECT_GT(before.color, 0);
  EXPECT_GT(before.semantic, 0);
  std::int64_t moved = 0;
  for (std::int64_t row = 0; row < 26; ++row) {
    const bool label_only = row % 13 < label_only_rays(0.3, row / 13 * 13, row / 13 * 13 + 13);
    BatchBuffers changed = oracle.batch;
    changed.target[static_cast<std::size_t>(3 * row)] = 1 - changed.target[static_cast<std::size_t>(3 * row)];
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
  Registry registry = make_registry();
  for (const auto& [train, counted] : {std::pair{kApart, 19}, std::pair{std::string("labelled_share: 0.3"), 26}}) {
    Oracle oracle(config_of(train), registry);
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
  std::string shared = config_of(kApart);  // the head behind the pass's own field: labels shape all of it
  const std::size_t branch = shared.find("    semantic: {");
  shared.erase(branch, shared.find('\n', branch) + 1 - branch);
  expect_finite_differences(shared, 2e-4);
  expect_same_gradients(config_of(kApart, "runtime: {lanes: 1, tile_rays: 26}\n"),
                        config_of(kApart, "runtime: {lanes: 3, tile_rays: 26}\n"));
}

}  // namespace
}  // namespace semfield
