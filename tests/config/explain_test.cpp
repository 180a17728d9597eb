// Explaining where values come from, and what differs between two configs.
#include "config/explain.h"

#include <gtest/gtest.h>

#include "config/compose.h"
#include "config_testing.h"

namespace semfield {
namespace {

std::string diff(const std::string& a, const std::string& b) {
  return diff_config(parse_config_text(a, "a.yaml"), parse_config_text(b, "b.yaml"));
}

TEST(Explain, EveryValueWithItsOrigin) {
  const TempFolder folder;
  const std::string base = folder.write("base.yaml", "train:\n  steps: 10\n  betas: [0.9, 0.999]\nlabels: {}\n");
  const std::string room =
      folder.write("room.yaml", "include: base.yaml\ntrain:\n  rate: 0.1\npasses:\n  - name: größe\n");
  const std::string text = explain_config(compose_config(room, {"train.steps=20", "train.betas.1=0.99"}));
  EXPECT_EQ(text,
            "train:\n"
            "  steps: 20           # --set train.steps=20\n"
            "  betas: [0.9, 0.99]  # " +
                base +
                ":3:10, --set train.betas.1=0.99\n"
                "  rate: 0.1           # " +
                room +
                ":3:9\n"
                "labels: {}            # " +
                base +
                ":4:9\n"
                "passes:\n"
                "  - name: \"größe\"     # " +
                room + ":5:11\n");
  EXPECT_TRUE(
      equal_config(parse_config_text(text, "again"), compose_config(room, {"train.steps=20", "train.betas.1=0.99"})));
}

TEST(Explain, DefaultsAndOddOrigins) {
  const ConfigNode tree = ConfigNode::make_map({{"a", ConfigNode::make_scalar("1", false, {})},
                                                {"b", parse_config_value("'x\n\n  y'", "--set b='x\n\n  y'")},
                                                {"long", ConfigNode::make_scalar(std::string(90, 'x'), false, {})}},
                                               {});
  const std::string text = explain_config(tree);
  EXPECT_EQ(text,
            "a: 1       # default\nb: \"x\\ny\"  # --set b='x    y'\nlong: " + std::string(90, 'x') + "  # default\n");
  EXPECT_TRUE(equal_config(parse_config_text(text, "again"), tree));
}

TEST(Explain, DefaultsBesideWhatWasWritten) {
  const ConfigNode written =
      parse_config_text("train: {rate: 1e-3}\npasses:\n  - name: x\nreport:\nextra: 1\n", "a.yaml");
  const ConfigNode resolved =
      parse_config_value("{train: {steps: 10, rate: 0.001}, passes: [{name: x, n: 2}], report: {strips: 4}}", "");
  EXPECT_EQ(explain_config(with_origins(resolved, written)),
            "train:\n"
            "  steps: 10   # default\n"
            "  rate: 1e-3  # a.yaml:1:15\n"
            "passes:\n"
            "  - name: x   # a.yaml:3:11\n"
            "    n: 2      # default\n"
            "report:\n"
            "  strips: 4   # default\n"
            "extra: 1      # a.yaml:5:8\n");
}

TEST(Diff, NothingDiffers) {
  EXPECT_EQ(diff("a: 1\nb: {c: word}\n", "# moved\nb:\n  c: 'word'\na: 1\n"), "");
  EXPECT_EQ(diff("", ""), "");
  EXPECT_EQ(diff("a: []\nb: {}", "b: {}\na: []"), "");
}

TEST(Diff, OnlyDifferencesByPath) {
  EXPECT_EQ(
      diff("train: {steps: 10, rate: 0.1, betas: [0.9, 0.99]}", "train: {steps: 20, rate: 0.1, betas: [0.9, 0.999]}"),
      "train.steps: 10 -> 20\ntrain.betas: [0.9, 0.99] -> [0.9, 0.999]\n");
  EXPECT_EQ(diff("a: 1", "a: '1'"), "a: 1 -> \"1\"\n");
  EXPECT_EQ(diff("a: 0.1", "a: 0.10"), "a: 0.1 -> 0.10\n");
  EXPECT_EQ(diff("passes: [{name: x, n: 1}]", "passes: [{name: x, n: 2}]"), "passes.x.n: 1 -> 2\n");
  // An index where the names differ: both sides take it.
  EXPECT_EQ(diff("passes: [{name: x, n: 1}]", "passes: [{name: y, n: 2}]"),
            "passes.0.name: x -> y\npasses.0.n: 1 -> 2\n");
}

TEST(Diff, WhatOneSideLacks) {
  EXPECT_EQ(diff("a: 1\nb: {c: 2, d: {e: 3}}\n", "a: 1\nf: [1]\n"),
            "b.c: 2 -> (absent)\nb.d.e: 3 -> (absent)\nf: (absent) -> [1]\n");
  EXPECT_EQ(diff("passes: [{n: 1}]", "passes: [{n: 1}, {n: 2, m: {}}]"),
            "passes.1.n: (absent) -> 2\npasses.1.m: (absent) -> {}\n");
  EXPECT_EQ(diff("passes: [{n: 1}, x]", "passes: []"), "passes.0.n: 1 -> (absent)\npasses.1: x -> (absent)\n");
  EXPECT_EQ(diff("a: {b: 1}", "a: 2"), "a: {b: 1} -> 2\n");
  EXPECT_EQ(diff("a: {b: 1}", "a: {}"), "a.b: 1 -> (absent)\n");
  EXPECT_EQ(diff("[1]", "[2]"), "(top): [1] -> [2]\n");
}

}  // namespace
}  // namespace semfield
