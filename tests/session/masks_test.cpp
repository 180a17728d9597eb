// What a mask hides changes no bit of a training and no score.
#include <algorithm>

#include "session/training.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

std::string masked_room(int masked, int behind, const std::string& ray_source = "auto") {
  std::string yaml = with_scene(hash_config(), "{type: analytic_room, masked: " + std::to_string(masked) +
                                                   ", behind: " + std::to_string(behind) + "}");
  return yaml.replace(yaml.find("rays: 192"), 9, "rays: 128, ray_source: " + ray_source);
}

using Values = std::vector<std::pair<std::string, std::optional<double>>>;

Values scores_of(const std::string& yaml) {
  Session s = open_text(yaml);
  EvalJob job = s.eval_job(s.scene.frames_of(Split::test));
  job.fit_colors = true;
  return evaluate(*s.pipeline, job, s.limits, s.plan.class_of_logit).values();
}

TEST(Masks, WhatLiesBehindThemChangesNoBitOfATraining) {
  for (const char* source : {"all_images", "one_image", "label_balanced"}) {
    SCOPED_TRACE(source);
    const auto trained = [&](int masked, int behind) {
      return train_fingerprint(masked_room(masked, behind, source), 2, 20);
    };
    const std::uint32_t first = trained(1, -1);
    EXPECT_EQ(first, trained(1, 7));
    EXPECT_EQ(first, trained(1, 250));
    EXPECT_NE(first, trained(2, -1)) << "other pixels are masked";
    EXPECT_NE(first, trained(0, -1)) << "none is masked";
  }
}

TEST(Masks, WhatLiesBehindThemIsInNoScore) {
  const Values first = scores_of(masked_room(1, -1));
  EXPECT_EQ(first, scores_of(masked_room(1, 7)));
  EXPECT_EQ(first, scores_of(masked_room(1, 250)));
  const Values open = scores_of(masked_room(0, -1));
  ASSERT_EQ(first.size(), open.size());
  EXPECT_NE(first, open);
}

TEST(Masks, NoRayIsDrawnForAMaskedPixel) {
  Session s = open_text(masked_room(3, -1));
  const auto rays = s.make_ray_source();
  for (std::int64_t ray = 0; ray < 2000; ++ray) {
    const RaySource::Pixel pixel = rays->choose(1, ray);
    const int frame = s.drawn_frames()[static_cast<std::size_t>(pixel.frame)];
    EXPECT_TRUE(s.scene.frames[static_cast<std::size_t>(frame)].mask.uses(static_cast<std::size_t>(pixel.index)));
  }
}

TEST(Masks, ASceneOfWhichEveryPixelIsMaskedIsRefused) {
  EXPECT_ERROR(open_text(masked_room(4, -1)), "scene.mask.all", "analytic_room", "every pixel");
}

}  // namespace
}  // namespace semfield
