// What every degradation promises, on real labels too; and predictions of a simulated network.
#include <clocale>
#include <set>

#include "datasets/replica/replica.h"
#include "loading/frame_source.h"
#include "tests/labels/degradation_testing.h"

namespace semfield {
namespace {

using namespace testing_degrade;

struct Row {
  std::string type, keys;
  bool random = true;         ///< the seed changes the result
  bool ranks_frames = false;  ///< what a frame gets depends on which other frames see an instance
  bool may_label_void = false;
};

const std::vector<Row>& rows() {
  static const std::vector<Row> all{
      {"pixel_noise", "{ratio: 0.5}"},
      {"pixel_noise", "{ratio: 0.9, flip_void: true}", true, false, true},
      {"region_noise", "{ratio: 0.5, min_frames: 1}", true, true},
      {"region_noise", "{ratio: 0.5, mode: even}", true, true},
      {"super_resolution", "{factor: 8}", false},
      {"super_resolution", "{factor: 5, mode: sparse}", false},
      {"propagation", "{}"},
      {"propagation", "{share: 0.1}"},
      {"simulated_predictions", "{}"},
      {"simulated_predictions", "{output: hard, depth_half_m: 0}"},
  };
  return all;
}

Case blocks() {
  Case c = scene_of(7);
  for (std::uint64_t f = 0; f < 5; ++f) add_blocks(c, 50, 41, f);
  return c;
}

LabelSet degraded(const Row& row, Case c, std::uint64_t seed = 1) {
  c.apply(*step(row.type, row.keys), seed);
  return c.labels;
}

TEST(DegradationLaws, EveryTypeHasARow) {
  const std::vector<std::string> names = testing_labels::linked_registry().names(PluginKind::degradation);
  EXPECT_GE(names.size(), 5U);
  for (const std::string& name : names) {
    bool found = false;
    for (const Row& row : rows()) found = found || row.type == name;
    EXPECT_TRUE(found) << name;
  }
}

TEST(DegradationLaws, SameSeedSameResultOnAnyNumberOfThreadsOtherSeedAnother) {
  for (const Row& row : rows()) {
    SCOPED_TRACE(row.type + " " + row.keys);
    set_thread_count(1);
    const LabelSet one = degraded(row, blocks());
    set_thread_count(4);
    EXPECT_TRUE(same_labels(one, degraded(row, blocks())));
    EXPECT_EQ(same_labels(one, degraded(row, blocks(), 2)), !row.random);
    EXPECT_FALSE(same_labels(one, blocks().labels)) << "nothing was changed";
  }
  set_thread_count(0);
}

TEST(DegradationLaws, AFrameDoesNotDependOnTheLabelsOfOthers) {
  for (const Row& row : rows()) {
    if (row.ranks_frames) continue;
    SCOPED_TRACE(row.type + " " + row.keys);
    const LabelSet all = degraded(row, blocks());
    Case alone = blocks();
    for (std::size_t f = 0; f < alone.labels.size(); ++f) {
      if (f != 3) alone.labels[f] = {};
    }
    alone.labels = degraded(row, alone);
    EXPECT_EQ(alone.labels[3].hard, all[3].hard);
    EXPECT_TRUE(alone.labels[3].soft == all[3].soft);
    EXPECT_TRUE(alone.labels[0].empty());
  }
}

TEST(DegradationLaws, VoidStaysVoid) {
  for (const Row& row : rows()) {
    if (row.may_label_void) continue;
    SCOPED_TRACE(row.type + " " + row.keys);
    const Case clean = blocks();
    const LabelSet after = degraded(row, clean);
    std::int64_t void_pixels = 0;
    for (std::size_t f = 0; f < after.size(); ++f) {
      for (std::size_t p = 0; p < clean.labels[f].hard.size(); ++p) {
        if (clean.labels[f].hard[p] != kVoid) continue;
        ++void_pixels;
        ASSERT_EQ(after[f].soft.empty() ? after[f].hard[p] : after[f].soft.argmax(p), kVoid);
      }
    }
    EXPECT_GT(void_pixels, 100);
  }
}

TEST(DegradationLaws, SoftLabelsAreRefusedWithTheFrame) {
  for (const Row& row : rows()) {
    Case c = blocks();
    c.labels[2] = {{}, SoftMap(c.labels[2].hard.size(), 7)};
    EXPECT_EQ(error_of([&] { c.apply(*step(row.type, row.keys)); }),
              row.type +
                  ": frame 'rgb_2' has class probabilities, and this degradation works on hard labels; name it "
                  "before the step that makes the labels soft, or read hard labels");
  }
}

TEST(DegradationLaws, FactsCountWhatChanged) {
  for (const Row& row : rows()) {
    SCOPED_TRACE(row.type + " " + row.keys);
    Case c = blocks();
    const LabelSet before = c.labels;
    const StepFacts facts = c.apply(*step(row.type, row.keys));
    std::int64_t changed = 0, labelled = 0;
    for (std::size_t f = 0; f < before.size(); ++f) {
      for (std::size_t p = 0; p < before[f].hard.size(); ++p) {
        const FrameLabels& now = c.labels[f];
        const std::int16_t label = now.soft.empty() ? now.hard[p] : now.soft.argmax(p);
        changed += label != before[f].hard[p] ? 1 : 0;
        labelled += label != kVoid ? 1 : 0;
      }
    }
    EXPECT_EQ(fact(facts, "frames"), "5");
    EXPECT_EQ(fact(facts, "pixels changed"), std::to_string(changed));
    EXPECT_EQ(fact(facts, "labelled pixels after"), std::to_string(labelled));
  }
}

TEST(DegradationLaws, ValuesOutOfRangeAndUnknownKeysAreRefused) {
  for (const auto& [type, keys, named] : std::vector<std::array<std::string, 3>>{
           {"pixel_noise", "{ratio: 1.5}", "ratio"},
           {"region_noise", "{ratio: -0.1}", "ratio"},
           {"region_noise", "{mode: sorted}", "sort"},
           {"region_noise", "{instances: [3], classes: [chair]}", "exclude each other"},
           {"super_resolution", "{factor: 1}", "factor"},
           {"super_resolution", "{factor: 65}", "factor"},
           {"propagation", "{share: 5}", "share"},
           {"simulated_predictions", "{similar: 0}", "similar"},
           {"simulated_predictions", "{strenght: 1}", "strength"}}) {
    const std::string message = error_of([&type = type, &keys = keys] { (void)step(type, keys); });
    EXPECT_HAS(message, named) << type << keys << ": " << message;
  }
}

// Degradations on Replica frames, where they are at hand: the figures that the page of experiments states.

TEST(DegradationRealData, ReplicaApartment) {
  const std::string root = std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/replica_apartment0";
  if (!std::filesystem::exists(root)) GTEST_SKIP() << "the optional Replica frames are not at hand";
  ReplicaParams p{.root = root, .train_step = 2, .test_step = 2, .test_offset = 1};
  Replica replica(p, {});
  Diagnostics d;
  SceneLoadOptions o{.width_px = 160, .with_instances = true};
  Case clean;
  clean.scene = load_scene(replica, o, d);
  ASSERT_FALSE(d.has_errors());
  clean.labels.resize(clean.scene.frames.size());
  for (const int f : clean.scene.frames_of(Split::train)) {
    const auto i = static_cast<std::size_t>(f);
    clean.labels[i].hard = clean.scene.frames[i].label.expand();
  }
  for (std::uint64_t seed = 1; seed <= 4; ++seed) {
    Case c = clean;
    const double right =
        std::stod(fact(c.apply(*step("simulated_predictions", "{output: hard}"), seed), "pixel accuracy"));
    EXPECT_GT(right, 0.785);
    EXPECT_LT(right, 0.82);
  }
  Case noisy = clean;
  const StepFacts facts = noisy.apply(*step("pixel_noise", "{ratio: 0.9}"));
  EXPECT_EQ(fact(facts, "pixels drawn"), std::to_string(35 * 160 * 160 * 9 / 10));
  EXPECT_EQ(fact(facts, "classes drawn from, besides void"), "29") << "of the table's 101";
  Case chairs = clean;
  const StepFacts flipped = chairs.apply(*step("region_noise", "{classes: [chair], ratio: 0.5}"));
  EXPECT_EQ(fact(flipped, "pixels changed"), fact(flipped, "pixels of flipped regions"));
  EXPECT_GT(std::stoi(fact(flipped, "views flipped")), 5);
}

// The error model of simulated predictions: probabilities, what each error does, and about how many errors there are.

using Labels = std::vector<std::int16_t>;

Case room(int frames = 3) {
  Case c = scene_of(12);
  for (int f = 0; f < frames; ++f) add_blocks(c, 96, 72, static_cast<std::uint64_t>(f));
  return c;
}

double accuracy(const Case& clean, const Case& c) {
  double right = 0, all = 0;
  for (std::size_t f = 0; f < c.labels.size(); ++f) {
    for (std::size_t p = 0; p < clean.labels[f].hard.size(); ++p) {
      if (clean.labels[f].hard[p] == kVoid) continue;
      all += 1;
      right += (c.labels[f].soft.empty() ? c.labels[f].hard[p] : c.labels[f].soft.argmax(p)) == clean.labels[f].hard[p];
    }
  }
  return right / all;
}

TEST(SimulatedPredictions, RowsAreProbabilitiesAndHardOutputIsTheirMaximum) {
  Case soft = room(), hard = room();
  soft.apply(*step("simulated_predictions"));
  hard.apply(*step("simulated_predictions", "{output: hard}"));
  std::vector<float> row(12);
  for (std::size_t f = 0; f < soft.labels.size(); ++f) {
    ASSERT_TRUE(soft.labels[f].hard.empty());
    ASSERT_EQ(soft.labels[f].soft.classes(), 12);
    for (std::size_t p = 0; p < soft.labels[f].soft.pixels(); ++p) {
      soft.labels[f].soft.row(p, row);
      double sum = 0;
      for (const float x : row) sum += static_cast<double>(x);
      ASSERT_NEAR(sum, soft.scene.frames[f].label[p] == kVoid ? 0.0 : 1.0, 0.003);  // 12 roundings to 11 bits
      ASSERT_EQ(soft.labels[f].soft.argmax(p), hard.labels[f].hard[p]);
    }
  }
}

TEST(SimulatedPredictions, WithoutStrengthNothingIsWrong) {
  Case c = room();
  const StepFacts facts = c.apply(*step("simulated_predictions", "{strength: 0, output: hard}"));
  EXPECT_TRUE(same_labels(c.labels, room().labels));
  EXPECT_EQ(fact(facts, "pixel accuracy"), "1.000000");
  EXPECT_EQ(fact(facts, "simulated"), "true");
}

// Facts go into files, which are the same whatever the program around has set.
TEST(SimulatedPredictions, FactsDoNotDependOnTheLocale) {
  if (std::setlocale(LC_ALL, "de_DE.UTF-8") == nullptr)
    GTEST_SKIP() << "the locale de_DE.UTF-8 is not installed here: no comma was tried";
  Case c = room();
  const StepFacts facts = c.apply(*step("simulated_predictions", "{strength: 0, output: hard}"));
  std::setlocale(LC_ALL, "C");
  EXPECT_EQ(fact(facts, "pixel accuracy"), "1.000000");
}

TEST(SimulatedPredictions, ConfidenceFollowsTheSoftmaxAndDepth) {
  // 12 classes, evidence 4, no error: e^4 / (e^4 + 11); at depth 3 of half depth 3 evidence 2.
  for (const auto& [half, evidence] : std::vector<std::pair<std::string, double>>{{"0", 4.0}, {"3", 2.0}}) {
    Case c = scene_of(12);
    c.add(2, 1, {4, kVoid}, {}, {3.0F, 3.0F});
    for (std::int64_t& n : c.scene.class_pixels[0]) n = 1;
    c.apply(*step("simulated_predictions", "{strength: 0, evidence: 4, depth_half_m: " + half + "}"));
    std::vector<float> row(12);
    c.labels[0].soft.row(0, row);
    EXPECT_NEAR(row[4], std::exp(evidence) / (std::exp(evidence) + 11), 1e-3);
    EXPECT_NEAR(row[5], 1 / (std::exp(evidence) + 11), 1e-4);
  }
}

TEST(SimulatedPredictions, ClassesThatTheSceneLacksHaveProbabilityZero) {
  Case c = scene_of(12);
  c.add(2, 1, {4, 7});
  c.apply(*step("simulated_predictions"));
  std::vector<float> row(12);
  c.labels[0].soft.row(0, row);
  for (std::size_t k = 0; k < 12; ++k) EXPECT_EQ(row[k] > 0, k == 4 || k == 7) << k;
}

TEST(SimulatedPredictions, RegionsAreMistakenAsAWholeForFewClassesAndAlikeInAllFrames) {
  Case c = room(20);
  const Case clean = c;
  c.apply(*step("simulated_predictions",
                "{output: hard, noise: 0, boundary_width: 0, overlap: 0, similar: 2, region_error: 0.3}"));
  std::vector<std::set<std::int16_t>> taken_for(12);
  int blocks = 0, mistaken = 0;
  for (std::size_t f = 0; f < c.labels.size(); ++f) {
    for (int y = 0; y < 72; y += 6) {
      for (int x = 0; x < 96; x += 8) {
        const auto at = [&](int i, int j) { return static_cast<std::size_t>((y + j) * 96 + x + i); };
        const std::int16_t own = clean.labels[f].hard[at(0, 0)], now = c.labels[f].hard[at(0, 0)];
        if (own == kVoid) continue;
        for (int j = 0; j < 6; ++j) {
          for (int i = 0; i < 8; ++i) ASSERT_EQ(c.labels[f].hard[at(i, j)], now);
        }
        ++blocks;
        mistaken += now != own;
        if (now != own) taken_for[own].insert(now);
      }
    }
  }
  EXPECT_NEAR(mistaken / static_cast<double>(blocks), 0.3, 0.05);  // a block is 0.7 % of the frame: chance 0.28
  for (const std::set<std::int16_t>& others : taken_for) EXPECT_EQ(others.size(), 2u);
}

TEST(SimulatedPredictions, BoundariesStrayButInteriorsStay) {
  Case c = scene_of(2);
  Labels label;
  for (int p = 0; p < 200 * 100; ++p) label.push_back(p % 200 < 100 ? 0 : 1);
  c.add(200, 100, label);
  c.apply(
      *step("simulated_predictions", "{output: hard, noise: 0, region_error: 0, overlap: 0, boundary_width: 0.02}"));
  int near = 0;
  for (int y = 0; y < 100; ++y) {
    for (int x = 0; x < 200; ++x) {
      const auto p = static_cast<std::size_t>(y * 200 + x);
      if (c.labels[0].hard[p] == label[p]) continue;
      ASSERT_LT(std::abs(x - 99.5), 6 * 4) << "six standard deviations of 4 pixels";
      ++near;
    }
  }
  EXPECT_GT(near, 50);
}

TEST(SimulatedPredictions, NoiseOfClassesAndFramesIsIndependentAndSmooth) {
  // One class of two everywhere: an error is where its noise falls short of the other's by the evidence. The difference
  // of two fields of deviation 2 exceeds 2 in under 24 % of the pixels (exactly that at the nodes, less between them).
  Case c = scene_of(2);
  for (int f = 0; f < 2; ++f) c.add(100, 80, Labels(8000, 0));
  c.scene.class_pixels[0][1] = 1;
  const StepFacts facts =
      c.apply(*step("simulated_predictions", "{output: hard, evidence: 2, noise: 2, region_error: 0, overlap: 0}"));
  const double right = std::stod(fact(facts, "pixel accuracy"));
  EXPECT_GT(right, 0.76);
  EXPECT_LT(right, 0.95);
  EXPECT_NE(c.labels[0].hard, c.labels[1].hard);
  int borders = 0;
  for (std::size_t p = 1; p < 8000; ++p) borders += c.labels[0].hard[p] != c.labels[0].hard[p - 1];
  EXPECT_LT(borders, 80 * 10) << "patches, not single pixels";
}

TEST(SimulatedPredictions, ErrorsGrowWithStrength) {
  double last = 1;
  for (const char* strength : {"0.5", "1", "2"}) {
    Case c = room();
    c.apply(*step("simulated_predictions", std::string("{strength: ") + strength + "}"));
    const double now = accuracy(room(), c);
    EXPECT_LT(now, last - 0.03) << strength;
    last = now;
  }
}

}  // namespace
}  // namespace semfield
