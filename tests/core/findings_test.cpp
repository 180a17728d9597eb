// Findings as people read them: the same trouble of many places is one line.
#include "core/findings.h"

#include <gtest/gtest.h>

#include "core/spelling.h"

namespace semfield {
namespace {

std::vector<std::string> lines(const Diagnostics& d) {
  std::vector<std::string> out;
  for (const Diagnostic& finding : folded(d)) out.push_back(finding.text());
  return out;
}

TEST(Diagnostics, TheSameTroubleOfManyPlacesIsOneLine) {
  Diagnostics d;
  d.error("classes.yaml", "no classes in it", "write one");
  for (int i = 0; i < 35; ++i) {
    const std::string n = std::to_string(i), file = "/my data/it's/rgb_" + n + ".png";
    d.error("frame 'rgb_" + n + "' (" + file + ")", "colour image '" + file + "' is missing", "restore it");
    d.warning("/my data/transforms.json: frame " + n + " (rgb (" + n + ").png)", "pose is 0.0" + n + " off");
  }
  d.error("frame 'x' (x.png)", "colour image 'a/x.png' is missing", "take another");
  EXPECT_EQ(lines(d), (std::vector<std::string>{
                          "classes.yaml: no classes in it; write one",
                          "frame 'rgb_0' (/my data/it's/rgb_0.png): colour image '/my data/it's/rgb_0.png' is missing; "
                          "restore it (and 34 more like this: frame 'rgb_1', frame 'rgb_2', frame 'rgb_3', frame "
                          "'rgb_4', ...)",
                          "/my data/transforms.json: frame 0 (rgb (0).png): pose is 0.00 off (and 34 more like this: "
                          "transforms.json: frame 1, transforms.json: frame 2, transforms.json: frame 3, "
                          "transforms.json: frame 4, ...)",
                          "frame 'x' (x.png): colour image 'a/x.png' is missing; take another"}));
  EXPECT_EQ(d.all().size(), 72u);
}

TEST(Diagnostics, WhatOnePlaceSaysTwiceIsKeptUnlessItIsTheSame) {
  Diagnostics d;
  d.error("classes.yaml", "id 3 is there twice", "keep one");
  d.error("classes.yaml", "id 5 is there twice", "keep one");
  d.error("classes.yaml", "id 5 is there twice", "keep one");
  d.error("room.yaml:3:5", "unknown key 'a'");
  d.error("room.yaml:4:5", "unknown key 'b'");
  EXPECT_EQ(lines(d), (std::vector<std::string>{"classes.yaml: id 3 is there twice; keep one",
                                                "classes.yaml: id 5 is there twice; keep one",
                                                "room.yaml:3:5: unknown key 'a'", "room.yaml:4:5: unknown key 'b'"}));
}

TEST(Diagnostics, AnExceptionListsThemFolded) {
  Diagnostics d;
  d.warning("frame '0'", "is dark");
  for (int i = 0; i < 3; ++i) d.error("frame '" + std::to_string(i) + "'", "is black", "expose longer");
  try {
    d.throw_if_errors(ErrorKind::data, "problems:");
    FAIL();
  } catch (const Error& e) {
    EXPECT_STREQ(e.what(),
                 "problems:\nframe '0': is black; expose longer (and 2 more like this: frame '1', frame '2')");
  }
}

TEST(Spelling, PartsInCommonCountOnlyWhereAsked) {
  const std::vector<std::string> known{"label_path", "file_path"};
  EXPECT_EQ(did_you_mean("normal_path", known), "label_path");
  EXPECT_EQ(closest_spelling("normal_path", known), "");
  EXPECT_EQ(closest_spelling("lable_path", known), "label_path");
}

}  // namespace
}  // namespace semfield
