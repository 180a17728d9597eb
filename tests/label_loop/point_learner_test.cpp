// The semantic part learned anew from points: what it learns, what it leaves alone, and the same bits for any threads.
#include "serve/point_learner.h"

#include "compute/parallel.h"
#include "core/rng.h"
#include "session/trainer.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

const std::string kBranch =
    "    semantic: {position: {type: frequency, frequencies: 3}, field: {type: tiny_mlp, hidden_width: 16, "
    "hidden_layers: 2}, dropout: 0.1}\n";

std::string config_of(bool branch) {
  return stratified_config("type: analytic_room", branch ? kBranch : "", "rays: 24");
}

// Points of three regions along x: class 0, 1 and 4 of the room's five.
struct Toy {
  std::vector<Vec3d> places;
  std::vector<std::int16_t> logit;

  explicit Toy(std::uint64_t seed, int count = 240) {
    const RandomAddress random{seed, 0, stream_id("point_learner_test")};
    std::uint64_t n = 0;
    const auto any = [&](double most) { return most * (2 * static_cast<double>(uniform01(random, n++)) - 1); };
    for (int i = 0; i < count; ++i) {
      const int region = i % 3;
      places.push_back({1.3 * (region - 1) + any(0.4), any(1), any(0.8)});
      logit.push_back(static_cast<std::int16_t>(region == 2 ? 4 : region));
    }
  }
};

PointLearning quick(std::int64_t steps = 120) { return PointLearning{.steps = steps, .batch = 192}; }

double share_right(PointLearner& learner, const Toy& toy, const std::vector<bool>& live) {
  const std::vector<float> p = learner.probabilities(learner.rows_at(toy.places), live);
  const auto width = static_cast<std::ptrdiff_t>(learner.classes());
  int right = 0;
  for (std::size_t i = 0; i < toy.logit.size(); ++i) {
    const auto row = p.begin() + static_cast<std::ptrdiff_t>(i) * width;
    right += std::max_element(row, row + width) - row == toy.logit[i] ? 1 : 0;
  }
  return static_cast<double>(right) / static_cast<double>(toy.logit.size());
}

TEST(PointLearner, LearnsWhatCanBeToldApart) {
  const Toy seen(1), other(2);
  const Session session = open_text(config_of(true));
  PointLearner learner(*session.pipeline);
  ASSERT_EQ(learner.classes(), 5);
  const std::vector<bool> live(5, true);
  EXPECT_LT(share_right(learner, other, live), 0.7);
  learner.learn(learner.rows_at(seen.places), seen.logit, {}, quick());
  EXPECT_GT(share_right(learner, seen, live), 0.95);
  EXPECT_GT(share_right(learner, other, live), 0.9) << "places that were not named";
}

TEST(PointLearner, LearnsTheSameBitsForAnyThreads) {
  const Toy toy(3);
  for (const bool branch : {false, true}) {
    std::vector<std::uint32_t> bits;
    std::vector<std::vector<float>> logits;
    for (const int threads : {1, 2, 3}) {
      set_thread_count(threads);
      const Session session = open_text(config_of(branch));
      PointLearner learner(*session.pipeline);
      const PointRows rows = learner.rows_at(toy.places);
      learner.learn(rows, toy.logit, {}, quick(20));
      bits.push_back(fingerprint(session.pipeline->store()));
      logits.push_back(learner.logits(rows));
    }
    set_thread_count(0);
    EXPECT_EQ(bits[1], bits[0]);
    EXPECT_EQ(bits[2], bits[0]);
    EXPECT_EQ(logits[1], logits[0]);
    EXPECT_EQ(logits[2], logits[0]);
  }
}

// Whatever was learned before: points state everything, and colour and geometry stand.
TEST(PointLearner, ChangesSemanticTensorsAloneAndForgetsWhatWasBefore) {
  const Toy toy(4), other(5);
  for (const bool branch : {false, true}) {
    SCOPED_TRACE(branch);
    Session session = open_text(config_of(branch));
    const auto rays = session.make_ray_source();
    Trainer trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule);
    for (int i = 0; i < 4; ++i) trainer.advance();
    ParamStore<float>& store = session.pipeline->store();
    const auto copy = [&](bool semantic) {
      std::vector<float> out;
      for (const Tensor<float>& t : store.all()) {
        if (t.rule.semantic != semantic || !is_stored(t.spec.role)) continue;
        for (const AlignedBuffer<float>* buffer : {&t.value, &t.moment1, &t.moment2})
          out.insert(out.end(), buffer->data(), buffer->data() + buffer->size());
      }
      return out;
    };
    const std::vector<float> field = copy(false), before = copy(true);
    PointLearner learner(*session.pipeline);
    const PointRows rows = learner.rows_at(toy.places);
    learner.learn(rows, toy.logit, {}, quick(10));
    const std::vector<float> learned = copy(true);
    EXPECT_EQ(copy(false), field);
    EXPECT_NE(learned, before);
    learner.learn(learner.rows_at(other.places), other.logit, {}, quick(10));
    EXPECT_NE(copy(true), learned);
    learner.learn(rows, toy.logit, {}, quick(10));
    EXPECT_EQ(copy(true), learned);
    EXPECT_EQ(copy(false), field);
    for (const Tensor<float>& t : store.all()) {
      for (const AlignedBuffer<float>* buffer : {&t.moment1, &t.moment2, &t.grad, &t.lanes}) {
        if (!t.rule.semantic) continue;
        EXPECT_TRUE(std::all_of(buffer->data(), buffer->data() + buffer->size(), [](float x) { return x == 0; }))
            << t.name;
      }
    }
    trainer.advance();  // training goes on from there
    EXPECT_NE(copy(false), field);
  }
}

TEST(PointLearner, ClassesWithoutLabelsHaveNoProbability) {
  const Toy toy(6, 30);
  const Session session = open_text(config_of(true));
  PointLearner learner(*session.pipeline);
  const PointRows rows = learner.rows_at(toy.places);
  const std::vector<bool> live{true, false, false, true, true};
  const std::vector<float> p = learner.probabilities(rows, live), logits = learner.logits(rows);
  for (std::size_t i = 0; i < 30; ++i) {
    double norm = 0, sum = 0;
    for (std::size_t c = 0; c < 5; ++c) norm += live[c] ? std::exp(static_cast<double>(logits[5 * i + c])) : 0;
    for (std::size_t c = 0; c < 5; ++c) {
      const auto found = static_cast<double>(p[5 * i + c]);
      EXPECT_NEAR(found, live[c] ? std::exp(static_cast<double>(logits[5 * i + c])) / norm : 0, 1e-5);
      EXPECT_TRUE(live[c] || found == 0);
      sum += found;
    }
    EXPECT_NEAR(sum, 1, 1e-5);
  }
  for (const float found : learner.probabilities(rows, std::vector<bool>(5, false))) EXPECT_EQ(found, 0);
  std::vector<float> extreme{1e30F, -1e30F, 0, -1e30F, 90, 90};
  softmax_live(extreme, 3, {true, true, true});
  EXPECT_EQ(extreme, (std::vector<float>{1, 0, 0, 0, 0.5F, 0.5F}));
}

TEST(PointLearner, NoPointsAreFine) {
  const Session session = open_text(config_of(true));
  PointLearner learner(*session.pipeline);
  const std::uint32_t start = fingerprint(session.pipeline->store());
  const PointRows none = learner.rows_at({});
  EXPECT_EQ(none.count(), 0);
  const Toy toy(7);
  learner.learn(learner.rows_at(toy.places), toy.logit, {}, quick(3));
  EXPECT_NE(fingerprint(session.pipeline->store()), start);
  learner.learn(none, {}, {}, quick());
  EXPECT_EQ(fingerprint(session.pipeline->store()), start);
  EXPECT_TRUE(learner.logits(none).empty());
  EXPECT_TRUE(learner.probabilities(none, std::vector<bool>(5, true)).empty());
  // Points without a logit or a weight are no points.
  learner.learn(learner.rows_at(toy.places), std::vector<std::int16_t>(toy.logit.size(), kVoid), {}, quick(3));
  EXPECT_EQ(fingerprint(session.pipeline->store()), start);
  learner.learn(learner.rows_at(toy.places), toy.logit, std::vector<float>(toy.logit.size(), 0.0F), quick(3));
  EXPECT_EQ(fingerprint(session.pipeline->store()), start);
}

// One place named as two classes: the heavier is believed.
TEST(PointLearner, WeightsTellHowOftenAPointIsDrawn) {
  const Session session = open_text(config_of(true));
  PointLearner learner(*session.pipeline);
  const Toy toy(8, 60);
  std::vector<Vec3d> places = toy.places;
  places.insert(places.end(), toy.places.begin(), toy.places.end());
  std::vector<std::int16_t> logit(60, 2);
  logit.resize(120, 3);
  for (const bool first : {true, false}) {
    std::vector<float> weight(60, first ? 10.0F : 1.0F);
    weight.resize(120, first ? 1.0F : 10.0F);
    learner.learn(learner.rows_at(places), logit, weight, quick(60));
    const std::vector<float> p = learner.probabilities(learner.rows_at(toy.places), std::vector<bool>(5, true));
    double two = 0, three = 0;
    for (std::size_t i = 0; i < 60; ++i) {
      two += static_cast<double>(p[5 * i + 2]) / 60;
      three += static_cast<double>(p[5 * i + 3]) / 60;
    }
    // 10 to the power of 3/4 : 1
    EXPECT_NEAR(first ? two : three, 5.62 / 6.62, 0.08);
    EXPECT_NEAR(first ? three : two, 1 / 6.62, 0.08);
  }
}

}  // namespace
}  // namespace semfield
