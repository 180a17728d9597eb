// A report holds against each other what can be: the same data, the same frames, and only evaluations that were made.
#include "report/report_comparison.h"

#include "report/report_sections.h"
#include "tests/says.h"

namespace semfield {
namespace {

MetricsRow eval_row(double train_s, double psnr, const std::string& split = "test", double frames = 30) {
  MetricsRow row;
  row.kind = "eval";
  row.split = split;
  row.step = static_cast<std::int64_t>(10 * train_s);
  row.train_s = train_s;
  row.set("psnr", psnr);
  row.set("frames", frames);
  if (frames < 30) {
    row.set("split_frames", 30);
    row.set("pixel_stride", 1);
  }
  return row;
}

ReportRun run_of(const std::string& name, std::vector<MetricsRow> rows, const std::string& input_hash = "aa") {
  ReportRun run;
  run.name = name;
  run.rows = std::move(rows);
  run.environment = {
      {"version", "0.1.0"}, {"cpu", "EPYC"}, {"input_hash", input_hash}, {"started", "2026-11-22 15:10 UTC"}};
  run.scene = "obj_room, room";
  return run;
}

// Two samples while training, then the whole split.
std::vector<MetricsRow> long_run() {
  return {eval_row(10, 23.8, "test_sample", 4), eval_row(58.3, 27, "test_sample", 4), eval_row(58.3, 25)};
}

TEST(ReportComparison, TimesAreReadFromEvaluationsThatExist) {
  ReportInput input{.runs = {run_of("long", long_run()), run_of("short", {eval_row(40, 20.58)})}};
  const std::string page = curves_section(input, "test");
  // Of the whole split "long" was scored once, at its end: that it came to the level only then is not known.
  EXPECT_HAS(page,
             "PSNR ≥ 20.58 dB</th><td class=\"num\">≤ 58.3 s<small class=\"d\">its only "
             "evaluation</small></td><td class=\"num\">≤ 40.0 s<small class=\"d\">its only evaluation");
  EXPECT_LACKS(page, "num best") << "neither was first for certain";
  EXPECT_HAS(page, "long: a sample, 4 of 30 frames; short: all frames");
  // Two runs with samples of the same frames are held against each other on these.
  input.runs[1].rows = {eval_row(10, 15, "test_sample", 4), eval_row(40, 20, "test_sample", 4), eval_row(40, 20.58)};
  const std::string both = curves_section(input, "test");
  EXPECT_HAS(both,
             "PSNR ≥ 20.00 dB</th><td class=\"num best\">≤ 10.0 s<small class=\"d\">its first "
             "evaluation</small></td><td class=\"num\">40.0 s</td>",
             "are of a sample: 4 of 30 frames.");
}

TEST(ReportComparison, ALevelIsReachedBetweenTwoEvaluations) {
  const std::vector<MetricsRow> rows{eval_row(10, 20), eval_row(20, 24), eval_row(30, 23)};
  const std::vector<const MetricsRow*> all{&rows[0], &rows[1], &rows[2]};
  const auto between = time_of_level(all, "psnr", 1, 23);
  ASSERT_TRUE(between);
  EXPECT_EQ(between->not_before_s, 10);
  EXPECT_EQ(between->not_after_s, 20);
  EXPECT_FALSE(between->at_first);
  EXPECT_TRUE(time_of_level(all, "psnr", 1, 20)->at_first);
  EXPECT_FALSE(time_of_level(all, "psnr", 1, 20)->only);
  EXPECT_TRUE(time_of_level({&rows[0]}, "psnr", 1, 20)->only);
  EXPECT_FALSE(time_of_level(all, "psnr", 1, 25));
  EXPECT_FALSE(time_of_level(all, "miou", 1, 0));
  const LevelTime early{0, 10}, late{10, 20}, overlapping{5, 15};
  EXPECT_EQ(first_for_certain({late, early}), 1);
  EXPECT_EQ(first_for_certain({early, overlapping}), -1);
  EXPECT_EQ(first_for_certain({early, early}), -1);
  EXPECT_EQ(first_for_certain({early, std::nullopt}), -1);
}

TEST(ReportComparison, RunsOnOtherDataAreNotRankedAndThePageSaysWhy) {
  ReportInput input{
      .runs = {run_of("a", {eval_row(10, 20), eval_row(20, 30)}), run_of("b", {eval_row(10, 15), eval_row(20, 25)})}};
  EXPECT_TRUE(unranked_because(input, "test").empty());
  EXPECT_HAS(make_report(input), "best: a");
  input.runs[1] = run_of("b", {eval_row(10, 15), eval_row(20, 25)}, "bb");
  input.runs[1].scene = "replica, <office>";
  const std::string page = make_report(input);
  EXPECT_HAS(page,
             "<p class=\"notice\">The runs are not ranked: they read different data (another scene, or "
             "other frames or sizes of one): a on obj_room, room; b on replica, &lt;office&gt;.</p>")
      << notice_section(input, "test");
  EXPECT_LACKS(page, "num best", "best: ", "Time to a common level");
}

TEST(ReportComparison, RunsScoredOnOtherFramesAreNotRanked) {
  ReportInput input{.runs = {run_of("all", {eval_row(20, 30)}), run_of("some", {eval_row(20, 31, "test_sample", 6)})}};
  const auto reasons = unranked_because(input, "test");
  ASSERT_EQ(reasons.size(), 1u);
  EXPECT_EQ(reasons[0],
            "their last evaluations scored other parts of the split: all all 30 frames; some a sample, 6 of 30 frames");
  EXPECT_LACKS(figures_section(input, "test"), "num best");
  // The same number of frames, but others.
  input.runs[1].rows = {eval_row(20, 31)};
  FrameScore odd, even;
  odd.name = "frame_1";
  even.name = "frame_2";
  input.runs[0].eval.emplace().frames = {odd};
  input.runs[1].eval.emplace().frames = {even};
  ASSERT_EQ(unranked_because(input, "test").size(), 1u);
  EXPECT_HAS(unranked_because(input, "test")[0], "scored on other frames: all on frame_1 and others");
  input.runs[1].eval->frames = {odd};
  EXPECT_TRUE(unranked_because(input, "test").empty());
}

TEST(ReportComparison, FiguresOfASampleSaySo) {
  ReportInput input{
      .runs = {run_of("short", {eval_row(5, 18, "test_sample", 4), eval_row(6, 21.5, "test_sample", 2)})}};
  EXPECT_EQ(report_split(input.runs[0].rows), "test");
  const std::string page = make_report(input);
  EXPECT_HAS(
      page,
      "Figures are of a sample of the split “test” (2 of 30 frames); `semfield eval` on the run "
      "folder scores every pixel, and `semfield report` shows that then.",
      "short<small class=\"d\">sample: 2 of 30 frames</small>",
      "21.5<span class=\"u\">dB</span></div><div class=\"n\">from the squared error pooled over the split; a sample, "
      "2 of 30 frames</div>");
  EXPECT_HAS(page, "<td class=\"num\">21.50</td>") << "the last evaluation, not the sample of other frames";
  EXPECT_EQ(sample_text(eval_row(1, 2)), "");
  input.runs[0].rows.push_back(eval_row(6, 20.5));
  EXPECT_HAS(make_report(input), "20.5<span class=\"u\">dB</span>", "pooled over the split; all 30 frames</div>");
}

TEST(ReportComparison, FiguresAreThoseOfTheLastEvaluationWhateverItsPart) {
  MetricsRow strided = eval_row(20, 27, "test_sample");
  strided.set("split_frames", 30);
  strided.set("pixel_stride", 7);
  // All of an earlier step, which the run then left.
  const ReportRun run = run_of("a", {eval_row(10, 24), eval_row(15, 20, "test_sample", 4), strided});
  EXPECT_EQ(last_value(run, "test", "psnr"), 27);
  EXPECT_EQ(sample_text(run, "test"), "all 30 frames at 1 pixel in 49");
  EXPECT_HAS(
      curves_section(
          {.runs = {run_of("a", {eval_row(5, 18, "test_sample", 4), eval_row(20, 21, "test_sample", 4), strided})}},
          "test"),
      "of a sample: 4 of 30 frames. The figures above are of a sample, all 30 frames at 1 pixel in 49, so they "
      "differ from the ends of the curves.");
}

TEST(ReportComparison, RunsScoredOnOtherPixelsAreNotRanked) {
  ReportInput input{.runs = {run_of("all", {eval_row(20, 30)}), run_of("part", {eval_row(20, 31)})}};
  input.runs[0].rows[0].set("pixels", 900);
  input.runs[1].rows[0].set("pixels", 900);
  EXPECT_TRUE(unranked_because(input, "test").empty());
  input.runs[1].rows[0].set("pixels", 300);
  ASSERT_EQ(unranked_because(input, "test").size(), 1u);
  EXPECT_EQ(unranked_because(input, "test")[0], "they were scored on other pixels: all on 900; part on 300");
}

TEST(ReportHead, TellsSceneFramesDateAndVersion) {
  ReportInput input{.runs = {run_of("a", {eval_row(20, 30)})}};
  input.runs[0].labels = LabelCounts{200, 20, 100, 10, {{1, "wall", 10}}, {}};
  const std::string one = facts_section(input, "test");
  EXPECT_HAS(one, "<dt>Scene</dt><dd>obj_room, room</dd>",
             "<dt>Frames</dt><dd>200 training (20 labelled), 30 test</dd>",
             "<dt>Started</dt><dd>2026-11-22 15:10 UTC</dd>", "<dt>Version</dt><dd>Semfield 0.1.0</dd>");
  input.runs.push_back(ReportRun{});
  EXPECT_HAS(facts_section(input, "test"), "<td>obj_room, room</td>");
  input.runs = {ReportRun{}};
  EXPECT_EQ(facts_section(input, "test"), "") << "nothing is known";
}

TEST(ReportHead, TheLongestTrainingIsThatOfOneRun) {
  ReportInput input{.runs = {run_of("slow", {eval_row(242, 30)}), run_of("quick", {eval_row(100, 30)})}};
  input.runs[0].rows[0].step = 300;
  input.runs[1].rows[0].step = 2500;
  const std::string cards = cards_section(input, "test");
  EXPECT_HAS(cards, "4 min 02 s</div><div class=\"n\">slow: 300 steps, evaluation not counted");
  EXPECT_LACKS(cards, "2,500");
}

TEST(ReportPage, ARunWithoutAnEvaluationSaysSo) {
  ReportInput input;
  MetricsRow train;
  train.set("loss", 0.1);
  input.runs = {run_of("a", {train})};
  const std::string page = make_report(input);
  EXPECT_HAS(page, "No frame was scored: the scene has no test frames");
  EXPECT_LACKS(page, "Last evaluation");
}

TEST(ReportPage, PicturesStandAboveTheFigures) {
  ReportInput input{.runs = {run_of("a", {eval_row(20, 30)})}};
  for (const char* name : {"1", "2", "3"}) input.strips.push_back({name, "", {{"colour", {1, 2, 3}}}});
  const std::string page = make_report(input);
  EXPECT_LT(page.find("id=\"frames\""), page.find("id=\"figures\""));
  EXPECT_HAS(page, "<summary>2 more frames</summary>");
}

TEST(ReportPage, ASceneWithoutClassesHasNoSectionOfLabels) {
  ReportInput input{.runs = {run_of("photos", {eval_row(20, 30)}), run_of("room", {eval_row(20, 30)})}};
  for (ReportRun& run : input.runs) run.labels.emplace().train_frames = 30;
  EXPECT_EQ(labels_section(input, "test"), "");
  EXPECT_LACKS(make_report(input), "href=\"#labels\"");
  input.runs[1].labels->classes = {{1, "wall", 10}};
  EXPECT_HAS(labels_section(input, "test"), "because their scenes have no classes: photos.</p>");
}

TEST(ReportPage, WhatSeveralRunsLeaveOutStandsOnce) {
  ReportInput input{.runs = {run_of("a", {}), run_of("b", {}), run_of("c", {})}};
  const LeftOutRow depth{"depth loss", "no weight", "0", "B", "4 B", ""},
      head{"semantic head", "no labels", "0", "B", "", "3 %"};
  input.runs[0].left_out = {depth, head};
  input.runs[1].left_out = {depth};
  input.runs[2].left_out = {depth};
  const std::string html = left_out_section(input);
  EXPECT_HAS(html, "depth loss<small class=\"d\">no weight</small><small class=\"d\">every run</small>",
             "semantic head<small class=\"d\">no labels</small><small class=\"d\">a</small>", "measured: 3 %");
  EXPECT_EQ(html.find("depth loss"), html.rfind("depth loss"));
}

}  // namespace
}  // namespace semfield
