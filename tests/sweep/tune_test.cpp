// Tuning: spaces as written, the race against scores that are known, what the tuned file says.

#include "eval/report/tune.h"

#include <algorithm>
#include <functional>
#include <set>

#include "config/config_words.h"
#include "plugin/loader.h"
#include "tests/scene/tiny_scene.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

// Four axes of two values and a part; PSNR is known for every choice and seed.
class Tuning : public testing::Test, public TuneWork {
 protected:
  static TuneAxis axis(const std::string& name, int values, bool is_part = false) {
    TuneAxis out{name, {}, is_part};
    for (int v = 0; v < values; ++v)
      out.values.push_back({name + " " + std::to_string(v), {{"train." + name, ConfigNode()}}});
    return out;
  }

  TuneRound agreed(const TuneRound& wanted) override {
    const std::size_t place = asked_++;
    if (place == record_.size()) record_.push_back(wanted);
    return record_[place];
  }
  std::optional<TuneScores> run(const TuneRound& round) override {
    if (rounds_left_-- == 0) return std::nullopt;
    spent_s_ += round.name == "together" ? stall_s_ : 0;
    TuneScores scores;
    for (const TuneChoice& choice : round.candidates) {
      scores.emplace_back();
      for (int seed = 0; seed < round.seeds; ++seed) {
        const bool is_new = trained_.insert({{choice, round.length}, seed}).second;
        cells_ += is_new ? 1 : 0;
        spent_s_ += is_new ? round.length + cell_s() : 0;
        const double late = round.length > late_from_ * plan_.length ? late_(choice) : 0;
        scores.back().push_back({{"psnr", 20 + round.length / 100 + psnr_(choice) + late + 0.01 * seed},
                                 {"miou_present", 0.5 + miou_(choice)},
                                 {"train_s", round.length},
                                 {"steps", 1000}});
        std::erase_if(scores.back().back(), [&](const auto& value) { return without_.contains(value.first); });
      }
    }
    return scores;
  }
  double spent_s() const override { return spent_s_ / plan_.at_a_time; }
  double cell_s() const override { return 0.5; }

  TuneOutcome race_of(double time_s) {
    asked_ = 0;
    plan_.time_s = time_s;
    return race(plan_, *this);
  }

  TuneOutcome race_anew(double time_s) {
    record_.clear();
    trained_.clear();
    spent_s_ = 0;
    return race_of(time_s);
  }

  TunePlan plan_{{}, {}, {axis("a", 2), axis("b", 2), axis("c", 2), axis("d", 2), axis("part", 1, true)}};
  std::function<double(const TuneChoice&)> psnr_ = [](const TuneChoice& c) {
    return (c[0] == 1 ? 0.5 : 0) +
           (c[1] == 0   ? 1
            : c[1] == 1 ? -2
                        : 0) +
           (c[3] >= 0 ? 0.01 : 0) - (c[0] == 1 && c[2] == 0 ? 5 : 0) + (c[2] == 0 ? 0.3 : 0) - (c[4] == 0 ? 0.01 : 0);
  };
  std::function<double(const TuneChoice&)> late_ = [](const TuneChoice&) { return 0; };  // in long trainings
  std::function<double(const TuneChoice&)> miou_ = [](const TuneChoice&) { return 0; };
  double late_from_ = 0.5;
  std::set<std::string> without_;  // metrics that the scene has no data for
  std::vector<TuneRound> record_;
  std::set<std::pair<std::pair<TuneChoice, double>, int>> trained_;
  std::size_t asked_ = 0;
  int cells_ = 0, rounds_left_ = -1;
  double spent_s_ = 0, stall_s_ = 0;  // stall: the machine is busy with other things
};

TEST_F(Tuning, TheBetterValuesAreCombinedAndPartsOfNoWorthAreLeftOut) {
  const TuneOutcome outcome = race_of(2000);
  ASSERT_TRUE(outcome.whole);
  EXPECT_EQ(outcome.best, (TuneChoice{1, 0, -1, -1, 0}))
      << "a 1 and b 0 gain; c 0 gains alone and not with a 1; d gains less than noise; the part costs less";
  EXPECT_NEAR(outcome.gain.mean, 1.5, 0.02);
  EXPECT_EQ(outcome.gain.sure, 2);
  EXPECT_EQ(gain_text(tune_aim("psnr"), outcome.gain), "+1.50 dB, sure: 2 of 2 seeds");
  ASSERT_EQ(outcome.parts.size(), 3u);
  EXPECT_NEAR(outcome.parts[0].gain.mean, 0.5, 0.01) << "of a";
  EXPECT_TRUE(outcome.parts[1].kept);
  EXPECT_FALSE(outcome.parts[2].kept);
}

TEST_F(Tuning, ValuesThatGainOnlyTogetherWithOthersAreFound) {
  // c 1 gains beside b 0 alone, and a 0 is better than a 1 there.
  psnr_ = [](const TuneChoice& c) {
    const bool wide = c[1] == 0;
    return (wide ? 0.5 : 0) +
           (c[0] == 1   ? (wide ? 0.2 : 0.3)
            : c[0] == 0 ? (wide ? 0.8 : 0.1)
                        : 0) +
           (c[2] == 1 ? (wide ? 0.6 : 0.05) : 0) + (c[3] == 0 ? 0.2 : 0);
  };
  const TuneOutcome outcome = race_of(4000);
  EXPECT_EQ(outcome.best, (TuneChoice{0, 0, 1, 0, -1}));
  EXPECT_NEAR(outcome.gain.mean, 2.1, 0.02);
}

TEST_F(Tuning, WhatGainsInShortTrainingsAloneIsNotTaken) {
  late_ = [](const TuneChoice& c) { return c[1] == 0 ? -1.5 : 0.; };
  for (const double time_s : {120., 2000.}) {
    const TuneOutcome outcome = race_anew(time_s);
    EXPECT_EQ(outcome.best[1], -1) << time_s;
    EXPECT_TRUE(std::any_of(record_.begin(), record_.end(), [&](const TuneRound& r) {
      return r.name == "full length" && r.length == plan_.length && r.candidates.size() > 1;
    })) << time_s;
  }
}

TEST_F(Tuning, WhatGainsInLongTrainingsAloneIsFound) {
  late_from_ = 0.4;
  psnr_ = [](const TuneChoice& c) { return c[1] == 0 ? -4 : 0; };
  late_ = [](const TuneChoice& c) { return c[1] == 0 ? 4.4 : 0; };
  for (const double time_s : {120., 2000.}) EXPECT_EQ(race_anew(time_s).best[1], 0) << time_s;
}

TEST_F(Tuning, WithoutTimeForLongTrainingsTheConfigurationStays) {
  plan_.length = 60;
  for (const double time_s : {60., 90., 120.}) {
    const TuneOutcome outcome = race_anew(time_s);
    const bool is_measured = std::any_of(record_.begin(), record_.end(), [&](const TuneRound& r) {
      return r.name == "full length" && r.length >= plan_.length / 2 && r.candidates.size() > 1;
    });
    EXPECT_EQ(is_measured, time_s == 120);
    EXPECT_EQ(outcome.best == TuneChoice(5, -1), !is_measured) << time_s;
    EXPECT_FALSE(outcome.notes.empty()) << time_s;
    EXPECT_LE(spent_s_, time_s) << time_s;
  }
}

TEST_F(Tuning, AWinnerThatHadNoTimeForHalfTheLengthIsNotTaken) {
  int brief = 0;
  plan_.length = 30;
  for (stall_s_ = 0; stall_s_ < 60; stall_s_ += 3) {
    const TuneOutcome outcome = race_anew(120);
    for (const TuneRound& round : record_) {
      if (round.name != "full length" || round.candidates.size() < 2) continue;
      brief += round.length < plan_.length / 2 ? 1 : 0;
      EXPECT_EQ(outcome.best[1], round.length < plan_.length / 2 ? -1 : 0) << stall_s_;
    }
  }
  EXPECT_GT(brief, 0);
}

TEST_F(Tuning, SeveralDevicesTrainLonger) {
  const auto trained_s = [&](int devices) {
    plan_.at_a_time = devices;
    const TuneOutcome outcome = race_anew(120);
    EXPECT_LE(spent_s_ / devices, 120 + plan_.length) << "cells of a round end together, at most one turn apart";
    EXPECT_EQ(record_[0].seeds, devices) << "each has loaded the scene before it is timed";
    double sum = 0;
    for (const TuneRound& round : record_)
      sum += round.length * round.seeds * static_cast<double>(round.candidates.size());
    return sum;
  };
  EXPECT_GT(trained_s(2), 1.3 * trained_s(1));
}

TEST_F(Tuning, WhatTheSceneHasNoDataForOrHasAlreadyIsNoCandidate) {
  plan_.config = parse_config_text("train: {b: 1}", "base.yaml");
  plan_.axes[1].values[0].set[0].value = ConfigNode::make_scalar("1", false, {});
  plan_.axes[0].values = {{"labels", {{"semantics.weight", ConfigNode()}}}};
  plan_.axes[4].values = {{"without depth", {{"losses.depth", ConfigNode()}}}};
  without_ = {"miou_present"};
  (void)race_of(2000);
  for (const TuneRound& round : record_)
    for (const TuneChoice& choice : round.candidates) {
      EXPECT_EQ(choice[0] + choice[4], -2) << round.name;
      EXPECT_NE(choice[1], 0) << round.name;
    }
}

TEST_F(Tuning, EndsInTimeAndTriesTheFirstAxesWhereItIsShort) {
  for (const double time_s : {60., 120., 400.}) {
    const TuneOutcome outcome = race_anew(time_s);
    EXPECT_LE(spent_s_, time_s) << time_s;
    EXPECT_EQ(outcome.best[1], 0) << time_s;
  }
  EXPECT_FALSE(race_anew(20).notes.empty());
}

TEST_F(Tuning, AGainThatCostsLabelsIsNone) {
  miou_ = [](const TuneChoice& c) { return c[1] == 0 ? -0.2 : 0.; };
  EXPECT_EQ(race_of(2000).best[1], -1);
  plan_.aim = "miou";
  record_.clear();
  miou_ = [](const TuneChoice& c) { return c[2] == 1 ? 0.2 : 0.; };
  EXPECT_EQ(race_of(2000).best, (TuneChoice{-1, -1, 1, -1, 0}));
}

TEST_F(Tuning, WithoutAGainTheConfigurationStays) {
  psnr_ = [](const TuneChoice& c) { return c[4] == 0 ? -1 : 0.; };
  const TuneOutcome outcome = race_of(2000);
  EXPECT_EQ(outcome.best, TuneChoice(5, -1));
  EXPECT_EQ(outcome.gain.seeds, 0);
  EXPECT_TRUE(outcome.parts.at(0).kept);
}

TEST_F(Tuning, AStoppedRaceContinuesFromItsRecord) {
  const TuneOutcome whole = race_of(2000);
  const std::vector<TuneRound> rounds = record_;
  const int cells = cells_;
  for (int stop = 0; stop < 4; ++stop) {
    record_.clear();
    trained_.clear();
    spent_s_ = cells_ = 0;
    rounds_left_ = stop;
    EXPECT_FALSE(race_of(2000).whole);
    rounds_left_ = -1;
    spent_s_ += 300;  // the clock decides nothing that the record knows
    const std::size_t known = record_.size();
    const TuneOutcome again = race_of(2000);
    EXPECT_EQ(again.best, whole.best);
    for (std::size_t r = 0; r < known; ++r) EXPECT_EQ(record_[r].candidates, rounds[r].candidates) << r;
    EXPECT_LE(cells_, cells) << "no cell is trained twice";
  }
}

struct TuneFiles : testing::Test {
  void SetUp() override {
    register_linked_plugins(registry_);
    write("base.yaml",
          "scene: {type: replica, root: walk}\n"
          "losses: [{type: depth, weight: 0.02}]\n"
          "train: {cameras: {poses: auto}}\n"
          "passes:\n"
          "  - sampler: {type: stratified, samples: 8}\n"
          "    position: {type: frequency, frequencies: 3}\n"
          "    field: {type: nerf_mlp, depth: 2, width: 8, skip_at: 0}\n");
  }
  std::string write(const std::string& name, const std::string& text) { return dir_.write(name, text); }
  std::vector<TuneAxis> space(const std::string& text) { return read_tune_space(write("space.yaml", text)); }
  TunePlan plan_of(std::vector<TuneAxis> axes) {
    const std::string path = dir_.path() + "/base.yaml";
    return {compose_config(path), path, std::move(axes)};
  }
  std::string error_of(const std::string& text) {
    try {
      const TunePlan plan = plan_of(space(text));
      (void)tune_cell(plan, TuneChoice(plan.axes.size(), 0), 15, 0, registry_);
    } catch (const Error& e) {
      return e.what();
    }
    return "no error";
  }

  const TempDir dir_;
  Registry registry_;
};

TEST_F(TuneFiles, AxesAreKeyPathsOrNamedVariants) {
  const std::vector<TuneAxis> axes = space(
      "axes:\n  passes.main.position.frequencies: [4, 5]\n"
      "  light: {dark: {rendering.background: [0, 0, 0], train.rays: 64}}\n");
  ASSERT_EQ(axes.size(), 2u);
  EXPECT_EQ(choice_name(axes, {1, 0}), "position.frequencies 5, dark");
  EXPECT_EQ(choice_name(axes, {-1, -1}), "as configured");
  EXPECT_EQ(axes[1].values[0].set.size(), 2u);
}

TEST_F(TuneFiles, MistakesAreNamedWithTheirPlace) {
  EXPECT_HAS(error_of("axis: {train.rays: [1]}\n"), "space.yaml:1:1: unknown key 'axis'");
  EXPECT_HAS(error_of("axes:\n  train.rays: 3\n"), "space.yaml:2:15: axes.train.rays: expected a list of values");
  EXPECT_HAS(error_of("axes:\n  light: {dark: 3}\n"), "space.yaml:2:17: axes.light.dark: expected a map of key paths");
  EXPECT_HAS(error_of("axes:\n  train.rayz: [64]\n"), "space.yaml:2:", "rayz", "rays");
  EXPECT_HAS(error_of("axes:\n  train.rays: [-3]\n"), "space.yaml:2:");
  EXPECT_HAS(error_of("axes:\n  losses.distorsion.weight: [0.1]\n"), "distorsion", "distortion");
}

TEST_F(TuneFiles, TheTunedFileLoadsAndIsTheWinner) {
  TunePlan plan =
      plan_of(space("axes:\n  passes.main.position.frequencies: [4, 5]\n  losses.distortion.weight: [0.01]\n"
                    "  light: {dark: {rendering.background: [0, 0, 0], train.rays: 64}}\n"));
  for (TuneAxis& part : optional_parts(plan.config)) plan.axes.push_back(std::move(part));
  ASSERT_EQ(plan.axes.size(), 5u) << "the loss and the corrections of poses can be taken out";
  TuneOutcome outcome;
  outcome.best = {1, 0, 0, 0, 0};
  outcome.gain = {0.42, 2, 2};
  outcome.parts = {{0, {0.4, 2, 2}}, {1, {0.1, 1, 2}}, {3, {0.01, 1, 2}, "", 0.08, false}};
  const std::string text = tuned_config(plan, outcome, "base.yaml", "semfield tune base.yaml --time 2m");
  EXPECT_HAS(text, std::string(kTunedBy) + "semfield tune base.yaml --time 2m`: +0.42 dB, sure: 2 of 2 seeds, noise ",
             "include: base.yaml", "passes.main.position.frequencies: 5  # +0.40 dB, sure: 2 of 2 seeds",
             "losses: [{type: distortion, weight: 0.01}]  # distortion.weight 0.01: +0.10 dB, sure: 1 of 2 seeds; "
             "without the loss depth: it gains +0.01 dB, sure: 1 of 2 seeds, takes 8 % of a step");
  const TunePlan tuned{compose_config(write("base.tuned.yaml", text)), plan.path, {}};
  const std::string winner = tune_cell(plan, outcome.best, 15, 0, registry_).config;
  EXPECT_EQ(tune_cell(tuned, {}, 15, 0, registry_).config, winner);
  EXPECT_HAS(winner, "frequencies: 5", "type: distortion", "rays: 64", "poses: given", "hold_out: 8", "time_s: 15");
  EXPECT_NE(tune_cell(plan, TuneChoice(5, -1), 15, 0, registry_).config, winner);
}

TEST_F(TuneFiles, ManyPixelsAreScoredAtALargerStride) {
  TunePlan plan = plan_of({});
  EXPECT_EQ(score_stride_for(plan, {{"pixels", 3e5}}), 3);
  plan.score_stride = score_stride_for(plan, {{"pixels", 1.5e6}});
  EXPECT_EQ(plan.score_stride, 6);
  EXPECT_HAS(tune_cell(plan, {}, 15, 0, registry_).config, "eval_stride: 6");
}

TEST_F(TuneFiles, ShippedSpacesAreSmallEnough) {
  for (const char* preset : {"room", "object", "unbounded"}) {
    const std::string root = SEMFIELD_SOURCE_DIR "/configs/", file = std::string(preset) + ".yaml";
    const TunePlan plan{compose_config(root + "presets/" + file, {"scene.type=replica", "scene.root=walk"}), "x.yaml",
                        read_tune_space(root + "tune/" + file)};
    EXPECT_LE(plan.axes.size(), 12u) << preset;
    for (const TuneAxis& axis : plan.axes) EXPECT_LE(axis.values.size(), 4u) << axis.name;
    for (std::size_t a = 0; a < plan.axes.size(); ++a)
      for (int v = 0; v < std::ssize(plan.axes[a].values); ++v) {
        TuneChoice choice(plan.axes.size(), -1);
        choice[a] = v;
        EXPECT_NO_THROW(tune_cell(plan, choice, 15, 0, registry_)) << choice_name(plan.axes, choice);
      }
  }
}

}  // namespace
}  // namespace semfield
