// What `semfield-study scale` makes of measurements: goals, files, tables, and that the page shows its data.
#include "studies/scale_page.h"

#include <gtest/gtest.h>

#include <string>

#include "core/error.h"
#include "system/files.h"

namespace semfield {
namespace {

ScaleRow row(const std::string& machine, const std::string& device, const std::string& step, int ranks,
             std::int64_t rays, double seconds) {
  return {
      machine, step, device, ranks, rays, {seconds, 0.9 * seconds, 1.1 * seconds}, 4, 5e6, step == "hash" ? 1e6 : 0};
}

ScaleResults two_cores() {
  ScaleResults r;
  r.machines = {{"two cores", "cpu", 2, "build"}};
  r.rows = {row("two cores", "cpu", "paper", 1, 1024, 10), row("two cores", "cpu", "paper", 2, 1024, 5.25),
            row("two cores", "cpu", "paper", 1, 256, 2.5), row("two cores", "cpu", "paper", 2, 512, 2.6)};
  return r;
}

std::string goal(const ScaleResults& results, const std::string& name) {
  for (const auto& [key, value] : scale_goals(results)) {
    if (key == name) return value;
  }
  return "no such goal";
}

TEST(ScaleResults, GoalsAreRatiosOfTheRightRows) {
  const ScaleResults r = two_cores();
  EXPECT_EQ(goal(r, "cpu2_strong"), "1.90");
  EXPECT_EQ(goal(r, "cpu2_weak"), "1.92");
  EXPECT_EQ(goal(r, "cpu16_strong"), "-");
  EXPECT_EQ(goal(r, "bits_equal"), "-");
  EXPECT_EQ(scale_line(r),
            "scale: cpu2_strong=1.90 cpu2_weak=1.92 cpu16_strong=- gpu2_weak_paper=- gpu2_strong_paper4096=- "
            "gpu2_weak_hash=- bits_equal=- sweep2=-");
}

TEST(ScaleResults, GoalsOfGpusAreOfTheirOwnSizes) {
  ScaleResults r;
  r.machines = {{"gpus", "cuda", 2, "build"}};
  r.rows = {row("gpus", "cuda", "paper", 1, 1024, 2.2e-3), row("gpus", "cuda", "paper", 2, 2048, 2.2e-3),
            row("gpus", "cuda", "paper", 1, 4096, 8e-3),   row("gpus", "cuda", "paper", 2, 4096, 5e-3),
            row("gpus", "cuda", "hash", 1, 8192, 1e-3),    row("gpus", "cuda", "hash", 2, 16384, 1.25e-3)};
  EXPECT_EQ(goal(r, "gpu2_weak_paper"), "2.00");
  EXPECT_EQ(goal(r, "gpu2_strong_paper4096"), "1.60");
  EXPECT_EQ(goal(r, "gpu2_weak_hash"), "1.60");
  EXPECT_EQ(goal(r, "cpu2_strong"), "-");
}

TEST(ScaleResults, ARatioIsOfOneMachine) {
  ScaleResults r = two_cores();
  r.machines.push_back({"other", "cpu", 16, "build"});
  r.rows.push_back(row("other", "cpu", "paper", 16, 1024, 0.5));  // without its own single rank
  EXPECT_EQ(goal(r, "cpu16_strong"), "-");
  r.rows.push_back(row("other", "cpu", "paper", 1, 1024, 7));
  EXPECT_EQ(goal(r, "cpu16_strong"), "14.00");
}

TEST(ScaleResults, BitsAreEqualWhenAllAreAndSomethingWasCompared) {
  ScaleResults r;
  r.bits = {{"m", "quickstart", 1, 1, ""}};
  EXPECT_EQ(goal(r, "bits_equal"), "-");
  r.bits.push_back({"m", "quickstart", 2, 1, ""});
  EXPECT_EQ(goal(r, "bits_equal"), "yes");
  r.bits.push_back({"m", "quickstart", 3, 1, "tensor 'x' differs from element 4 on"});
  r.bits.push_back({"m", "quickstart", 3, 2, ""});
  EXPECT_EQ(goal(r, "bits_equal"), "no");
  EXPECT_NE(scale_measured(r).find("3 x 1: tensor 'x' differs from element 4 on"), std::string::npos);
}

TEST(ScaleResults, FilesKeepEverything) {
  ScaleResults r = two_cores();
  r.bits = {{"two cores", "quickstart", 2, 1, "differs"}};
  r.sweeps = {{"two cores", "processes of one thread", 8, 20, 11}};
  const ScaleResults back = parse_scale_json(scale_json(r), "x");
  EXPECT_EQ(back.machines, r.machines);
  EXPECT_EQ(back.rows, r.rows);
  EXPECT_EQ(back.bits, r.bits);
  EXPECT_EQ(back.sweeps, r.sweeps);
  EXPECT_EQ(goal(back, "sweep2"), "1.82");
}

TEST(ScaleResults, WrongFilesAreRefusedByName) {
  for (const std::string text : {"{", "{}", "[]", R"({"quick": false, "machines": 3})"}) {
    try {
      parse_scale_json(text, "some/results.json");
      ADD_FAILURE() << text;
    } catch (const Error& error) {
      EXPECT_EQ(error.kind(), ErrorKind::data);
      EXPECT_NE(std::string(error.what()).find("some/results.json"), std::string::npos) << error.what();
    }
  }
  ScaleResults r = two_cores();
  r.rows[0].seconds.min = 0;
  EXPECT_THROW(parse_scale_json(scale_json(r), "x"), Error);
}

TEST(ScaleResults, FreshFiguresReplaceTheirOwn) {
  ScaleResults fresh;
  fresh.machines = {{"two cores", "cpu", 2, "another build"}};
  fresh.rows = {row("two cores", "cpu", "paper", 2, 1024, 5)};
  const ScaleResults all = merged(two_cores(), fresh);
  EXPECT_EQ(all.rows.size(), two_cores().rows.size());
  EXPECT_EQ(all.machines.size(), 1U);
  EXPECT_EQ(all.machines[0].about, "another build");
  EXPECT_EQ(goal(all, "cpu2_strong"), "2.00");
  ScaleResults without_times;
  without_times.machines = {{"two cores", "cpu", 2, "a third build"}};
  without_times.bits = {{"two cores", "quickstart", 2, 1, ""}};
  EXPECT_EQ(merged(all, without_times).machines[0].about, "another build");
  EXPECT_EQ(goal(merged(all, without_times), "bits_equal"), "yes");
  fresh.quick = true;
  EXPECT_THROW(merged(two_cores(), fresh), Error);
}

TEST(ScalePage, TheModelStandsOnOneRankAlone) {
  ScaleResults r = two_cores();
  const std::vector<ScaleCase> cases = scale_cases(r);
  ASSERT_EQ(cases.size(), 1U);
  EXPECT_NEAR(predict_step(cases[0].cost, cases[0].system, 1, 1024).step_s(), 10, 0.01);
  r.rows[1].seconds.median = 100;  // of two ranks
  EXPECT_EQ(scale_cases(r)[0].cost.split_s_per_ray, cases[0].cost.split_s_per_ray);
}

TEST(ScalePage, MarksThatAreMissingAreNamed) {
  EXPECT_THROW(with_scale("# A page\n", two_cores(), "page.md"), Error);
  const std::string page = with_scale(
      "a\n<!-- study scale: measured begin -->\nold\n<!-- study scale: measured end -->\nb\n<!-- study scale: model "
      "begin "
      "--><!-- study scale: model end -->\nc\n",
      two_cores(), "page.md");
  EXPECT_EQ(page.find("old"), std::string::npos);
  EXPECT_EQ(page.find("`cpu2_strong` on a machine"), std::string::npos) << page;  // measured
  EXPECT_NE(page.find("| 2 | 5250 (4725 .. 5775) | 1.90 |"), std::string::npos) << page;
  EXPECT_NE(page.find("`gpu2_weak_paper` on a machine with two GPUs"), std::string::npos) << page;
  EXPECT_EQ(page, with_scale(page, two_cores(), "page.md"));
}

// Whoever changes the model, or how it is shown, renews the page: semfield-study scale --combine
// docs/evidence/scale.json --write-docs docs.
TEST(ScalePage, TheShippedPageShowsItsData) {
  const std::string docs = SEMFIELD_SOURCE_DIR "/docs/", name = docs + "evidence/scale.md";
  const ScaleResults results = parse_scale_json(read_text_file(docs + "evidence/scale.json"), "scale.json");
  EXPECT_FALSE(results.quick);
  EXPECT_EQ(read_text_file(name), with_scale(read_text_file(name), results, name));
  EXPECT_TRUE(read_text_file(docs + "images/scale.svg") == scale_figure(results));
}

}  // namespace
}  // namespace semfield
