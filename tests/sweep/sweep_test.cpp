// Sweep files: what becomes of grids, variants, scenes and lists of files, each error with its place; result tables.

#include "eval/report/sweep.h"

#include <algorithm>
#include <cstdlib>
#include <nlohmann/json.hpp>
#include <set>
#include <sstream>
#include <thread>

#include "app/sweep/sweep_work.h"
#include "plugin/loader.h"
#include "tests/scene/tiny_scene.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

struct SweepFile : testing::Test {
  void SetUp() override {
    write("base.yaml",
          "scene: {type: replica, root: walk}\n"
          "passes:\n"
          "  - sampler: {type: stratified, samples: 8}\n"
          "    position: {type: frequency, frequencies: 3}\n"
          "    field: {type: nerf_mlp, depth: 2, width: 8, skip_at: 0}\n");
    register_linked_plugins(registry_);
  }
  std::string write(const std::string& name, const std::string& text) { return dir_.write(name, text); }
  std::vector<Cell> cells(const std::string& text) {
    return plan_cells(read_sweep(write("sweep.yaml", text)), registry_);
  }
  std::string error_of(const std::string& text) {
    try {
      (void)cells(text);
    } catch (const Error& e) {
      std::string what = e.what();
      for (std::size_t at; (at = what.find(folder_ + "/")) != std::string::npos;) what.erase(at, folder_.size() + 1);
      return what;
    }
    return "no error";
  }

  const TempDir dir_;
  const std::string& folder_ = dir_.path();
  Registry registry_;
};

TEST_F(SweepFile, AGridIsEveryCombinationTheLastKeyFastest) {
  const Sweep sweep = read_sweep(write("sweep.yaml",
                                       "base: base.yaml\nscenes: {a: }\n"
                                       "grid: {train.rays: [64, 128], semantics.weight: [0.04, 1]}\n"));
  ASSERT_EQ(sweep.experiments.size(), 1u);
  const Experiment& e = sweep.experiments[0];
  EXPECT_EQ(e.name, "sweep");
  ASSERT_EQ(e.variants.size(), 4u);
  EXPECT_EQ(e.variants[0].name, "rays 64, weight 0.04");
  EXPECT_EQ(e.variants[1].name, "rays 64, weight 1");
  EXPECT_EQ(e.variants[2].name, "rays 128, weight 0.04");
  EXPECT_FALSE(e.variants[0].x) << "two keys have no one abscissa";
  const std::vector<Cell> all = plan_cells(sweep, registry_);
  ASSERT_EQ(all.size(), 4u);
  EXPECT_HAS(all[3].config, "rays: 128", "weight: 1.0");
}

TEST_F(SweepFile, SeedsGoToTrainingAndLabelsAndEqualRunsAreOneCell) {
  const std::vector<Cell> all = cells(
      "base: base.yaml\nseeds: [3, 4]\nscenes: {a: , b: {set: {scene.root: other}}}\n"
      "variants: {plain: , same: {set: {train.steps: 20000}}, longer: {set: {train.steps: 30000}}}\n");
  ASSERT_EQ(all.size(), 8u) << "2 scenes x 2 seeds x 2 configurations; 20000 is the default";
  EXPECT_EQ(all[0].uses.size(), 2u);
  EXPECT_EQ(all[0].seed, 3);
  EXPECT_HAS(all[0].config, "seed: 3\n    names:", "seed: 3\n  lanes:") << "labels and training share the seed";
  EXPECT_HAS(all[0].config, folder_ + "/walk") << "a path starts at the file that wrote it";
}

TEST_F(SweepFile, AnotherSplitIsAnotherCellAndScoresTrainingFrames) {
  const std::string rest = "base: base.yaml\nscenes: {a: }\nvariants: {plain: }\n";
  const std::vector<Cell> test = cells(rest), train = cells("split: train\n" + rest);
  EXPECT_NE(test[0].id, train[0].id);
  EXPECT_HAS(test[0].config, "training_frames: 0");
  EXPECT_HAS(train[0].config, "training_frames: 1000000");
}

TEST_F(SweepFile, MetricsOfTrainingFramesScoreThemBesideHeldOutOnes) {
  const std::string rest = "base: base.yaml\nscenes: {a: }\nvariants: {plain: }\nset: {report.training_frames: 7}\n";
  EXPECT_HAS(cells(rest)[0].config, "training_frames: 0");
  EXPECT_HAS(cells("metrics: [ece, miou_of_given_x]\n" + rest)[0].config, "training_frames: 0");
  for (const char* metric : {"given_wrong_auroc", "training_ece"})
    EXPECT_HAS(cells("metrics: [ece, " + std::string(metric) + "]\n" + rest)[0].config, "training_frames: 7") << metric;
}

TEST_F(SweepFile, FusionsComeAfterTheFieldTheyTakeDepthFrom) {
  const std::vector<Cell> all = cells(
      "base: base.yaml\nsplit: train\nscenes: {a: }\n"
      "variants: {bayes: {fuse: {method: bayesian, field: ours}}, truth: {fuse: {method: bayesian}}, ours: }\n");
  ASSERT_EQ(all.size(), 3u);
  EXPECT_EQ(all[0].label, "sweep / ours");
  EXPECT_EQ(all[1].field_cell, all[0].id);
  EXPECT_EQ(all[2].field_cell, "");
  EXPECT_NE(all[1].id, all[2].id);
}

TEST_F(SweepFile, ObjectsAreFoundInTheRunOfAVariant) {
  const std::vector<Cell> all = cells(
      "base: base.yaml\nseeds: [1, 2]\nscenes: {a: }\n"
      "variants: {near: {objects: ours, set: {objects.reach: 0.125}}, far: {objects: ours}, ours: }\n");
  ASSERT_EQ(all.size(), 6u);
  EXPECT_TRUE(all[0].trains());
  for (const std::size_t seed : {0, 1}) {
    const Cell &field = all[3 * seed], &near = all[3 * seed + 1], &far = all[3 * seed + 2];
    EXPECT_EQ(field.label, "sweep / ours");
    EXPECT_FALSE(near.trains());
    EXPECT_TRUE(near.objects);
    EXPECT_EQ(near.field_cell, field.id) << "one run for all rows";
    EXPECT_EQ(far.field_cell, field.id);
    EXPECT_NE(near.id, far.id);
    const ConfigNode config = parse_config_text(near.config, "cell");
    EXPECT_EQ(config.find("objects")->find("reach")->text(), "0.125");
    EXPECT_EQ(config.find("objects")->find("seed")->text(), std::to_string(seed + 1));
  }
  EXPECT_HAS(error_of("base: base.yaml\nscenes: {a: }\nvariants: {v: {objects: w}}\n"),
             "sweep.yaml:3:25: variants.v.objects:", "a field");
  EXPECT_HAS(error_of("base: base.yaml\nscenes: {a: }\nvariants: {v: {objects: w, fuse: {method: average}}, w: }\n"),
             "sweep.yaml:3:25: variants.v:", "fuse", "objects");
}

TEST_F(SweepFile, WhatASceneSetsAfterReachesIntoAVariantsStep) {
  const std::vector<Cell> all = cells(
      "base: base.yaml\nscenes: {a: {set: {train.rays: 64}, after: {scene.labels.degrade.0.classes: [chair]}}}\n"
      "set: {train.rays: 32}\n"
      "variants: {v: {set: {scene.labels.degrade: [{type: region_noise, ratio: 0.5}], train.steps: 7}}}\n");
  ASSERT_EQ(all.size(), 1u);
  EXPECT_HAS(all[0].config, "chair");
  EXPECT_HAS(all[0].config, "rays: 32") << "the experiment's come after the scene's";
  EXPECT_HAS(all[0].config, "steps: 7");
}

TEST_F(SweepFile, AListOfSweepsIsMergedUnderItsOwnKeys) {
  write("one.yaml", "base: missing.yaml\nseeds: [1, 2, 3]\nscenes: {a: }\nvariants: {plain: }\n");
  write("two.yaml", "scenes: {a: {set: {train.rays: 64}}, b: }\nuse_scenes: [a]\nvariants: {plain: }\n");
  const Sweep sweep =
      read_sweep(write("all.yaml", "name: everything\nbase: base.yaml\nseeds: [9]\nsweeps: [one.yaml, two.yaml]\n"));
  EXPECT_EQ(sweep.name, "everything");
  ASSERT_EQ(sweep.experiments.size(), 2u);
  EXPECT_EQ(sweep.experiments[0].name, "one");
  EXPECT_EQ(sweep.experiments[0].seeds, (std::vector<std::int64_t>{9}));
  EXPECT_EQ(sweep.experiments[1].scenes.size(), 1u);
}

TEST_F(SweepFile, AnErrorOfACellNamesTheCellAndIsSaidOnce) {
  const std::string what =
      error_of("base: base.yaml\nseeds: [1, 2]\nscenes: {a: }\nvariants: {v: {set: {train.rayz: 3}}}\n");
  EXPECT_HAS(what, "sweep.yaml:4:", "unknown key 'rayz'", "(sweep / a / v)");
  EXPECT_EQ(what.find("rayz", what.find("rayz") + 8), std::string::npos) << what;
}

// A base that names its scene needs no second word about it; scenes beside it change what they name.
TEST_F(SweepFile, ABaseWithASceneOfItsOwnIsEnough) {
  const std::vector<Cell> own = cells("base: base.yaml\nvariants: {v: }\n");
  ASSERT_EQ(own.size(), 1u);
  EXPECT_EQ(own[0].scene, "base");
  EXPECT_HAS(own[0].config, folder_ + "/walk");
  const std::vector<Cell> other =
      cells("base: base.yaml\nscenes: {a: , b: {set: {scene.root: other}}}\nvariants: {v: }\n");
  ASSERT_EQ(other.size(), 2u);
  EXPECT_HAS(other[0].config, folder_ + "/walk");
  EXPECT_HAS(other[1].config, folder_ + "/other", "type: replica");
  EXPECT_HAS(error_of("variants: {v: }\n"), "sweep.yaml:1:1: scenes:", "set}");
  EXPECT_HAS(error_of("name: a/b\nbase: base.yaml\nvariants: {v: }\n"), "sweep.yaml:1:7: name:", "a/b", "cannot hold");
}

// Every file that is shipped reads, and its cells' configurations too.
TEST_F(SweepFile, ShippedExperimentsArePlanned) {
  const fs::path experiments = fs::path(SEMFIELD_SOURCE_DIR) / "configs" / "experiments";
  const Sweep all = read_sweep((experiments / "all.yaml").string());
  int files = 0;
  for (const auto& entry : fs::directory_iterator(experiments)) files += entry.is_regular_file() ? 1 : 0;
  const Sweep gpu = read_sweep((experiments / "gpu.yaml").string());
  EXPECT_EQ(static_cast<int>(all.experiments.size() + gpu.experiments.size()), files - 6)
      << "all.yaml and gpu.yaml list every experiment, but for propagate.yaml, which needs the labels of first runs, "
         "objects.yaml, which is not of the method, and real_labels.yaml, which needs a real room";
  EXPECT_EQ(plan_cells(read_sweep((experiments / "objects.yaml").string()), registry_).size(), 63u);
  EXPECT_EQ(plan_cells(read_sweep((experiments / "propagate.yaml").string()), registry_).size(), 5u);
  EXPECT_EQ(plan_cells(read_sweep((experiments / "real_labels.yaml").string()), registry_).size(), 96u);
  EXPECT_EQ(plan_cells(gpu, registry_).size(), 216u);
  EXPECT_GT(plan_cells(all, registry_).size(), 100u);
  EXPECT_GT(plan_cells(read_sweep((experiments / "all_paper.yaml").string()), registry_).size(), 100u);
}

// Statistics, tables and result files of a sweep, by hand.

TEST(SweepTables, QuantilesOfStudentsT) {  // [Student08]; published to four decimals everywhere
  EXPECT_NEAR(student_t975(1), 12.7062047362, 1e-8);
  EXPECT_NEAR(student_t975(2), 4.3026527297, 1e-8);
  EXPECT_NEAR(student_t975(3), 3.1824463053, 1e-8);
  EXPECT_NEAR(student_t975(4), 2.7764451052, 1e-8);
  EXPECT_NEAR(student_t975(9), 2.2621571628, 1e-8);
  EXPECT_NEAR(student_t975(30), 2.0422724563, 1e-8);
}

TEST(SweepTables, MeanAndIntervalByHand) {
  const MeanInterval m = mean_interval({1, 2, 3});
  EXPECT_DOUBLE_EQ(m.mean, 2);
  EXPECT_NEAR(m.half_width, 4.3026527297 / std::sqrt(3.0), 1e-8);  // s = 1
  EXPECT_EQ(mean_interval({5}).half_width, 0);
  EXPECT_EQ(mean_interval({}).n, 0);
}

struct Example {
  Sweep sweep;
  std::vector<Cell> cells;
  SweepResults results;

  Example() {
    Experiment e{.name = "noise", .title = "Noise", .metrics = {"miou", "psnr"}, .paper = "mIoU"};
    e.scenes.resize(2);
    e.scenes[0].name = "a";
    e.scenes[1].name = "b";
    e.variants.resize(2);
    e.variants[0].name = "50 %, even";
    e.variants[0].x = 50;
    e.variants[0].paper = 0.951;
    e.variants[1].name = "p|q";
    e.variants[1].x = 90;
    e.seeds = {1, 2};
    sweep.experiments = {e};
    for (std::size_t s = 0; s < 2; ++s) {
      for (std::size_t v = 0; v < 2; ++v) {
        for (std::size_t k = 0; k < 2; ++k) {
          Cell cell;
          cell.id = std::to_string(s) + std::to_string(v) + std::to_string(k);
          cell.uses = {{0, s, v, k}};
          const double value =
              0.1 * static_cast<double>(s + 1) + 0.01 * static_cast<double>(v) + 0.002 * static_cast<double>(k);
          if (cell.id != "111") results[cell.id] = {{"miou", value}, {"psnr", 20 + value}};
          cells.push_back(cell);
        }
      }
    }
  }
};

TEST(SweepTables, MarkdownShowsMeansIntervalsAndThePaper) {
  const Example x;
  const ExperimentTable table(x.sweep, 0, x.cells, x.results);
  // Two seeds 0.002 apart: s = 0.002 / sqrt 2, half width = t(1) s / sqrt 2 = 12.706 * 0.001.
  const std::string text = table.markdown();
  EXPECT_HAS(text,
             "| miou | a | b | mean | paper (mIoU) |\n|---|---|---|---|---|\n"
             "| 50 %, even | 0.101 ± 0.013 | 0.201 ± 0.013 | 0.151 ± 0.009 | 0.951 |\n"
             "| p\\|q | 0.111 ± 0.013 | 0.210 | 0.161 | – |\n");  // a cell is missing: one seed of scene b, whose
                                                                  // interval is then unknown
  EXPECT_HAS(text, "| PSNR, dB | a | b | mean |\n");
}

TEST(SweepTables, CsvQuotesAndCountsOnlyFinishedCells) {
  const Example x;
  const std::string csv = results_csv(x.sweep, x.cells, x.results);
  EXPECT_EQ(csv.substr(0, csv.find('\n')), "experiment,scene,variant,seed,metric,value");
  EXPECT_HAS(csv, "noise,a,\"50 %, even\",1,miou,0.1\n");
  EXPECT_EQ(std::count(csv.begin(), csv.end(), '\n'), 1 + 7 * 2);
  const std::string table = ExperimentTable(x.sweep, 0, x.cells, x.results).csv();
  EXPECT_HAS(table, "p|q,b,miou,1,");
}

// A variant that holds out other frames, or reads them smaller, is no measure of the others.
TEST(SweepTables, WhatWasScoredOnOtherFramesOrPixelsIsNotCompared) {
  for (const char* what : {"frames", "pixels"}) {
    Example x;
    for (auto& [id, values] : x.results) values.emplace_back(what, 30);
    EXPECT_EQ(ExperimentTable(x.sweep, 0, x.cells, x.results).unequal(), "");
    x.results["010"].back().second = 15;
    const ExperimentTable table(x.sweep, 0, x.cells, x.results);
    EXPECT_EQ(table.unequal(),
              std::string("its variants were scored on other ") + what + " of the scene 'a': 30, and 15 by 'p|q'");
    EXPECT_HAS(table.markdown(), "\nNot compared: its variants were scored on other ");
    EXPECT_LACKS(table.markdown(), "| miou |");
    EXPECT_EQ(table.csv(), "variant,scene,metric,n,mean,half_width\n");
    EXPECT_HAS(table.json(), "\"tables\":[],\"plot\":null");
  }
}

TEST(SweepTables, ThePageHasTheFirstMetricOverItsAbscissa) {
  const Example x;
  const auto page = nlohmann::json::parse(ExperimentTable(x.sweep, 0, x.cells, x.results).json());
  EXPECT_EQ(page["plot"]["title"], "miou");
  EXPECT_EQ(page["tables"][0][0][0], "miou");
  Example bare;
  for (SweepVariant& v : bare.sweep.experiments[0].variants) v.x.reset();
  EXPECT_HAS(ExperimentTable(bare.sweep, 0, bare.cells, bare.results).json(), "\"plot\":null");
}

TEST(SweepResults, AreWrittenReadAndTakenFromRunsAndFusions) {
  const TempDir dir;
  const std::string& folder = dir.path();
  const CellValues values{{"miou", 0.25}, {"psnr", 21.5}};
  write_cell_result(folder + "/result.json", values);
  EXPECT_EQ(read_cell_result(folder + "/result.json"), values);
  EXPECT_FALSE(read_cell_result(folder + "/none.json"));
  write_file_atomic(folder + "/bad.json", std::string_view("{"));
  EXPECT_THROW((void)read_cell_result(folder + "/bad.json"), Error);

  write_file_atomic(
      folder + "/metrics.jsonl",
      std::string_view("{\"kind\":\"eval\",\"step\":5,\"train_s\":1,\"split\":\"train\",\"miou\":0.1}\n"
                       "{\"kind\":\"eval\",\"step\":9,\"train_s\":2.5,\"split\":\"test\",\"miou\":0.7}\n"
                       "{\"kind\":\"eval\",\"step\":9,\"train_s\":2.5,\"split\":\"train\",\"miou\":0.9}\n"));
  EXPECT_EQ(values_of_run(folder + "/metrics.jsonl", "train"),
            (CellValues{{"miou", 0.9}, {"train_s", 2.5}, {"steps", 9}}));
  EXPECT_THROW((void)values_of_run(folder + "/metrics.jsonl", "val"), Error);
  EXPECT_EQ(values_of_run(folder + "/metrics.jsonl", "test"),
            (CellValues{{"miou", 0.7}, {"training_miou", 0.9}, {"train_s", 2.5}, {"steps", 9}}));
  write_file_atomic(
      folder + "/sample.jsonl",
      std::string_view("{\"kind\":\"eval\",\"step\":9,\"train_s\":2.5,\"split\":\"test\",\"ece\":0.5}\n"
                       "{\"kind\":\"eval\",\"step\":9,\"train_s\":2.5,\"split\":\"train_sample\",\"ece\":0.25,"
                       "\"given_wrong_auroc\":0.75,\"given_none_auroc\":null}\n"));
  EXPECT_EQ(
      values_of_run(folder + "/sample.jsonl", "test"),
      (CellValues{{"ece", 0.5}, {"training_ece", 0.25}, {"given_wrong_auroc", 0.75}, {"train_s", 2.5}, {"steps", 9}}));

  const std::string fused =
      "{\"semfield\":\"0.1.0\",\"verb\":\"fuse\",\"scores\":[{\"method\":\"monocular\",\"miou\":0.5},{\"method\":"
      "\"bayesian\",\"miou\":0.6,\"depth\":\"true\"}]}";
  EXPECT_EQ(values_of_fusion(fused, "bayesian"), (CellValues{{"miou", 0.6}}));
  EXPECT_THROW((void)values_of_fusion(fused, "average"), Error);
  EXPECT_EQ(
      values_of_objects(R"({"objects": 7, "score": {"pq": 0.9, "mcov": 0.8}, "seconds": {"all": 3, "surface": 2}})"),
      (CellValues{{"pq", 0.9}, {"mcov", 0.8}, {"objects_s", 3}, {"surface_s", 2}}));
  EXPECT_THROW((void)values_of_objects(R"({"objects": 7, "seconds": {"all": 3}})"), Error);
}

// Which cell runs where and when. A shell script stands for the program, so cells take moments and devices need not be
// there.

using namespace app;

// Trains in a moment: `train CONFIG --out RUN ...`. It logs its beginning and end with device and cell, fails where the
// configuration says "broken", and otherwise leaves the figures of an evaluation.
constexpr const char* kProgram = R"sh(#!/bin/sh
here=$(dirname "$0")
if test "$1" = objects; then
  echo "$*" >"$here/objects"
  echo '{"score": {"pq": 0.5}, "seconds": {"all": 2}}'
  exit 0
fi
config=$2; run=$4; device=none
for word; do case $word in runtime.device=*) device=${word#*=};; esac; done
cell=$(basename "$(dirname "$config")")
echo "begin $device $cell rank=$OMPI_COMM_WORLD_RANK" >>"$here/log"
sleep 0.1
echo "end $device $cell" >>"$here/log"
if grep -q broken "$config"; then echo "it is broken" >&2; exit 65; fi
mkdir -p "$run"
echo '{"kind": "eval", "step": 5, "train_s": 0.5, "split": "test", "psnr": 20}' >"$run/metrics.jsonl"
)sh";

struct LogLine {
  std::string what, device, cell, rank;
};

struct CellPool : testing::Test {
  void SetUp() override {
    folder_ = testing_room::fresh_folder("pool");
    options_.folder = folder_ + "/out";
    options_.program = folder_ + "/program";
    write_file_atomic(options_.program, std::string_view(kProgram));
    fs::permissions(options_.program, fs::perms::owner_all);
  }

  static std::vector<Cell> cells(std::size_t count) {
    std::vector<Cell> made(count);
    for (std::size_t i = 0; i < count; ++i) {
      made[i].id = "cell" + std::to_string(i);
      made[i].config = "whole\n";
      made[i].split = "test";
    }
    return made;
  }

  bool run(const std::vector<Cell>& cells) {
    CellHooks hooks{.waits_for = waits_for_, .stop = [] { return 0; }};
    hooks.finished = [&](const CellOutcome& outcome) {
      outcomes_[outcome.cell->id] = outcome.failure.empty() ? "done" : outcome.failure;
    };
    return run_cells(cells, options_, ended_, hooks);
  }

  std::vector<LogLine> log() const {
    std::vector<LogLine> lines;
    if (!fs::exists(folder_ + "/log")) return lines;
    std::istringstream text(read_text_file(folder_ + "/log"));
    for (std::string line; std::getline(text, line);) {
      std::istringstream words(line);
      LogLine& read = lines.emplace_back();
      words >> read.what >> read.device >> read.cell >> read.rank;
    }
    return lines;
  }

  std::string folder_;
  CellOptions options_;
  EndedCells ended_;
  std::map<std::string, std::string> outcomes_;
  std::function<void(const std::string&)> waits_for_ = [](const std::string& text) {
    ADD_FAILURE() << "it waits: " << text;
  };
};

TEST_F(CellPool, WhoWorksBesideAnotherTakesItsOwnDeviceAndOtherCells) {
  const std::vector<Cell> six = cells(6);
  const auto work_on = [&](const std::string& device) {
    CellOptions own = options_;
    own.device = device;
    EndedCells ended;
    EXPECT_TRUE(run_cells(six, own, ended, {[](const auto&) {}, [](const auto&) {}, [] { return 0; }}));
    EXPECT_EQ(ended.results.size(), 6U);
  };
  std::thread other([&] { work_on("cuda:5"); });
  work_on("cuda:0");
  other.join();
  std::set<std::string> ran, devices;
  for (const LogLine& line : log()) {
    devices.insert(line.device);
    EXPECT_TRUE(ran.insert(line.what + line.cell).second) << line.cell << " ran twice";
  }
  EXPECT_EQ(ran.size(), 12U);
  EXPECT_EQ(devices, (std::set<std::string>{"cuda:0", "cuda:5"}));
}

// As many as the largest cell that has ended leaves room for.
TEST_F(CellPool, WhoHasNoRoomBesideTheOthersWaits) {
  options_.memory_gb = 3;
  options_.place = 1;
  create_folders(cell_folder(options_.folder, "cell0"));
  write_cell_result(cell_folder(options_.folder, "cell0") + "/result.json", {{"psnr", 7.0}, {"peak_mb", 2048}});
  waits_for_ = [](const std::string&) {};
  int looks = 0;
  const std::vector<Cell> two = cells(2);
  (void)notice_cell(ended_, options_.folder, "cell0");
  EXPECT_FALSE(
      run_cells(two, options_, ended_, {[](const auto&) {}, waits_for_, [&] { return ++looks > 3 ? 15 : 0; }}));
  EXPECT_EQ(ended_.results.size(), 1U);
  options_.memory_gb = 4;
  EXPECT_TRUE(run(two));
}

TEST_F(CellPool, WithoutADeviceCellsRunWhereTheyWant) {
  EXPECT_TRUE(run(cells(2)));
  for (const LogLine& line : log()) EXPECT_EQ(line.device, "none");
  EXPECT_EQ(log().size(), 4U);
}

TEST_F(CellPool, AFailedCellIsTriedOnceInASweep) {
  std::vector<Cell> three = cells(3);
  three[1].config = "broken\n";
  EXPECT_TRUE(run(three));
  EXPECT_EQ(outcomes_["cell0"], "done");
  EXPECT_HAS(outcomes_["cell1"], "exit code 65: it is broken");
  EXPECT_EQ(ended_.failures["cell1"], outcomes_["cell1"]);
  const std::size_t lines = log().size();
  // Another process of the sweep, which knows nothing yet.
  ended_ = {};
  outcomes_.clear();
  EXPECT_TRUE(run(three));
  EXPECT_TRUE(outcomes_.empty());
  EXPECT_EQ(ended_.results.size(), 2U);
  EXPECT_HAS(ended_.failures["cell1"], "it is broken");
  EXPECT_EQ(log().size(), lines) << "a cell ran again";
  // The next sweep.
  forget_cell_failure(options_.folder, "cell1");
  three[1].config = "whole\n";
  ended_ = {};
  EXPECT_TRUE(run(three));
  EXPECT_EQ(outcomes_["cell1"], "done");
  EXPECT_EQ(ended_.results.size(), 3U);
  EXPECT_TRUE(ended_.failures.empty());
}

// Its owner dies after the others are done: the cell is taken up here.
TEST_F(CellPool, ACellOfAnotherProcessIsWaitedForAndTakenUp) {
  const std::string folder = cell_folder(options_.folder, "cell0");
  create_folders(folder);
  FolderLock theirs;
  ASSERT_EQ(theirs.take(folder), 0);
  std::string waits;
  waits_for_ = [&](const std::string& text) {
    waits = text;
    EXPECT_EQ(outcomes_.size(), 2U) << "it waits while there are others to run";
    theirs = {};
  };
  EXPECT_TRUE(run(cells(3)));
  EXPECT_HAS(waits, "cells/cell0: process ");
  EXPECT_EQ(outcomes_.size(), 3U);
  EXPECT_EQ(log().back().cell, "cell0");
}

TEST_F(CellPool, AResultOfAnotherProcessIsNoticed) {
  const std::string folder = cell_folder(options_.folder, "cell0"), failed = cell_folder(options_.folder, "cell1");
  create_folders(folder);
  create_folders(failed);
  FolderLock theirs, others;
  ASSERT_EQ(theirs.take(folder), 0);
  ASSERT_EQ(others.take(failed), 0);
  waits_for_ = [&](const std::string&) {
    write_cell_result(folder + "/result.json", {{"psnr", 7.0}});
    write_cell_failure(options_.folder, "cell1", "broken elsewhere");
    theirs = {};
    others = {};
  };
  EXPECT_TRUE(run(cells(3)));
  EXPECT_EQ(outcomes_.size(), 1U);
  EXPECT_EQ(ended_.results.at("cell0"), (CellValues{{"psnr", 7.0}}));
  EXPECT_EQ(ended_.failures.at("cell1"), "broken elsewhere");
  for (const LogLine& line : log()) EXPECT_EQ(line.cell, "cell2");
}

TEST_F(CellPool, CellsAreNoRanksOfALauncher) {
  ASSERT_EQ(setenv("OMPI_COMM_WORLD_RANK", "1", 1), 0);
  ASSERT_EQ(setenv("OMPI_COMM_WORLD_SIZE", "2", 1), 0);
  EXPECT_TRUE(run(cells(1)));
  unsetenv("OMPI_COMM_WORLD_RANK");
  unsetenv("OMPI_COMM_WORLD_SIZE");
  ASSERT_FALSE(log().empty());
  EXPECT_EQ(log().front().rank, "rank=");
}

using Names = std::vector<std::string>;

TEST(SweepDevices, DevicesByNumberOrName) {
  EXPECT_EQ(device_names({"0", "cuda:2"}), (Names{"cuda:0", "cuda:2"}));
  const auto refusal = [](const Names& words) -> std::string {
    try {
      device_names(words);
    } catch (const Error& error) {
      EXPECT_EQ(error.kind(), ErrorKind::usage);
      return error.message();
    }
    return "";
  };
  for (const char* word : {"cpu", "cuda", "cuda:", "-1", "1000", "0x1", "gpu0", "", "all"})
    EXPECT_EQ(refusal({"0", word}), "--devices: '" + std::string(word) + "' is not a CUDA device") << word;
  EXPECT_EQ(refusal({"1", "0", "cuda:1"}), "--devices: 'cuda:1' is named twice");
  EXPECT_EQ(refusal({"1", "01"}), "--devices: '01' is named twice");
}

// Objects are found in the run of another cell, with the settings of their own.
TEST_F(CellPool, ObjectsWaitForTheirRun) {
  std::vector<Cell> all = cells(2);
  all[0].objects = true;
  all[0].field_cell = "cell1";
  all[0].config = "objects: {reach: 0.125, stuff: [wall]}\n";
  ASSERT_TRUE(run(all));
  EXPECT_EQ(outcomes_["cell0"], "done");
  EXPECT_EQ(outcomes_["cell1"], "done");
  const std::string words = read_text_file(folder_ + "/objects"), out = folder_ + "/out/cells/";
  EXPECT_NE(words.find("objects " + out + "cell1/run --out " + out + "cell0/objects --split test --score --json"),
            std::string::npos)
      << words;
  EXPECT_NE(words.find("--set objects={reach: 0.125, stuff: [wall]}"), std::string::npos) << words;
  const std::optional<CellValues> values = read_cell_result(out + "cell0/result.json");
  ASSERT_TRUE(values.has_value());
  EXPECT_EQ(values->front(), (std::pair<std::string, double>{"pq", 0.5}));
}

}  // namespace
}  // namespace semfield
