// The program's words about scores: those of a sample cannot be taken for those of the split.
#include <gtest/gtest.h>

#include <filesystem>

#include "tests/program.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;
using testing_program::Result;
using testing_program::semfield_run;

TEST(ScoreLines, ASampleHasNamesOfItsOwn) {
  const TempDir dir;
  write_packed_config(dir, 200, 60);
  // A time that the first step exceeds leaves time for the least evaluation: a frame.
  const Result cut = semfield_run("train config.yaml --time 0.001s --threads 1 --out cut", dir.path());
  ASSERT_EQ(cut.code, 0) << cut.err;
  EXPECT_EQ(cut.out.find("train: sample=1/3 sample_miou_present=0."), 0u) << cut.out;
  for (const char* name : {" miou_present=", " total_accuracy=", " psnr=", " absrel="})
    EXPECT_EQ(cut.out.find(name), std::string::npos) << name;
  EXPECT_NE(
      cut.err.find("the last evaluation scores 1 of 3 frames to end near the time asked for (report.eval_share 0.1); "
                   "`semfield eval cut` scores all\n"),
      std::string::npos)
      << cut.err;
  const Result eval = semfield_run("eval cut", dir.path());
  EXPECT_EQ(eval.out.find("cut: 3 test frames, step "), 0u) << eval.out;

  const Result whole =
      semfield_run("train config.yaml --time 0.001s --set report.eval_share=0 --threads 1 --out whole -q", dir.path());
  ASSERT_EQ(whole.code, 0) << whole.err;
  EXPECT_EQ(whole.out.find("train: miou_present=0."), 0u) << whole.out;
  EXPECT_EQ(whole.err, "") << "-q";
}

TEST(ScoreLines, FiguresThatTheSceneCannotHaveAreNotPrinted) {
  const TempDir dir;
  write_packed_config(dir, 2, 60);
  const Result r = semfield_run("train config.yaml --set scene.labels.frames=none --threads 1 --out run", dir.path());
  ASSERT_EQ(r.code, 0) << r.err;
  EXPECT_EQ(r.out.find("train: psnr="), 0u) << r.out;
  EXPECT_NE(r.out.find(" absrel="), std::string::npos) << r.out;
  EXPECT_EQ(r.out.find("=-"), std::string::npos) << r.out;
}

TEST(Findings, WhatTrainingHasShownIsNotSaidAgain) {
  const TempDir dir;
  write_packed_config(dir, 2, 60);
  const std::string warning = "the size asked for changes the aspect ratio";
  const Result trained = semfield_run(
      "train config.yaml --set scene.load.width_px=20 --set scene.load.height_px=36 --threads 1 --out run", dir.path());
  ASSERT_EQ(trained.code, 0) << trained.err;
  EXPECT_NE(trained.err.find(warning), std::string::npos) << trained.err;
  for (const char* verb : {"eval run", "render run"}) {
    const Result r = semfield_run(verb, dir.path());
    EXPECT_EQ(r.code, 0) << r.err;
    EXPECT_EQ(r.err.find(warning), std::string::npos) << verb << "\n" << r.err;
  }
  std::filesystem::remove(dir / "run/findings.txt");
  EXPECT_NE(semfield_run("eval run", dir.path()).err.find(warning), std::string::npos);
}

}  // namespace
}  // namespace semfield
