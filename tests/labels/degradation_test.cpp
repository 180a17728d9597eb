// Shared by the tests of degradations: a step from YAML, and scenes of a few labelled pixels.

#include <algorithm>
#include <set>

#include "compute/parallel.h"
#include "core/rng.h"
#include "scene/classes/class_table.h"
#include "scene/loading/frame_source.h"
#include "tests/labels/reader_case.h"
#include "tests/says.h"

namespace semfield {
namespace {

/// The step of a type with its keys as YAML ("{ratio: 0.5}"); every error is thrown.
inline std::unique_ptr<Degradation> step(const std::string& type, const std::string& keys = "{}") {
  return testing_labels::make_degradation(type, keys);
}

struct Case {
  LoadedScene scene;
  LabelSet labels;  ///< of every frame, the scene's own

  /// Adds a training frame; the scene's class table has classes 0 .. classes - 1 with ids 1 .. classes.
  void add(int width, int height, const std::vector<std::int16_t>& label,
           const std::vector<std::int32_t>& instance = {}, const std::vector<float>& depth_m = {}) {
    FrameBuffer buffer{
        .width_px = width, .height_px = height, .depth_m = depth_m, .label = label, .instance = instance};
    FrameInfo& info = scene.info.frames.emplace_back();
    info.name = "rgb_" + std::to_string(scene.frames.size());
    info.has_labels = true;
    info.has_instances = !instance.empty();
    info.has_depth = !depth_m.empty();
    std::vector<std::int64_t> counts(static_cast<std::size_t>(scene.info.classes.valid_count()) + 1);
    for (const std::int16_t c : label) ++counts[c == kVoid ? counts.size() - 1 : static_cast<std::size_t>(c)];
    scene.class_pixels.push_back(counts);
    scene.frames.emplace_back(buffer);
    labels.push_back({label, {}});
  }

  StepFacts apply(const Degradation& degradation, std::uint64_t seed = 1) {
    return degradation.apply(scene, seed, labels);
  }
};

inline Case scene_of(int classes) {
  Case c;
  std::vector<ClassEntry> entries{{0, "void", {}, true}};
  for (int i = 0; i < classes; ++i) entries.push_back({i + 1, "class_" + std::to_string(i), {}, false});
  c.scene.info.classes = ClassTable(std::move(entries));
  return c;
}

/// Blocks of 8 x 6 pixels with random classes, every 16th block void; instance = block + 1.
inline void add_blocks(Case& c, int width, int height, std::uint64_t seed) {
  const int classes = c.scene.info.classes.valid_count();
  std::vector<std::int16_t> label;
  std::vector<std::int32_t> instance;
  std::vector<float> depth_m;
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      const int block = y / 6 * 64 + x / 8;
      const auto drawn = static_cast<int>(uniform_below({seed, 0, 1}, static_cast<std::uint64_t>(block), 16));
      label.push_back(drawn == 0 ? kVoid : static_cast<std::int16_t>(block % classes));
      instance.push_back(block + 1);
      depth_m.push_back(1.0F + 0.05F * static_cast<float>(x));
    }
  }
  c.add(width, height, label, instance, depth_m);
}

inline std::string fact(const StepFacts& facts, const std::string& name) {
  for (const auto& [key, value] : facts) {
    if (key == name) return value;
  }
  return "no fact '" + name + "'";
}

/// Facts of all frames, hard and soft labels.
inline bool same_labels(const LabelSet& a, const LabelSet& b) {
  if (a.size() != b.size()) return false;
  for (std::size_t f = 0; f < a.size(); ++f) {
    if (a[f].hard != b[f].hard || !(a[f].soft == b[f].soft)) return false;
  }
  return true;
}

// Every degradation on cases small enough to be worked out by hand. Counts, cells and refusals:
// tests/bad_files/labels.cases.

using Labels = std::vector<std::int16_t>;

constexpr std::int16_t V = kVoid;

std::int64_t count(const Labels& labels, std::int16_t value) { return std::count(labels.begin(), labels.end(), value); }

// Frame of one class, which is the last of the table: pixels that were drawn and got another one can be recognised.
Case one_colour(int classes, int width, int height) {
  Case c = scene_of(classes);
  Labels all;
  for (int k = 0; k < classes; ++k) all.push_back(static_cast<std::int16_t>(k));
  c.add(classes, 1, all);  // the scene has every class
  c.labels[0] = {};
  c.add(width, height, Labels(static_cast<std::size_t>(width * height), static_cast<std::int16_t>(classes - 1)));
  return c;
}

TEST(PixelNoise, ALargerRatioTakesTheSamePixelsAndMore) {
  Case half = one_colour(3, 30, 20), most = one_colour(3, 30, 20);
  half.apply(*step("pixel_noise", "{ratio: 0.5}"));
  most.apply(*step("pixel_noise", "{ratio: 0.9}"));
  for (std::size_t p = 0; p < 600; ++p) {
    if (half.labels[1].hard[p] != 2) {
      EXPECT_EQ(half.labels[1].hard[p], most.labels[1].hard[p]);
    }
  }
}

TEST(PixelNoise, DrawsOnlyClassesThatTheSceneHas) {
  Case c = scene_of(50);
  c.add(40, 30, Labels(1200, 7));
  c.scene.class_pixels[0][11] = 1;
  c.apply(*step("pixel_noise", "{ratio: 1}"));
  const std::set<std::int16_t> found(c.labels[0].hard.begin(), c.labels[0].hard.end());
  EXPECT_EQ(found, (std::set<std::int16_t>{V, 7, 11}));
}

// Instance 5 covers 1, 2, 3, 4, 5, 6 of 10 pixels in frames 3, 1, 5, 0, 2, 4; instance 9 one pixel in frames 0 and 1.
Case instances() {
  Case c = scene_of(4);
  const int areas[6] = {4, 2, 5, 1, 6, 3};
  for (int f = 0; f < 6; ++f) {
    Labels label(10, 0);
    std::vector<std::int32_t> instance(10, 0);
    for (std::size_t p = 0; p < static_cast<std::size_t>(areas[f]); ++p) {
      label[p] = 1;
      instance[p] = 5;
    }
    if (f < 2) {
      label[9] = 2;
      instance[9] = 9;
    }
    c.add(5, 2, label, instance);
  }
  c.scene.class_pixels[0][3] = 1;  // so the wrong class of instance 5 may be 0, 2 or 3
  return c;
}

TEST(RegionNoise, TheWholeMaskGetsOneOtherClassAndNothingElseChanges) {
  std::set<std::int16_t> drawn;
  for (std::uint64_t seed = 1; seed <= 40; ++seed) {
    Case c = instances();
    const Case clean = c;
    c.apply(*step("region_noise", "{ratio: 1, instances: [5]}"), seed);
    for (std::size_t f = 0; f < 6; ++f) {
      const std::int16_t wrong = c.labels[f].hard[0];
      EXPECT_NE(wrong, 1);
      drawn.insert(wrong);
      for (std::size_t p = 0; p < 10; ++p)
        EXPECT_EQ(c.labels[f].hard[p], c.scene.frames[f].instance[p] == 5 ? wrong : clean.labels[f].hard[p]);
    }
  }
  EXPECT_EQ(drawn, (std::set<std::int16_t>{0, 2, 3}));
}

// Pixels of `label` that are connected with its first one.
std::int64_t connected(const Labels& labels, int width, std::int16_t label) {
  const auto size = static_cast<int>(labels.size());
  std::set<int> reached;
  std::vector<int> todo{static_cast<int>(std::find(labels.begin(), labels.end(), label) - labels.begin())};
  while (!todo.empty()) {
    const int p = todo.back();
    todo.pop_back();
    if (p < 0 || p >= size || labels[p] != label || !reached.insert(p).second) continue;
    if (p % width != 0) todo.push_back(p - 1);
    if (p % width != width - 1) todo.push_back(p + 1);
    todo.push_back(p - width);
    todo.push_back(p + width);
  }
  return static_cast<std::int64_t>(reached.size());
}

// Left half class 0, right half class 1, a few pixels of class 2 apart from each other, a void row.
Case halves(int width, int height) {
  Case c = scene_of(3);
  Labels label;
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      const bool dot = x % 4 == 1 && y % 5 == 2;
      label.push_back(y == 0 ? V : dot ? std::int16_t{2} : static_cast<std::int16_t>(2 * x >= width));
    }
  }
  c.add(width, height, label);
  return c;
}

TEST(Propagation, AClickIsOnePixelOfEachClass) {
  std::set<std::size_t> clicks;
  for (std::uint64_t seed = 1; seed <= 50; ++seed) {
    Case c = halves(32, 20);
    const Labels clean = c.labels[0].hard;
    const StepFacts facts = c.apply(*step("propagation"), seed);
    const Labels& kept = c.labels[0].hard;
    for (std::int16_t k = 0; k < 3; ++k) EXPECT_EQ(count(kept, k), 1);
    for (std::size_t p = 0; p < kept.size(); ++p) {
      if (kept[p] != V) {
        EXPECT_EQ(kept[p], clean[p]);
      }
      if (kept[p] == 0) clicks.insert(p);
    }
    EXPECT_EQ(fact(facts, "clicks (a class of a frame)"), "3");
  }
  EXPECT_GT(clicks.size(), 40u) << "clicks fall anywhere in the class";
}

TEST(Propagation, AShareIsExactAndConnected) {
  for (const double share : {0.01, 0.05, 0.1, 0.5}) {
    Case c = halves(32, 20);
    const Labels clean = c.labels[0].hard;
    c.apply(*step("propagation", "{share: " + std::to_string(share) + "}"));
    for (std::int16_t k = 0; k < 2; ++k) {
      const auto wanted = std::max(
          std::int64_t{1}, static_cast<std::int64_t>(std::lround(share * static_cast<double>(count(clean, k)))));
      EXPECT_EQ(count(c.labels[0].hard, k), wanted) << share;
      EXPECT_EQ(connected(c.labels[0].hard, 32, k), wanted) << share;
    }
  }
}

TEST(Propagation, ASmallComponentIsFollowedByTheNextInReadingOrder) {
  // Class 0 in pieces of one pixel, class 1 between them: 6 pieces, half of them kept, from the click on.
  for (std::uint64_t seed = 1; seed <= 20; ++seed) {
    Case c = scene_of(2);
    c.add(4, 3, {0, 1, 0, 1, 1, 0, 1, 0, 0, 1, 0, 1});
    const std::vector<std::size_t> pieces{0, 2, 5, 7, 8, 10};
    const StepFacts facts = c.apply(*step("propagation", "{share: 0.5}"), seed);
    std::string kept;
    for (const std::size_t p : pieces) kept += c.labels[0].hard[p] == 0 ? 'x' : '.';
    EXPECT_HAS((kept + kept), "xxx...") << kept;
    EXPECT_EQ(fact(facts, "regions, where one was too small for the share"), "6");  // three of each class
  }
}

TEST(Propagation, ALargerShareContainsTheSmaller) {
  Case small = halves(32, 20), large = halves(32, 20);
  small.apply(*step("propagation", "{share: 0.05}"));
  large.apply(*step("propagation", "{share: 0.2}"));
  for (std::size_t p = 0; p < small.labels[0].hard.size(); ++p) {
    if (small.labels[0].hard[p] != V) {
      EXPECT_EQ(small.labels[0].hard[p], large.labels[0].hard[p]);
    }
  }
}

TEST(Propagation, AllOfAClassMayBeKept) {
  Case c = halves(32, 20);
  const Labels clean = c.labels[0].hard;
  c.apply(*step("propagation", "{share: 1}"));
  EXPECT_EQ(c.labels[0].hard, clean);
}

// What every degradation promises, on real labels too; and predictions of a simulated network.

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
    EXPECT_HAS(error_of([&] { c.apply(*step(row.type, row.keys)); }), row.type, "rgb_2", "hard labels");
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

// Degradations on Replica frames, where they are at hand: the figures that the page of experiments states.

Case room(int frames = 3) {
  Case c = scene_of(12);
  for (int f = 0; f < frames; ++f) add_blocks(c, 96, 72, static_cast<std::uint64_t>(f));
  return c;
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

}  // namespace
}  // namespace semfield
