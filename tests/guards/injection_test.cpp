// A bad number in every tensor of a run and in every stage of a pass: each is named.
#include <cstring>

#include "compute/math_functions.h"
#include "losses/semantic_cross_entropy.h"
#include "model/compositor.h"
#include "model/optim/adam.h"
#include "model/ray_guard.h"
#include "tests/guards/poison.h"

namespace semfield {
namespace {

using namespace testing_guards;

std::string small(std::string yaml) {
  const std::size_t at = yaml.find("rays: ") + 6;
  yaml.replace(at,
               yaml.find(',', at) == std::string::npos ? yaml.find('}', at) - at
                                                       : std::min(yaml.find(',', at), yaml.find('}', at)) - at,
               "16");
  return yaml;
}

std::string element_words(const Tensor<float>& t, std::int64_t element) {
  return "row " + std::to_string(element / t.spec.cols) + ", column " + std::to_string(element % t.spec.cols);
}

bool in_window(const Tensor<float>& t, std::int64_t element, std::int64_t step) {
  const std::int64_t rows = (t.spec.rows + kTableWindows - 1) / kTableWindows;
  return element / t.spec.cols / rows == step % kTableWindows;
}

// An element of a sparse tensor that the coming step touches, in the window that it looks at or out of it; the middle
// of any other.
std::int64_t element_of(Subject& subject, const Tensor<float>& t, bool windowed = true) {
  if (t.spec.role != TensorRole::sparse) return t.size() / 2;
  BatchBuffers batch;
  subject.rays->fill(subject.trainer->step(), batch);
  subject.session.pipeline->gradients(subject.trainer->step(), batch.view(true));
  std::int64_t element = -1;
  for (std::int64_t i = 0; i < t.size() && element < 0; ++i) {
    const bool touched = t.grad.data()[i] != 0;
    element = touched && in_window(t, i, subject.trainer->step()) == windowed ? i : -1;
  }
  subject.store().clear_gradients();
  return element;
}

class TensorInjection : public ::testing::TestWithParam<const char*> {
 protected:
  std::string yaml() const {
    return small(std::string(GetParam()) == "hash" ? testing_train::hash_config() : testing_train::two_pass_config());
  }
};

// Puts `value` at `place`, tries a step, takes it away again.
void spoil(Subject& subject, const std::string& kind, const Tensor<float>& t, float* place, const BadValue& bad,
           std::vector<std::string> words) {
  const float good = *place;
  *place = bad.value;
  words.insert(words.end(), {"'" + t.name + "'", "nothing was changed"});
  expect_caught(subject, kind, t.name + " " + kind + " " + bad.name, words);
  *place = good;
}

TEST_P(TensorInjection, EveryTensorIsNamed) {
  Registry registry = testing_train::make_registry();
  Subject subject(yaml(), registry, 2);
  std::vector<BadValue> with_huge = non_finite_values(), second = non_finite_values();
  with_huge.push_back({"huge", -1e30F});
  second.push_back({"negative", -1});
  for (Tensor<float>& t : subject.store().all()) {
    if (t.spec.role == TensorRole::rearranged) continue;  // made anew from a learned one before each step
    const std::int64_t at = element_of(subject, t);
    ASSERT_GE(at, 0) << t.name << " is touched by no ray";
    const std::string element = element_words(t, at);
    if (!t.learned()) {
      const char* kind = t.spec.role == TensorRole::state ? "value of a state tensor" : "value of a derived tensor";
      for (const BadValue& bad : non_finite_values()) spoil(subject, kind, t, t.value.data() + at, bad, {element});
      continue;
    }
    for (const BadValue& bad : with_huge) {
      spoil(subject, "value", t, t.value.data() + at, bad, {element});
      // A gradient of lane 0 for what lanes sum, else the one that the encoder adds to.
      float* const gradient = t.lanes.size() > 0 ? t.lanes.data() + at : t.grad.data() + at;
      spoil(subject, "gradient", t, gradient, bad, {"the gradient of", element});
      subject.store().clear_gradients();
      spoil(subject, "first moment", t, t.moment1.data() + at, bad, {"the first moment of", element});
    }
    for (const BadValue& bad : second)
      spoil(subject, "second moment", t, t.moment2.data() + at, bad, {"the second moment of", element});
  }
  Subject clean(yaml(), registry, 3);
  subject.trainer->advance();
  EXPECT_TRUE(Snapshot(subject) == Snapshot(clean)) << "a failed step left something behind";
}

// Moments of a table's rows that are not in the step's window: found when their turn comes or when the value that they
// spoil is read, whatever comes first; nothing like it is ever saved.
TEST(TensorInjectionOfTables, MomentsOutOfTheWindowAreFoundInTheirTurn) {
  Registry registry = testing_train::make_registry();
  std::vector<std::string> names;
  Subject any(small(testing_train::hash_config()), registry, 0);
  for (const Tensor<float>& t : any.store().all()) {
    if (t.spec.role == TensorRole::sparse) names.push_back(t.name);
  }
  ASSERT_EQ(names.size(), 6u);
  for (const std::string& name : names) {
    for (const bool second : {false, true}) {
      Subject subject(small(testing_train::hash_config()), registry, 2);
      const Tensor<float>& t = *subject.store().find(name);
      const std::int64_t at = element_of(subject, t, false);
      ASSERT_GE(at, 0);
      (second ? t.moment2 : t.moment1).data()[at] = non_finite_values()[0].value;
      EXPECT_THROW(subject.trainer->check_storable(), Error);
      std::string message;
      for (int i = 0; i < kTableWindows && message.empty(); ++i) message = message_of_step(*subject.trainer);
      const bool caught = message.find("'" + name + "'") != std::string::npos;
      EXPECT_TRUE(caught) << name << ": " << message;
      tally().add("moment out of the window", caught);
    }
  }
}

TEST_P(TensorInjection, NoCheckpointHoldsABadNumber) {
  Registry registry = testing_train::make_registry();
  Subject subject(yaml(), registry, 2);
  EXPECT_NO_THROW(subject.trainer->check_storable());
  for (Tensor<float>& t : subject.store().all()) {
    if (!is_stored(t.spec.role)) continue;
    for (const AlignedBuffer<float>* buffer : {&t.value, &t.moment1, &t.moment2}) {
      if (buffer->size() == 0) continue;
      float& place = buffer->data()[buffer->size() - 1];  // of a table: a row that perhaps no ray ever touched
      const float good = place;
      place = non_finite_values()[0].value;
      const std::string message = error_of([&] { subject.trainer->check_storable(); });
      place = good;
      const bool caught = message.find("'" + t.name + "'") != std::string::npos &&
                          message.find(element_words(t, t.size() - 1)) != std::string::npos;
      EXPECT_TRUE(caught) << t.name << ": " << message;
      tally().add("state that would be saved", caught);
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Runs, TensorInjection, ::testing::Values("hash", "two_pass"),
                         [](const auto& test) { return std::string(test.param); });

// A bad value of one ray at every stage of a step and of rendering: named with frame and pixel, nothing changed.

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
      const bool sums = bad.name == std::string("huge");  // one ray's part is a number: the sum's square is not
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
  return error_of([&] {
    evaluate(*subject.session.pipeline, subject.session.eval_job(frames), subject.session.limits,
             subject.session.plan.class_of_logit);
  });
}

void spoil_rendering(const std::string& yaml, const Place& place) {
  Registry registry = make_poisoned_registry();
  Subject subject(yaml, registry, 3);
  const std::vector<int> test = subject.session.scene.frames_of(Split::test);
  ASSERT_FALSE(test.empty());
  const FrameInfo& info = subject.session.scene.info.frames[test[0]];
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
    const std::string message = error_of([&] {
      subject.session.pipeline->density({positions.data(), 3, 3}, {sigma.data(), 3, 1});
    });
    const bool caught = message.find("density at (") != std::string::npos;
    EXPECT_TRUE(caught) << bad.name << ": " << message;
    tally().add("density by position", caught);
  }
}

// The grid reads densities after the update: the step counts, the grid keeps its bits.
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
