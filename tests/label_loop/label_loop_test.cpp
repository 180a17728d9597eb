// Clicks in the analytic room: what they name, what undoing them leaves, what a surface made anew keeps of them, and
// how sure the labels are.
#include "compute/parallel.h"
#include "tests/label_loop/looped_room.h"

namespace semfield {
namespace {

using namespace testing_loop;

TEST(LabelLoop, BeforeTheFirstClickNothingIsNamed) {
  LoopedRoom room(0);
  LabelLoop& loop = *room.loop;
  EXPECT_EQ(loop.views().size(), room.training->session().drawn_frames().size());
  EXPECT_FALSE(loop.ready());
  EXPECT_FALSE(loop.propose(Acquisition::surface, 1, 0).has_value());
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
  EXPECT_EQ(loop.propose(Acquisition::surface, 1, 0)->why, "unseen");
}

// The loop proposes, and gets true labels.
TEST(LabelLoop, AFewClicksNameMostOfTheRoom) {
  LoopedRoom room;
  LabelLoop& loop = *room.loop;
  std::vector<LabelledPixels> clicks;
  for (std::uint64_t round = 0; round < 16; ++round) {
    const std::optional<Asked> asked = loop.propose(Acquisition::surface, 1, round);
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
  EXPECT_EQ(room.loop->propose(Acquisition::surface, 1, 3)->point,
            other.loop->propose(Acquisition::surface, 1, 3)->point);
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
  for (const int threads : {1, 3}) {
    set_thread_count(threads);
    LoopedRoom room(60);
    room.loop->learn(room.clicks(7));
    bits.push_back(room.bits());
    probability.push_back(room.loop->pool_probability());
    labels.push_back(room.loop->labels_of(3));
  }
  set_thread_count(0);
  EXPECT_EQ(bits[0], bits[1]);
  EXPECT_EQ(probability[0], probability[1]);
  EXPECT_EQ(labels[0].label, labels[1].label);
  EXPECT_EQ(labels[0].entropy, labels[1].entropy);
}

TEST(LabelLoop, WhatWasPassedOverIsNotAskedForAgain) {
  LoopedRoom room(60);
  LabelLoop& loop = *room.loop;
  loop.learn(room.clicks(2));
  std::vector<LabelledPixels> skipped;
  std::vector<Vec3d> places;
  for (std::uint64_t round = 0; round < 5; ++round) {
    const Asked asked = *loop.propose(Acquisition::surface, 1, round);
    const PoolPoint& point = loop.pool().points[asked.point];
    for (const Vec3d& place : places) EXPECT_GT(length(place - point.position), 2 * loop.pool().cell_m());
    places.push_back(point.position);
    skipped.push_back({point.view, 0, {point.pixel}});
    loop.set_skipped(skipped);
  }
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

TEST(LabelLoop, FewClicksTellNothingOfTheTemperature) {
  LoopedRoom room(60);
  EXPECT_FALSE(fitted(*room.loop, room.clicks(9)).has_value());
  EXPECT_FALSE(fitted(*room.loop, {}).has_value());
}

// Every third click is wrong: probabilities near 1 are too sure then, and the temperature says so.
TEST(LabelLoop, TheTemperatureAnswersOverConfidence) {
  LoopedRoom room;
  LabelLoop& loop = *room.loop;
  const std::vector<LabelledPixels> right = room.clicks(40);
  std::vector<LabelledPixels> wrong = right;
  for (std::size_t k = 0; k < wrong.size(); k += 3)
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

}  // namespace
}  // namespace semfield
