// Clicks in the analytic room: what they name, what undoing them leaves, what a surface made anew keeps of them, and
// how sure the labels are.

#include "core/rng.h"
#include "testkit/compare.h"
#include "tests/label_loop/labelled_room.h"
#include "tests/session/oracle.h"
#include "tests/threads.h"

namespace semfield {
namespace {

using namespace testing_loop;

TEST(LabelLoop, BeforeTheFirstClickNothingIsNamed) {
  LoopedRoom room(0);
  LabelLoop& loop = *room.loop;
  EXPECT_EQ(loop.views().size(), room.training->session().drawn_frames().size());
  EXPECT_FALSE(loop.ready());
  EXPECT_FALSE(loop.propose(1, 0).has_value());
  EXPECT_EQ(loop.labels_of(0).label, std::vector<std::int16_t>(48 * 36, kVoid)) << "no surface yet";
  room.training->train(20);
  for (std::size_t v = 0; v < loop.views().size(); ++v) {
    EXPECT_FALSE(loop.ready());
    const bool made = loop.update_surfaces(0);  // no time: one view per call
    EXPECT_FALSE(made);
    EXPECT_FALSE(loop.views()[v].map.empty());
  }
  EXPECT_TRUE(loop.update_surfaces(0));
  EXPECT_TRUE(loop.ready());
  EXPECT_FALSE(loop.update_surfaces(1e9)) << "nothing is due";
  EXPECT_FALSE(loop.learned());
  EXPECT_TRUE(loop.pool_probability().empty());
  const ViewLabels labels = loop.labels_of(0);
  EXPECT_EQ(labels.label, std::vector<std::int16_t>(48 * 36, kVoid));
  EXPECT_EQ(loop.propose(1, 0)->why, "unseen");
}

// The loop proposes, and gets true labels.
TEST(LabelLoop, AFewClicksNameMostOfTheRoom) {
  LoopedRoom room;
  LabelLoop& loop = *room.loop;
  std::vector<LabelledPixels> clicks;
  for (std::uint64_t round = 0; round < 16; ++round) {
    const std::optional<Asked> asked = loop.propose(1, round);
    ASSERT_TRUE(asked.has_value());
    const PoolPoint& point = loop.pool().points[asked->point];
    clicks.push_back(room.click(point.view, point.pixel));
    loop.learn(clicks);
  }
  EXPECT_TRUE(loop.learned());
  std::vector<bool> named(5, false);
  for (const LabelledPixels& click : clicks) named[click.class_index] = true;
  EXPECT_EQ(loop.live(), named);
  EXPECT_EQ(std::count(named.begin(), named.end(), true), 5) << "questions find the small classes, too";
  EXPECT_GT(room.share_right(), 0.85) << "more than half of all is wall";
  for (std::size_t v = 0; v < loop.views().size(); ++v) {
    for (const std::int16_t label : loop.labels_of(static_cast<int>(v)).label)
      EXPECT_TRUE(label == kVoid || named[label]) << label;
  }
}

TEST(LabelLoop, ASurfaceOfEveryPixelIsDrawnAsItIs) {
  LoopedRoom room;
  LabelLoop& loop = *room.loop;
  loop.learn(room.clicks(8));
  const SurfaceMap fine = loop.map_of(2, 1);
  const ViewLabels labels = loop.labels_of(2, &fine), coarse = loop.labels_of(2);
  double same = 0, right = 0;
  for (std::size_t i = 0; i < labels.label.size(); ++i) {
    EXPECT_EQ(labels.label[i] == kVoid, !(fine.distance_m[i] > 0));
    same += labels.label[i] == coarse.label[i];
    right += labels.label[i] == room.truth(2, {static_cast<int>(i) % 48, static_cast<int>(i) / 48});
  }
  EXPECT_GT(same, 0.85 * 48 * 36);
  EXPECT_GT(right, 0.6 * 48 * 36);
}

// Six pixels, each amid given labels of another class, which outweigh it by far.
TEST(LabelLoop, APixelThatSomebodyNamedIsShownAsNamed) {
  LoopedRoom room;
  std::vector<LabelledPixels> labels;
  std::vector<PixelPlace> centers;
  for (std::int32_t k = 0; k < 6; ++k) {
    const PixelPlace center{6 + 7 * k, 8 + 4 * (k % 5)};
    const std::int16_t around = room.truth(0, center);
    LabelledPixels given{0, around, {}, 0.9};
    for (std::int32_t i = 0; i < 49; ++i)
      if (i != 24) given.pixels.push_back({center.column + i % 7 - 3, center.row + i / 7 - 3});
    labels.push_back(std::move(given));
    labels.push_back({0, static_cast<std::int16_t>((around + 1) % 5), {center}});
    centers.push_back(center);
  }
  room.loop->learn(labels);
  const ViewLabels shown = room.loop->labels_of(0);
  for (const PixelPlace& center : centers) {
    const auto at = static_cast<std::size_t>(center.row * 48 + center.column);
    EXPECT_EQ(shown.label[at], (room.truth(0, center) + 1) % 5) << center.column << ", " << center.row;
    EXPECT_EQ(shown.entropy[at], 0);
  }
  room.loop->learn({});
  EXPECT_EQ(room.loop->labels_of(0).label, std::vector<std::int16_t>(48 * 36, kVoid)) << "undone";
}

TEST(LabelLoop, UndoGivesTheBitsOfNeverHavingClicked) {
  LoopedRoom room(60), other(60);
  const std::uint32_t trained = room.bits();
  ASSERT_EQ(trained, other.bits());
  std::vector<LabelledPixels> clicks = room.clicks(9);
  room.loop->learn(clicks);
  const std::uint32_t nine = room.bits();
  clicks.resize(5);
  room.loop->learn(clicks);
  other.loop->learn(clicks);
  EXPECT_NE(room.bits(), nine);
  EXPECT_EQ(room.bits(), other.bits());
  EXPECT_EQ(room.loop->pool_probability(), other.loop->pool_probability());
  EXPECT_EQ(room.loop->live(), other.loop->live());
  for (int v = 0; v < 3; ++v) {
    EXPECT_EQ(room.loop->labels_of(v).label, other.loop->labels_of(v).label);
    EXPECT_EQ(room.loop->labels_of(v).entropy, other.loop->labels_of(v).entropy);
  }
  EXPECT_EQ(room.loop->propose(1, 3)->point, other.loop->propose(1, 3)->point);
  room.loop->learn({});
  other.loop->learn(room.clicks(2, 40));
  other.loop->learn({});
  EXPECT_EQ(room.bits(), other.bits());
  EXPECT_FALSE(room.loop->learned());
  EXPECT_TRUE(room.loop->pool_probability().empty());
  EXPECT_EQ(room.loop->live(), std::vector<bool>(5, false));
  EXPECT_EQ(room.loop->labels_of(1).label, std::vector<std::int16_t>(48 * 36, kVoid));
  EXPECT_EQ(room.loop->graph().settled()[0].class_index[0], kVoid);
}

// Ways begin where the clicks lie on the surface of now, whatever numbers its points have.
TEST(LabelLoop, ASurfaceMadeAnewKeepsTheClicksWhereTheyAre) {
  LoopedRoom room(60);
  LabelLoop& loop = *room.loop;
  const std::vector<LabelledPixels> clicks = room.clicks(6);
  loop.learn(clicks);
  std::vector<Vec3d> places;
  for (const LabelledPixels& click : clicks) {
    const PoolView& view = loop.views()[click.view];
    const std::vector<float> found = surface_distances(*room.training->session().pipeline, view.camera,
                                                       room.training->session().limits, click.pixels);
    ASSERT_GT(found[0], 0);
    places.push_back(
        point_at(view.camera, room.training->session().limits, click.pixels[0], static_cast<double>(found[0])));
  }
  const auto expect_seeds = [&] {
    int lying = 0;
    std::vector<Vec3d> begun;
    for (const Settled& s : loop.graph().settled())
      if (s.cost[0] == 0) begun.push_back(loop.pool().points[&s - loop.graph().settled().data()].position);
    for (std::size_t k = 0; k < places.size(); ++k) {
      const std::int32_t point = loop.pool().cells.near(places[k]);
      if (point < 0) continue;
      ++lying;
      const Settled& s = loop.graph().settled()[point];
      EXPECT_EQ(s.cost[0], 0) << "click " << k;
      EXPECT_EQ(s.class_index[0], clicks[k].class_index) << "click " << k;
    }
    EXPECT_GT(lying, 3);
    for (const Vec3d& place : begun) {
      double nearest = INFINITY;
      for (const Vec3d& click : places) nearest = std::min(nearest, length(place - click));
      EXPECT_LT(nearest, 0.5) << "a way begins where nobody has clicked";
    }
  };
  expect_seeds();
  const std::size_t before = loop.pool().points.size();
  room.training->train(120);
  ASSERT_TRUE(loop.update_surfaces(1e9));
  EXPECT_NE(loop.pool().points.size(), before);
  expect_seeds();
  EXPECT_FALSE(loop.pool_probability().empty());
}

TEST(LabelLoop, LearnsTheSameBitsForAnyThreads) {
  std::vector<std::uint32_t> bits;
  std::vector<std::vector<float>> probability;
  std::vector<ViewLabels> labels;
  std::vector<Asked> asked;
  for (const int threads : {1, 3}) {
    const ThreadScope scope(threads);
    LoopedRoom room(60);
    room.loop->learn(room.clicks(7));
    bits.push_back(room.bits());
    probability.push_back(room.loop->pool_probability());
    labels.push_back(room.loop->labels_of(3));
    asked.push_back(*room.loop->propose(9, 2));
  }
  EXPECT_EQ(bits[0], bits[1]);
  EXPECT_EQ(probability[0], probability[1]);
  EXPECT_EQ(labels[0].label, labels[1].label);
  EXPECT_EQ(labels[0].entropy, labels[1].entropy);
  EXPECT_EQ(asked[0].point, asked[1].point);
  EXPECT_EQ(asked[0].gain, asked[1].gain);
}

// --- temperature ---

std::optional<double> fitted(LabelLoop& loop, const std::vector<LabelledPixels>& clicks) {
  std::vector<HeldBack> held;
  for (int fold = 0; fold < kCalibrationFolds; ++fold)
    for (HeldBack& click : loop.hold_back(clicks, fold)) held.push_back(std::move(click));
  return fit_temperature(held);
}

double sure(const LabelLoop& loop) {
  double sum = 0;
  for (std::size_t i = 0; i < loop.pool().points.size(); ++i)
    sum += static_cast<double>(
        *std::max_element(loop.pool_probability().begin() + static_cast<std::ptrdiff_t>(5 * i),
                          loop.pool_probability().begin() + static_cast<std::ptrdiff_t>(5 * i + 5)));
  return sum / static_cast<double>(loop.pool().points.size());
}

// Every second click is wrong: probabilities near 1 are too sure then, and the temperature says so.
TEST(LabelLoop, TheTemperatureAnswersOverConfidence) {
  LoopedRoom room;
  LabelLoop& loop = *room.loop;
  const std::vector<LabelledPixels> right = room.clicks(40);
  std::vector<LabelledPixels> wrong = right;
  for (std::size_t k = 0; k < wrong.size(); k += 2)
    wrong[k].class_index = static_cast<std::int16_t>((wrong[k].class_index + 1 + k % 4) % 5);
  loop.learn(wrong);
  const std::uint32_t bits = room.bits();
  const std::vector<float> probability = loop.pool_probability();
  const std::vector<Settled> settled = loop.graph().settled();
  const double doubted = fitted(loop, wrong).value_or(0);
  EXPECT_EQ(room.bits(), bits) << "what was learned stays";
  EXPECT_EQ(loop.pool_probability(), probability);
  ASSERT_EQ(loop.graph().settled().size(), settled.size());
  for (std::size_t i = 0; i < settled.size(); ++i)
    ASSERT_EQ(loop.graph().settled()[i].cost[0], settled[i].cost[0]) << "the ways to clicks stay";
  const double trusted = fitted(loop, right).value_or(0);
  EXPECT_GT(doubted, 1.5);
  EXPECT_LT(trusted, doubted / 1.5);
  EXPECT_GE(trusted, 0.25);
  EXPECT_LT(doubted, 5);
  const double before = sure(loop);
  loop.set_temperature(doubted);
  EXPECT_EQ(loop.temperature(), doubted);
  EXPECT_LT(sure(loop), before - 0.05);
}

// As somebody clicks: two or three clicks a class, so that each one held back takes much of what its class is known by.
// What is sure of all clicks together is not to be called guesswork for that.
TEST(LabelLoop, TwentyClicksDoNotMakeWhatIsRightDoubtful) {
  LoopedRoom room;
  LabelLoop& loop = *room.loop;
  for (const int count : {10, 15, 20, 30}) {
    const std::vector<LabelledPixels> clicks = room.clicks(count);
    loop.set_temperature(1);
    loop.learn(clicks);
    const double right = room.share_right(), before = sure(loop);
    loop.set_temperature(fitted(loop, clicks).value_or(1));
    EXPECT_GT(sure(loop), std::min(right, before) - 0.15) << count << " clicks, temperature " << loop.temperature();
  }
}

// The semantic part learned anew from points: what it learns, what it leaves alone, and the same bits for any threads.

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

std::vector<float> probabilities(Pipeline<float>& network, const PointRows& rows, const std::vector<bool>& live) {
  std::vector<float> out = point_logits(network, rows);
  softmax_live(out, point_classes(network), live);
  return out;
}

double share_right(Pipeline<float>& network, const Toy& toy, const std::vector<bool>& live) {
  const std::vector<float> p = probabilities(network, point_rows(network, toy.places), live);
  const auto width = static_cast<std::ptrdiff_t>(point_classes(network));
  int right = 0;
  for (std::size_t i = 0; i < toy.logit.size(); ++i) {
    const auto row = p.begin() + static_cast<std::ptrdiff_t>(i) * width;
    right += std::max_element(row, row + width) - row == toy.logit[i] ? 1 : 0;
  }
  return static_cast<double>(right) / static_cast<double>(toy.logit.size());
}

TEST(LearnedPoints, LearnsWhatCanBeToldApart) {
  const Toy seen(1), other(2);
  const Session session = open_text(config_of(true));
  Pipeline<float>& network = *session.pipeline;
  ASSERT_EQ(point_classes(network), 5);
  const std::vector<bool> live(5, true);
  EXPECT_LT(share_right(network, other, live), 0.7);
  learn_points(network, point_rows(network, seen.places), seen.logit, {}, quick());
  EXPECT_GT(share_right(network, seen, live), 0.95);
  EXPECT_GT(share_right(network, other, live), 0.9) << "places that were not named";
}

// Whatever was learned before: points state everything, and colour and geometry stand.
TEST(LearnedPoints, ChangesSemanticTensorsAloneAndForgetsWhatWasBefore) {
  const Toy toy(4), other(5);
  for (const bool branch : {false, true}) {
    SCOPED_TRACE(branch);
    Session session = open_text(config_of(branch));
    Trainer trainer(session);
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
    Pipeline<float>& network = *session.pipeline;
    const PointRows rows = point_rows(network, toy.places);
    learn_points(network, rows, toy.logit, {}, quick(10));
    const std::vector<float> learned = copy(true);
    EXPECT_EQ(copy(false), field);
    EXPECT_NE(learned, before);
    learn_points(network, point_rows(network, other.places), other.logit, {}, quick(10));
    EXPECT_NE(copy(true), learned);
    learn_points(network, rows, toy.logit, {}, quick(10));
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

TEST(LearnedPoints, ClassesWithoutLabelsHaveNoProbability) {
  const Toy toy(6, 30);
  const Session session = open_text(config_of(true));
  Pipeline<float>& network = *session.pipeline;
  const PointRows rows = point_rows(network, toy.places);
  const std::vector<bool> live{true, false, false, true, true};
  const std::vector<float> p = probabilities(network, rows, live), logits = point_logits(network, rows);
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
  for (const float found : probabilities(network, rows, std::vector<bool>(5, false))) EXPECT_EQ(found, 0);
  std::vector<float> extreme{1e30F, -1e30F, 0, -1e30F, 90, 90};
  softmax_live(extreme, 3, {true, true, true});
  EXPECT_EQ(extreme, (std::vector<float>{1, 0, 0, 0, 0.5F, 0.5F}));
}

TEST(LearnedPoints, NoPointsAreFine) {
  const Session session = open_text(config_of(true));
  Pipeline<float>& network = *session.pipeline;
  const std::uint32_t start = fingerprint(session.pipeline->store());
  const PointRows none = point_rows(network, {});
  EXPECT_EQ(none.count(), 0);
  const Toy toy(7);
  learn_points(network, point_rows(network, toy.places), toy.logit, {}, quick(3));
  EXPECT_NE(fingerprint(session.pipeline->store()), start);
  learn_points(network, none, {}, {}, quick());
  EXPECT_EQ(fingerprint(session.pipeline->store()), start);
  EXPECT_TRUE(point_logits(network, none).empty());
  EXPECT_TRUE(probabilities(network, none, std::vector<bool>(5, true)).empty());
  // Points without a logit or a weight are no points.
  learn_points(network, point_rows(network, toy.places), std::vector<std::int16_t>(toy.logit.size(), kVoid), {},
               quick(3));
  EXPECT_EQ(fingerprint(session.pipeline->store()), start);
  learn_points(network, point_rows(network, toy.places), toy.logit, std::vector<float>(toy.logit.size(), 0.0F),
               quick(3));
  EXPECT_EQ(fingerprint(session.pipeline->store()), start);
}

// One place named as two classes: the heavier is believed.
TEST(LearnedPoints, WeightsTellHowOftenAPointIsDrawn) {
  const Session session = open_text(config_of(true));
  Pipeline<float>& network = *session.pipeline;
  const Toy toy(8, 60);
  std::vector<Vec3d> places = toy.places;
  places.insert(places.end(), toy.places.begin(), toy.places.end());
  std::vector<std::int16_t> logit(60, 2);
  logit.resize(120, 3);
  for (const bool first : {true, false}) {
    std::vector<float> weight(60, first ? 10.0F : 1.0F);
    weight.resize(120, first ? 1.0F : 10.0F);
    learn_points(network, point_rows(network, places), logit, weight, quick(60));
    const std::vector<float> p = probabilities(network, point_rows(network, toy.places), std::vector<bool>(5, true));
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

// Semantics of points apart from rays: the logits of a ray's sample, gradients of head and branch alone, and tensors
// that start anew.

const std::string kPointPassBranch =
    "position: {type: frequency, frequencies: 3}, field: {type: tiny_mlp, hidden_width: 12, hidden_layers: 2}";

// `branch`: the body of the pass's section `semantic`, "" for none.
std::string point_pass_config_of(const std::string& branch, const std::string& more = "") {
  return stratified_config("type: analytic_room", branch.empty() ? "" : "    semantic: {" + branch + "}\n", "rays: 24",
                           more);
}

const std::string kForms[] = {"", kPointPassBranch, kPointPassBranch + ", reads_feature: false"};

// Places within the room.
std::vector<double> places(std::int64_t count) {
  const RandomAddress random{5, 0, stream_id("point_pass_test")};
  std::vector<double> out;
  for (std::int64_t i = 0; i < 3 * count; ++i)
    out.push_back(1.8 * static_cast<double>(uniform01(random, static_cast<std::uint64_t>(i))) - 0.9);
  return out;
}

template <class Real>
std::vector<Real> rows_of(const Pass<Real>& pass, std::vector<double> at) {
  Workspace arena;
  StepContext ctx{.workspace = &arena};
  const auto count = std::ssize(at) / 3;
  std::vector<Real> rows(static_cast<std::size_t>(count * pass.point_dims()));
  pass.point_rows(ctx, {at.data(), count, 3}, {rows.data(), count, pass.point_dims()});
  return rows;
}

struct Asking {
  bool training = false;
  std::int64_t step = 0, first = 0;
};

template <class Real>
std::vector<Real> logits_of(const Pass<Real>& pass, std::vector<Real> rows, const Asking& asking = {}) {
  Workspace arena;
  StepContext ctx{
      .seed = 3, .step = asking.step, .training = asking.training, .first_ray = asking.first, .workspace = &arena};
  const std::int64_t count = std::ssize(rows) / pass.point_dims();
  const std::int32_t classes = pass.parts().head->width();
  std::vector<Real> logits(static_cast<std::size_t>(count * classes));
  (void)pass.point_forward(ctx, 0, {rows.data(), count, pass.point_dims()}, {logits.data(), count, classes});
  return logits;
}

// With the class layer before compositing, a pass shows the logits of every sample: those of a ray that has this
// sample alone, with weight 1.
TEST(PointPass, LogitsAreThoseOfASampleOfWeightOne) {
  for (const std::string& form : kForms) {
    SCOPED_TRACE(form);
    Oracle oracle(point_pass_config_of(form.empty() ? "" : form + ", least_weight: 0",
                                       "runtime: {deferred_class_layer: false, tile_rays: 24, lanes: 1}\n"));
    const Pass<double>& pass = oracle.pipeline->passes().back();
    Workspace arena;
    StepContext ctx{.workspace = &arena};
    oracle.pipeline->derive(0);
    const RayBatch batch = oracle.batch.view(true);
    const PassTrace<double> trace =
        pass.forward(ctx, 0, {batch.origin, batch.direction, batch.near_far}, nullptr, 0, {batch.origin.rows});
    const std::int64_t count = trace.semantic.sample_rows.rows;
    ASSERT_GT(count, 100);
    std::vector<double> at;
    for (std::int64_t k = 0; k < count; ++k) {
      const std::int64_t sample = form.empty() ? k : trace.semantic.branch.source(k, 0);
      const std::int32_t ray = trace.samples.ray_of_sample(sample, 0);
      for (int axis = 0; axis < 3; ++axis)
        at.push_back(batch.origin(ray, axis) + trace.samples.t(sample, 0) * batch.direction(ray, axis));
    }
    const std::vector<double> logits = logits_of(pass, rows_of(pass, at));
    double largest = 0;
    for (std::int64_t k = 0; k < count; ++k) {
      for (std::int32_t c = 0; c < trace.semantic.sample_rows.cols; ++c) {
        const double expected = trace.semantic.sample_rows(k, c);
        largest = std::max(largest, std::abs(expected));
        ASSERT_NEAR(logits[k * trace.semantic.sample_rows.cols + c], expected, 1e-9) << k;
      }
    }
    EXPECT_GT(largest, 1e-3);
  }
}

TEST(PointPass, GradientsAreThoseOfFiniteDifferencesAndNoneReachesTheField) {
  for (const std::string& form : {kForms[0], kForms[1], kForms[2], kPointPassBranch + ", dropout: 0.3"}) {
    SCOPED_TRACE(form);
    Oracle oracle(point_pass_config_of(form));
    const Pass<double>& pass = oracle.pipeline->passes().back();
    ParamStore<double>& store = oracle.pipeline->store();
    oracle.pipeline->derive(0);
    std::vector<double> rows = rows_of(pass, places(40));
    const std::int32_t classes = pass.parts().head->width();
    std::vector<double> d(static_cast<std::size_t>(40 * classes)), logits(d.size());
    for (std::size_t i = 0; i < d.size(); ++i) d[i] = std::sin(1.7 * static_cast<double>(i));
    const View<double> all(rows.data(), 40, pass.point_dims());
    const auto evaluate = [&](bool backward) {
      Workspace arena;
      StepContext ctx{.seed = 3, .training = true, .workspace = &arena};
      pass.derive(ctx);
      const PointTrace<double> trace = pass.point_forward(ctx, 0, all, {logits.data(), 40, classes});
      if (backward) {
        pass.point_backward(ctx, 0, trace, {d.data(), 40, classes});
        store.reduce_lanes();
        pass.derive_backward(ctx);
      }
      double sum = 0;
      for (std::size_t i = 0; i < d.size(); ++i) sum += d[i] * logits[i];
      return sum;
    };
    evaluate(true);
    int checked = 0;
    for (Tensor<double>& tensor : store.all()) {
      if (tensor.grad.size() == 0) continue;
      const std::vector<double> found(tensor.grad.data(), tensor.grad.data() + tensor.grad.size());
      if (!tensor.rule.semantic) {
        EXPECT_EQ(found, std::vector<double>(found.size(), 0.0)) << tensor.name;
        continue;
      }
      if (!tensor.learned()) continue;
      EXPECT_NE(found, std::vector<double>(found.size(), 0.0)) << tensor.name;
      testkit::GradientCheck options{.max_elements = 12};
      EXPECT_EQ(testkit::check_gradient([&] { return evaluate(false); }, tensor.view(tensor.value),
                                        {found.data(), tensor.spec.rows, tensor.spec.cols}, options),
                "")
          << tensor.name;
      ++checked;
    }
    EXPECT_GE(checked, form.empty() ? 4 : 8);
  }
}

TEST(PointPass, DropoutIsForTrainingAlone) {
  const Oracle with(point_pass_config_of(kPointPassBranch + ", dropout: 0.4")),
      without(point_pass_config_of(kPointPassBranch));
  const Pass<double>&drops = with.pipeline->passes().back(), &plain = without.pipeline->passes().back();
  with.pipeline->derive(0);
  without.pipeline->derive(0);
  const std::vector<double> rows = rows_of(plain, places(20)), expected = logits_of(plain, rows);
  EXPECT_EQ(rows_of(drops, places(20)), rows);
  EXPECT_EQ(logits_of(drops, rows), expected);
  EXPECT_EQ(logits_of(plain, rows, {true, 1}), expected);
  const std::vector<double> first = logits_of(drops, rows, {true, 1}), second = logits_of(drops, rows, {true, 2});
  EXPECT_NE(first, expected);
  EXPECT_NE(first, second);
  EXPECT_EQ(first, logits_of(drops, rows, {true, 1}));
}

// The same bits in one call and in many, with dropout too: it is addressed by a point's number.
TEST(PointPass, RowsDoNotDependOnHowABatchIsSplit) {
  for (const std::string& form : {kForms[0], kForms[1], kForms[2], kPointPassBranch + ", dropout: 0.3"}) {
    SCOPED_TRACE(form);
    const Session session = open_text(point_pass_config_of(form));
    const Pass<float>& pass = session.pipeline->passes().back();
    session.pipeline->derive(0);
    const std::vector<double> at = places(83);
    const std::vector<float> rows = rows_of(pass, at);
    const auto dims = static_cast<std::size_t>(pass.point_dims());
    for (const bool training : {false, true}) {
      const std::vector<float> whole = logits_of(pass, rows, {training, 4});
      const auto classes = whole.size() / 83;
      for (const std::size_t size : {1, 7, 32, 64}) {
        for (std::size_t begin = 0; begin < 83; begin += size) {
          const std::size_t end = std::min<std::size_t>(83, begin + size);
          const auto cut = [&](const auto& all, std::size_t width) {
            return std::vector(all.begin() + static_cast<std::ptrdiff_t>(begin * width),
                               all.begin() + static_cast<std::ptrdiff_t>(end * width));
          };
          ASSERT_EQ(rows_of(pass, cut(at, 3)), cut(rows, dims));
          ASSERT_EQ(logits_of(pass, cut(rows, dims), {training, 4, static_cast<std::int64_t>(begin)}),
                    cut(whole, classes));
        }
      }
    }
    EXPECT_TRUE(rows_of(pass, {}).empty());
  }
}

TEST(PointPass, RestartedTensorsAreThoseOfTheBeginning) {
  for (const std::string& yaml :
       {point_pass_config_of(""), point_pass_config_of(kPointPassBranch), two_pass_config()}) {
    Session session = open_text(yaml), fresh = open_text(yaml);
    ParamStore<float>& store = session.pipeline->store();
    const std::uint32_t start = fingerprint(store);
    Trainer trainer(session);
    for (int i = 0; i < 3; ++i) trainer.advance();
    EXPECT_NE(fingerprint(store), start);
    for (Tensor<float>& tensor : store.all()) {
      if (!tensor.learned()) continue;
      store.restart(tensor);
      const Tensor<float>& first = *fresh.pipeline->store().find(tensor.name);
      for (std::size_t i = 0; i < tensor.value.size(); ++i) {
        ASSERT_EQ(tensor.value.data()[i], first.value.data()[i]) << tensor.name;
        ASSERT_EQ(tensor.moment1.data()[i], 0) << tensor.name;
        ASSERT_EQ(tensor.moment2.data()[i], 0) << tensor.name;
      }
    }
  }
}

}  // namespace
}  // namespace semfield
