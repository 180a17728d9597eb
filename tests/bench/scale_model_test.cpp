// The model of steps on many devices: its limits, what must grow, sums that can be done by hand; and its page.
#include "studies/scale_model.h"

#include "core/error.h"
#include "studies/scale_page.h"
#include "system/files.h"
#include "tests/says.h"

namespace semfield {
namespace {

ScaleSystem chain() { return {"hosts of 4", ScaleExchange::chain, 4, {"near", 2e-6, 5e9}, {"far", 10e-6, 1e9}, 1e6}; }
ScaleSystem all_reduce() {
  return {"hosts of 8", ScaleExchange::all_reduce, 8, {"near", 4e-6, 300e9}, {"far", 10e-6, 11e9}, 1};
}
ScaleSystem free_of_charge(ScaleExchange how) {
  return {"free", how, 4, {"near", 0, INFINITY}, {"far", 0, INFINITY}, 1e6};
}
ScaleStep paper() { return ScaleStep{.fixed_s = 0.01, .split_s_per_ray = 7e-3, .gradient_bytes = 5e6}; }

TEST(ScaleModel, OneDeviceTakesWhatItTakes) {
  ScaleStep step = paper();
  step.repeated_s_per_ray = 1e-3;
  step.gathered_bytes_per_ray = 4000;
  step.lanes = 48;
  for (const ScaleSystem& system : {chain(), all_reduce()}) {
    const ScaleTime time = predict_step(step, system, 1, 100);
    EXPECT_DOUBLE_EQ(time.step_s(), 0.01 + 100 * 8e-3);
    EXPECT_EQ(time.exchange_s, 0);
    EXPECT_DOUBLE_EQ(predict_speedup(step, system, 1, 100, true), 1);
    EXPECT_DOUBLE_EQ(predict_speedup(step, system, 1, 100, false), 1);
  }
}

TEST(ScaleModel, WithoutCostOfExchangeTheSplitPartScalesPerfectly) {
  for (const ScaleExchange how : {ScaleExchange::chain, ScaleExchange::all_reduce}) {
    const ScaleSystem system = free_of_charge(how);
    for (const int devices : {2, 3, 16, 1000}) {
      EXPECT_NEAR(predict_step(paper(), system, devices, 1000).step_s(), 0.01 + 7.0 / devices, 1e-12);
      ScaleStep split = paper();
      split.fixed_s = 0;
      EXPECT_NEAR(predict_speedup(split, system, devices, 1000, true), devices, 1e-9);
      EXPECT_NEAR(predict_speedup(split, system, devices, 1000, false), devices, 1e-9);
    }
  }
}

TEST(ScaleModel, WhatEveryDeviceRepeatsBoundsTheSpeedUp) {
  ScaleStep step{.split_s_per_ray = 9e-3, .repeated_s_per_ray = 1e-3};
  const ScaleSystem system = free_of_charge(ScaleExchange::chain);
  EXPECT_NEAR(predict_speedup(step, system, 1 << 20, 1000, true), 10, 1e-3);
  EXPECT_NEAR(predict_speedup(step, system, 1 << 20, 1000, false), 10, 1e-3);
}

TEST(ScaleModel, AChainTakesItsHopsAndThenTheOtherMessages) {
  // 5 messages of 1 MB: 2 us + 0.2 ms each. 3 hops there, 2 levels back, 4 messages behind the first each time.
  const double each = 2e-6 + 1e6 / 5e9;
  EXPECT_NEAR(sum_seconds(chain(), 4, 5e6), (3 + 4) * each + (2 + 4) * each, 1e-12);
  // On two hosts one hop is a far one, and the others follow at its pace.
  const double far = 10e-6 + 1e6 / 1e9;
  EXPECT_NEAR(sum_seconds(chain(), 8, 5e6), (6 * each + far + 4 * far) + (2 * each + far + 4 * far), 1e-12);
}

TEST(ScaleModel, ARingMovesTwiceTheShareOfAllOthers) {
  const double bytes = 100e6;  // latency does not count
  for (const int devices : {2, 4, 8})
    EXPECT_NEAR(sum_seconds(all_reduce(), devices, bytes), 2.0 * (devices - 1) * (4e-6 + bytes / devices / 300e9),
                1e-12);
  // Few bytes on many hosts go by a tree, whose latency grows with the logarithm.
  const double small = sum_seconds(all_reduce(), 1024, 8);
  EXPECT_LT(small, 2 * 7 * 10e-6 + 2 * 7 * 4e-6 + 1e-6);
  EXPECT_GT(small, 2 * 7 * 10e-6);
}

TEST(ScaleModel, GatheredRowsComeFromAllOthers) {
  EXPECT_NEAR(gather_seconds(chain(), 4, 4e6), 3 * (2e-6 + 1e6 / 5e9), 1e-12);
  EXPECT_EQ(gather_seconds(chain(), 1, 4e6), 0);
}

TEST(ScaleModel, MoreBytesSlowerLinksAndMoreDevicesNeverExchangeFaster) {
  for (const ScaleSystem& system : {chain(), all_reduce()}) {
    ScaleSystem slower = system;
    slower.inside.bytes_per_s /= 2;
    slower.between.latency_s *= 3;
    double before = 0;
    for (int devices = 2; devices <= 1024; devices *= 2) {
      const double now = sum_seconds(system, devices, 5e6);
      EXPECT_GE(now, before) << devices;
      EXPECT_GE(sum_seconds(system, devices, 6e6), now) << devices;
      EXPECT_GT(sum_seconds(slower, devices, 5e6), now) << devices;
      before = now;
    }
  }
}

TEST(ScaleModel, NoSpeedUpAboveTheNumberOfDevices) {
  for (const ScaleSystem& system : {chain(), all_reduce()}) {
    for (int devices = 1; devices <= 1024; ++devices) {
      for (const bool strong : {true, false})
        EXPECT_LE(predict_speedup(paper(), system, devices, 1024, strong), devices * (1 + 1e-12));
    }
  }
}

TEST(ScaleModel, LanesAreDealtOutWhole) {
  ScaleStep step{.split_s_per_ray = 1e-3, .lanes = 48};
  EXPECT_DOUBLE_EQ(largest_share(step, 16), 3.0 / 48);
  EXPECT_DOUBLE_EQ(largest_share(step, 32), 2.0 / 48);
  EXPECT_DOUBLE_EQ(largest_share(step, 48), 1.0 / 48);
  EXPECT_DOUBLE_EQ(largest_share(step, 1024), 1.0 / 48);
  const ScaleSystem system = free_of_charge(ScaleExchange::chain);
  EXPECT_NEAR(predict_speedup(step, system, 1024, 1000, true), 48, 1e-9);
  EXPECT_EQ(scale_limits(step, system, 1000, true, 1024).fastest, 48);
  EXPECT_EQ(scale_limits(step, system, 1000, true, 1024).half_efficient, 96);
}

TEST(ScaleModel, OverlapHidesNoMoreThanThereIsToDo) {
  ScaleStep step = paper();
  const ScaleSystem system = chain();
  const ScaleTime open = predict_step(step, system, 4, 1000);
  EXPECT_DOUBLE_EQ(open.exposed_s, open.exchange_s);
  step.overlapped_share = 0.5;
  step.hiding_share = 0.5;
  const ScaleTime hidden = predict_step(step, system, 4, 1000);  // 0.9 s of work over some ms
  EXPECT_NEAR(hidden.exposed_s, sum_seconds(system, 4, 2.5e6), 1e-12);
  step.split_s_per_ray = 1e-9;
  const ScaleTime nothing_to_do = predict_step(step, system, 4, 1000);
  EXPECT_NEAR(nothing_to_do.exposed_s, nothing_to_do.exchange_s, 1e-6);
  EXPECT_LT(nothing_to_do.exposed_s, nothing_to_do.exchange_s);
}

TEST(ScaleModel, LimitsAreThoseOfEveryNumberOfDevices) {
  const ScaleLimits limits = scale_limits(paper(), chain(), 1024, true, 200);
  for (int devices = 1; devices <= 200; ++devices) {
    const double speedup = predict_speedup(paper(), chain(), devices, 1024, true);
    const double best = predict_speedup(paper(), chain(), limits.fastest, 1024, true);
    EXPECT_LE(0.99 * speedup, best) << devices;
    if (devices < limits.fastest) {
      EXPECT_LT(speedup, best) << devices;
    }
    if (devices > limits.half_efficient) {
      EXPECT_LT(speedup, 0.5 * devices) << devices;
    }
  }
  EXPECT_GE(predict_speedup(paper(), chain(), limits.half_efficient, 1024, true), 0.5 * limits.half_efficient);
}

TEST(ScaleModel, AFitFindsTheCostThatMadeTheSamples) {
  std::vector<ScaleSample> samples;
  for (const double rays : {16.0, 256.0, 1024.0}) samples.push_back({rays, 0.02 + 5e-3 * rays});
  const ScaleStep step = fit_step(samples);
  EXPECT_NEAR(step.fixed_s, 0.02, 1e-9);
  EXPECT_NEAR(step.split_s_per_ray, 5e-3, 1e-12);
}

TEST(ScaleModel, AFitIsNeverNegative) {
  const std::array<ScaleSample, 2> more_than_linear{{{100, 0.5}, {200, 2}}};
  const ScaleStep none_fixed = fit_step(more_than_linear);
  EXPECT_EQ(none_fixed.fixed_s, 0);
  EXPECT_GT(none_fixed.split_s_per_ray, 0.5 / 100);
  EXPECT_LT(none_fixed.split_s_per_ray, 2.0 / 200);
  const std::array<ScaleSample, 2> falling{{{100, 2}, {200, 1}}};
  const ScaleStep all_fixed = fit_step(falling);
  EXPECT_EQ(all_fixed.split_s_per_ray, 0);
  EXPECT_GT(all_fixed.fixed_s, 1);
  EXPECT_LT(all_fixed.fixed_s, 2);
  const std::array<ScaleSample, 1> one{{{100, 2}}};
  EXPECT_DOUBLE_EQ(fit_step(one).split_s_per_ray, 0.02);
  EXPECT_EQ(fit_step(one).fixed_s, 0);
  EXPECT_THROW(fit_step({}), Error);
}

TEST(ScaleModel, WhatIsRepeatedIsFoundFromTwoRanks) {
  ScaleStep truth{.fixed_s = 1e-3,
                  .split_s_per_ray = 2e-5,
                  .repeated_s_per_ray = 1e-5,
                  .gradient_bytes = 1e5,
                  .gathered_bytes_per_ray = 4560};
  const ScaleSample two{1024, predict_step(truth, chain(), 2, 1024).step_s()};
  ScaleStep known = truth;  // what one rank reports: not who repeats what
  known.split_s_per_ray = 3e-5;
  known.repeated_s_per_ray = 0;
  const ScaleStep found = with_repeated(known, chain(), 2, two);
  EXPECT_NEAR(found.repeated_s_per_ray, 1e-5, 1e-10);
  EXPECT_NEAR(found.split_s_per_ray, 2e-5, 1e-10);
  EXPECT_EQ(with_repeated(known, chain(), 2, {1024, 1e-6}).repeated_s_per_ray, 0);     // faster than can be
  EXPECT_DOUBLE_EQ(with_repeated(known, chain(), 2, {1024, 1e6}).split_s_per_ray, 0);  // slower than can be
}

TEST(ScaleModel, NoDevicesAndNoRaysAreRefused) {
  EXPECT_THROW(predict_step(paper(), chain(), 0, 10), Error);
  EXPECT_THROW(predict_step(paper(), chain(), 2, 0), Error);
  EXPECT_THROW(predict_step(paper(), chain(), 2, NAN), Error);
}

// What `semfield-study scale` makes of measurements: goals, files, tables, and that the page shows its data.

ScaleRow row(const std::string& machine, const std::string& device, const std::string& step, int ranks,
             std::int64_t rays, double seconds) {
  return {
      machine, step, device, ranks, rays, {seconds, 0.9 * seconds, 1.1 * seconds}, 4, 5e6, step == "hash" ? 1e6 : 0};
}

ScaleResults two_cores() {
  return ScaleResults{
      .machines = {{"two cores", "cpu", 2, "build"}},
      .rows = {row("two cores", "cpu", "paper", 1, 1024, 10), row("two cores", "cpu", "paper", 2, 1024, 5.25),
               row("two cores", "cpu", "paper", 1, 256, 2.5), row("two cores", "cpu", "paper", 2, 512, 2.6)}};
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
  ScaleResults r{.machines = {{"gpus", "cuda", 2, "build"}},
                 .rows = {row("gpus", "cuda", "paper", 1, 1024, 2.2e-3), row("gpus", "cuda", "paper", 2, 2048, 2.2e-3),
                          row("gpus", "cuda", "paper", 1, 4096, 8e-3), row("gpus", "cuda", "paper", 2, 4096, 5e-3),
                          row("gpus", "cuda", "hash", 1, 8192, 1e-3), row("gpus", "cuda", "hash", 2, 16384, 1.25e-3)}};
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
  ScaleResults r{.bits = {{"m", "quickstart", 1, 1, ""}}};
  EXPECT_EQ(goal(r, "bits_equal"), "-");
  r.bits.push_back({"m", "quickstart", 2, 1, ""});
  EXPECT_EQ(goal(r, "bits_equal"), "yes");
  r.bits.push_back({"m", "quickstart", 3, 1, "tensor 'x' differs from element 4 on"});
  r.bits.push_back({"m", "quickstart", 3, 2, ""});
  EXPECT_EQ(goal(r, "bits_equal"), "no");
  EXPECT_HAS(scale_measured(r), "3 x 1: tensor 'x' differs from element 4 on");
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
  for (const std::string text : {"{", "{}", "[]", R"({"quick": false, "machines": 3})"})
    EXPECT_HAS(error_of(ErrorKind::data, [&] { parse_scale_json(text, "some/results.json"); }), "some/results.json")
        << text;
  ScaleResults r = two_cores();
  r.rows[0].seconds.min = 0;
  EXPECT_THROW(parse_scale_json(scale_json(r), "x"), Error);
}

TEST(ScaleResults, FreshFiguresReplaceTheirOwn) {
  ScaleResults fresh{.machines = {{"two cores", "cpu", 2, "another build"}},
                     .rows = {row("two cores", "cpu", "paper", 2, 1024, 5)}};
  const ScaleResults all = merged(two_cores(), fresh);
  EXPECT_EQ(all.rows.size(), two_cores().rows.size());
  EXPECT_EQ(all.machines.size(), 1U);
  EXPECT_EQ(all.machines[0].about, "another build");
  EXPECT_EQ(goal(all, "cpu2_strong"), "2.00");
  ScaleResults without_times{.machines = {{"two cores", "cpu", 2, "a third build"}},
                             .bits = {{"two cores", "quickstart", 2, 1, ""}}};
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
  EXPECT_LACKS(page, "old", "`cpu2_strong` on a machine");  // measured
  EXPECT_HAS(page, "| 2 | 5250 (4725 .. 5775) | 1.90 |", "`gpu2_weak_paper` on a machine with two GPUs");
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
