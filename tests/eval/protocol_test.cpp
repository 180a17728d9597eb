// Published protocols: which classes count, what is void, and a checksum of the truth.
#include "eval/evaluator.h"
#include "tests/says.h"

namespace semfield {
namespace {

ClassTable table() {
  return ClassTable({{0, "void", {}, true},
                     {1, "wall", {}, false},
                     {2, "Night-Stand", {}, false},
                     {3, "mug", {}, false},
                     {4, "refridgerator", {}, false}});
}

// Truth and prediction as rows of classes: 10 walls, 2 of them mugs; 4 stands, all right; 6 mugs, 5 of them walls.
ConfusionMatrix confusion() {
  ConfusionMatrix out(4);
  const auto add = [&](std::int16_t truth, std::int16_t predicted, int count) {
    const std::vector<std::int16_t> t(static_cast<std::size_t>(count), truth), p(t.size(), predicted);
    out.add(t, p);
  };
  add(0, 0, 8);
  add(0, 2, 2);
  add(1, 1, 4);
  add(2, 2, 1);
  add(2, 0, 5);
  return out;
}

TEST(Protocol, EveryClassOfTheSceneCounts) {
  for (const char* name : {"semantic_nerf", "panoptic_lifting"}) {
    const ProtocolScore score = protocol_score(protocol_named(name), confusion(), table());
    ASSERT_EQ(score.classes.size(), 4U);
    EXPECT_EQ(score.scored_px, 20);
    EXPECT_DOUBLE_EQ(*score.classes[0].iou, 8.0 / 15);
    EXPECT_FALSE(score.classes[3].iou) << "a class that is not in truth";
    EXPECT_DOUBLE_EQ(*score.miou, (8.0 / 15 + 1 + 1.0 / 8) / 3);
    EXPECT_DOUBLE_EQ(*score.total_accuracy, 13.0 / 20);
    EXPECT_DOUBLE_EQ(*score.average_accuracy, (0.8 + 1 + 1.0 / 6) / 3);
    EXPECT_DOUBLE_EQ(*score.miou, *confusion().miou_present());
  }
}

// A mug is no class of NYU40: true mugs are void, and a wall that is taken for one is wrong.
TEST(Protocol, WhatIsNotInTheListIsVoid) {
  const ProtocolScore score = protocol_score(protocol_named("nyu40"), confusion(), table());
  EXPECT_EQ(score.void_classes, std::vector<std::string>{"mug"});
  ASSERT_EQ(score.classes.size(), 3U) << "names are compared in small letters, without '-', and as ScanNet spells them";
  EXPECT_EQ(score.scored_px, 14);
  EXPECT_DOUBLE_EQ(*score.miou, (0.8 + 1) / 2);
  EXPECT_DOUBLE_EQ(*score.total_accuracy, 12.0 / 14);
  const ProtocolScore twenty = protocol_score(protocol_named("scannet20"), confusion(), table());
  EXPECT_EQ(twenty.void_classes, (std::vector<std::string>{"Night-Stand", "mug"}));
  EXPECT_DOUBLE_EQ(*twenty.miou, 0.8);
}

TEST(Protocol, WhatDoesNotFitIsNamed) {
  EXPECT_ERROR(protocol_named("ade20k"), "eval.protocol.unknown", "ade20k", "scannet20");
  const ClassTable mugs({{1, "mug", {}, false}});
  EXPECT_ERROR(protocol_score(protocol_named("nyu40"), ConfusionMatrix(1), mugs), "eval.protocol.classes", "mug");
  EXPECT_FALSE(protocol_score(protocol_named("semantic_nerf"), ConfusionMatrix(1), mugs).miou);
}

TEST(Protocol, TheTruthHasAChecksum) {
  std::vector<FrameInfo> infos(2);
  std::vector<StoredFrame> frames(2);
  const auto hash = [&](std::vector<std::int16_t> labels, const ClassTable& classes) {
    infos[1].name = "b";
    infos[1].camera.width_px = 2;
    infos[1].camera.height_px = 1;
    frames[1].label = LabelMap(labels);
    return truth_hash(std::vector<int>{1}, infos, frames, classes);
  };
  const ClassTable more({{0, "void", {}, true}, {1, "wall", {}, false}, {4, "refridgerator", {}, false}});
  const std::string first = hash({0, 3}, table());
  EXPECT_EQ(first.size(), 8U);
  EXPECT_EQ(first, hash({0, 1}, more)) << "ids count, and not their places in the table";
  EXPECT_NE(first, hash({0, kVoid}, table()));
  EXPECT_NE(first, hash({3, 0}, table()));
}

}  // namespace
}  // namespace semfield
