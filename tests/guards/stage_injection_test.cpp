// A bad value of one ray at every stage of a step and of rendering: named with frame and pixel, nothing changed.
#include <gtest/gtest.h>

#include "tests/guards/poison.h"

namespace semfield {
namespace {

using namespace testing_guards;

constexpr const char* kHash = "one pass, learned encoder";
constexpr const char* kTwo = "two passes";

std::string hash_yaml() {
  std::string yaml = poisoned(testing_train::hash_config());
  yaml.replace(yaml.find("rays: 192"), 9, "rays: 48");
  return yaml;
}
std::string two_pass_yaml() {
  std::string yaml = poisoned(testing_train::two_pass_config());
  yaml.replace(yaml.find("rays: 64"), 8, "rays: 24");
  return yaml;
}

struct Place {
  std::string config, pass, number;
};

void spoil_stages_of_training(const std::string& yaml, const Place& place, bool learned_encoder) {
  Registry registry = make_poisoned_registry();
  Subject subject(yaml, registry, 3);
  std::vector<std::string> stages{"distance",    "interval", "encoded position", "encoded direction",
                                  "raw density", "colour",   "feature",          "gradient of the field"};
  if (learned_encoder) stages.push_back("gradient of the encoded position");
  std::int64_t row = 5;
  for (const std::string& stage : stages) {
    std::vector<BadValue> values = non_finite_values();
    if (stage == "interval") values.push_back({"negative", -0.25F});
    if (stage.rfind("gradient", 0) == 0) values.push_back({"huge", 1e30F});
    for (const BadValue& bad : values) {
      row = (row + 7) % subject.session.config.train.rays;
      const std::string pixel = subject.aim(row);
      poison().stage = stage;
      poison().pass = place.number;
      poison().value = bad.value;
      for (const Pass<float>& pass : subject.session.pipeline->passes()) {
        if (pass.parts().name == place.pass) poison().domain = pass.parts().domain;
      }
      std::vector<std::string> words{"step 3", "nothing was changed"};
      const bool sums = bad.name == std::string("huge");  // one ray's share is a number: the sum's square is not
      if (!sums) words.push_back(pixel);
      if (stage.rfind("gradient", 0) != 0) words.push_back(stage);
      if (stage == "gradient of the field") words.push_back("'" + place.pass + "/field/");
      if (!sums && stage == "gradient of the encoded position") words.push_back(stage);
      expect_caught(subject, "stage of training, " + place.config, place.pass + ": " + stage + " " + bad.name, words);
    }
  }
  // What is left behind by all the failures: nothing. The next step has the bits of a run that never failed.
  poison() = {};
  Subject clean(yaml, registry, 4);
  subject.trainer->advance();
  EXPECT_TRUE(Snapshot(subject) == Snapshot(clean)) << "a failed step left something behind";
}

TEST(StageInjection, LearnedEncoder) { spoil_stages_of_training(hash_yaml(), {kHash, "main", "0"}, true); }
TEST(StageInjection, CoarsePass) { spoil_stages_of_training(two_pass_yaml(), {kTwo, "coarse", "0"}, false); }
TEST(StageInjection, FinePass) { spoil_stages_of_training(two_pass_yaml(), {kTwo, "fine", "1"}, false); }

std::string message_of_evaluation(Subject& subject, const std::vector<int>& frames) {
  try {
    evaluate(*subject.session.pipeline, subject.session.eval_job(frames), subject.session.limits,
             subject.session.plan.class_of_logit);
  } catch (const Error& error) {
    return error.what();
  }
  return {};
}

void spoil_rendering(const std::string& yaml, const Place& place) {
  Registry registry = make_poisoned_registry();
  Subject subject(yaml, registry, 3);
  const std::vector<int> test = subject.session.scene.frames_of(Split::test);
  ASSERT_FALSE(test.empty());
  const FrameInfo& info = subject.session.scene.info.frames[static_cast<std::size_t>(test[0])];
  const Snapshot before(subject);
  std::int64_t pixel = 611;
  for (const char* stage :
       {"distance", "interval", "encoded position", "encoded direction", "raw density", "colour", "feature"}) {
    for (const BadValue& bad : non_finite_values()) {
      pixel = (pixel + 131) % (std::int64_t{info.camera.width_px} * info.camera.height_px);
      Poison& p = poison();
      p = {};
      p.stage = stage;
      p.pass = place.number;
      p.value = bad.value;
      p.ray = pixel;
      p.in_training = false;
      p.domain = subject.session.pipeline->passes().back().parts().domain;
      const std::int64_t x = pixel % info.camera.width_px, y = pixel / info.camera.width_px;
      double origin[3], direction[3], limits[2];
      cast_ray({info.camera, info.world_from_camera, false}, subject.session.limits, static_cast<std::int32_t>(x),
               static_cast<std::int32_t>(y), origin, direction, limits);
      p.origin = {origin[0], origin[1], origin[2]};
      p.direction = {direction[0], direction[1], direction[2]};
      const std::string message = message_of_evaluation(subject, {test[0]});
      const std::string want = "pixel x " + std::to_string(x) + ", y " + std::to_string(y);
      const bool caught = message.find(want) != std::string::npos && message.find(stage) != std::string::npos &&
                          message.find("frame '" + info.name + "'") != std::string::npos;
      EXPECT_TRUE(caught) << stage << ' ' << bad.name << ", " << want << ": " << message;
      tally().add("stage of rendering, " + place.config, caught);
    }
  }
  poison() = {};
  EXPECT_EQ(message_of_evaluation(subject, {test[0]}), "");
  EXPECT_TRUE(Snapshot(subject) == before);
}

TEST(StageInjection, RenderingWithAnOccupancyGrid) { spoil_rendering(hash_yaml(), {kHash, "main", "0"}); }
TEST(StageInjection, RenderingWithTwoPasses) { spoil_rendering(two_pass_yaml(), {kTwo, "fine", "1"}); }

TEST(StageInjection, DensityAskedForByPosition) {
  Registry registry = make_poisoned_registry();
  Subject subject(hash_yaml(), registry, 3);
  for (const BadValue& bad : non_finite_values()) {
    poison().stage = "queried density";
    poison().in_training = false;
    poison().value = bad.value;
    std::vector<double> positions{0.1, 0.2, 0.3, -0.4, 0.5, 0.6, 0.7, 0.2, 0.1};
    std::vector<float> sigma(3);
    std::string message;
    try {
      subject.session.pipeline->density({positions.data(), 3, 3}, {sigma.data(), 3, 1});
    } catch (const Error& error) {
      message = error.what();
    }
    const bool caught = message.find("density at (") != std::string::npos;
    EXPECT_TRUE(caught) << bad.name << ": " << message;
    tally().add("density by position", caught);
  }
}

// The grid asks for densities after the update: the step counts, the grid keeps its bits.
TEST(StageInjection, DensityThatTheOccupancyGridAsksFor) {
  Registry registry = make_poisoned_registry();
  for (const BadValue& bad : non_finite_values()) {
    Subject subject(hash_yaml(), registry, 15), clean(hash_yaml(), registry, 16);
    const Snapshot before(subject);
    poison().stage = "queried density";
    poison().in_training = true;
    poison().value = bad.value;
    const std::string message = message_of_step(*subject.trainer);
    poison() = {};
    const Snapshot after(subject), wanted(clean);
    bool caught = message.find("density at (") != std::string::npos && after.step == 16;
    for (const auto& [name, bits] : after.bits) {
      const bool is_grid = name.rfind("main/sampler", 0) == 0;
      caught = caught && bits == (is_grid ? before : wanted).bits.at(name);
    }
    EXPECT_TRUE(caught) << bad.name << ": " << message;
    tally().add("density that a sampler asks for", caught);
  }
}

}  // namespace
}  // namespace semfield
