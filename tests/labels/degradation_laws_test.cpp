// What every degradation promises: seeded, independent of threads and of other frames' labels, void rules, soft labels.
#include "tests/labels/degradation_testing.h"

namespace semfield {
namespace {

using namespace testing_degrade;
using testing_room::error_of;

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
    EXPECT_NE(message.find(named), std::string::npos) << type << keys << ": " << message;
  }
}

}  // namespace
}  // namespace semfield
