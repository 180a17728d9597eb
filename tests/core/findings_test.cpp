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
  d.error("test.finding.made", "classes.yaml", "no classes in it", "write one");
  for (int i = 0; i < 35; ++i) {
    const std::string n = std::to_string(i), file = "/my data/it's/rgb_" + n + ".png";
    d.error("test.finding.made", "frame 'rgb_" + n + "' (" + file + ")", "colour image '" + file + "' is missing",
            "restore it");
    d.warning("test.finding.made", "/my data/transforms.json: frame " + n + " (rgb (" + n + ").png)",
              "pose is 0.0" + n + " off", {});
  }
  d.error("test.finding.made", "frame 'x' (x.png)", "colour image 'a/x.png' is missing", "take another");
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
  d.error("test.finding.made", "classes.yaml", "id 3 is there twice", "keep one");
  d.error("test.finding.made", "classes.yaml", "id 5 is there twice", "keep one");
  d.error("test.finding.made", "classes.yaml", "id 5 is there twice", "keep one");
  d.error("test.finding.made", "room.yaml:3:5", "unknown key 'a'", {});
  d.error("test.finding.made", "room.yaml:4:5", "unknown key 'b'", {});
  EXPECT_EQ(lines(d), (std::vector<std::string>{"classes.yaml: id 3 is there twice; keep one",
                                                "classes.yaml: id 5 is there twice; keep one",
                                                "room.yaml:3:5: unknown key 'a'", "room.yaml:4:5: unknown key 'b'"}));
}

TEST(Diagnostics, AnExceptionListsThemFolded) {
  Diagnostics d;
  d.warning("test.finding.made", "frame '0'", "is dark", {});
  for (int i = 0; i < 3; ++i)
    d.error("test.finding.made", "frame '" + std::to_string(i) + "'", "is black", "expose longer");
  try {
    d.throw_if_errors(ErrorKind::data, "problems:");
    FAIL();
  } catch (const Error& e) {
    EXPECT_STREQ(e.what(),
                 "problems:\nframe '0': is black; expose longer (and 2 more like this: frame '1', frame '2')");
  }
}

TEST(Codes, StandBehindTheSentenceWherePeopleReadIt) {
  EXPECT_EQ(shown(Error(ErrorKind::data, "scene.pose.mirrored", "pose mirrors", "flip an axis").while_doing("reading")),
            "reading: pose mirrors; flip an axis [scene.pose.mirrored]");
  EXPECT_EQ(shown(Error(ErrorKind::no_input, "scene.poses.missing", "COLMAP finds poses:\ncolmap mapper --x y")),
            "COLMAP finds poses: [scene.poses.missing]\ncolmap mapper --x y");
  Diagnostics d;
  d.error("scene.image.size", "frame 'a'", "is small", "take another");
  d.error("scene.pose.rotation", "frame 'b'", "is no rotation", {});
  EXPECT_EQ(d.all()[1].shown(), "frame 'b': is no rotation [scene.pose.rotation]");
  try {
    d.throw_if_errors(ErrorKind::data, "problems:");
    FAIL();
  } catch (Error& e) {
    EXPECT_EQ(e.code(), Code("scene.image.size")) << "that of the first";
    e.while_doing("opening");
    EXPECT_EQ(shown(e),
              "opening: problems:\nframe 'a': is small; take another [scene.image.size]\n"
              "frame 'b': is no rotation [scene.pose.rotation]");
  }
}

TEST(Codes, FindingsOfTwoCodesAreNotFolded) {
  Diagnostics d;
  d.error("scene.image.size", "frame '0'", "is black", "expose longer");
  d.error("scene.image.kind", "frame '1'", "is black", "expose longer");
  EXPECT_EQ(folded(d).size(), 2u);
}

TEST(Codes, AreReadFromTextOnlyWhereTheyAreSome) {
  EXPECT_STREQ(Code::parse(std::string("run.folder.busy"))->text(), "run.folder.busy");
  EXPECT_EQ(Code::parse("run.folder.busy"), Code::parse("run.folder.busy"));
  for (const char* none : {"", "run", "run.", ".run", "run..folder", "Run.folder", "run folder.busy", "a.b.c.d.e"})
    EXPECT_FALSE(Code::parse(none)) << none;
}

TEST(Spelling, PartsInCommonCountOnlyWhereAsked) {
  const std::vector<std::string> known{"label_path", "file_path"};
  EXPECT_EQ(did_you_mean("normal_path", known), "label_path");
  EXPECT_EQ(closest_spelling("normal_path", known), "");
  EXPECT_EQ(closest_spelling("lable_path", known), "label_path");
}

}  // namespace
}  // namespace semfield
