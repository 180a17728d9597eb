// Sweep files: what becomes of grids, variants, scenes and lists of files, each error with its place; result tables.
#include "report/sweep/sweep_file.h"

#include <unistd.h>

#include <algorithm>
#include <nlohmann/json.hpp>
#include <set>
#include <sstream>

#include "plugin/loader.h"
#include "report/sweep/sweep_results.h"
#include "session/settings/run_config.h"
#include "system/files.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;

class SweepFile : public testing::Test {
 protected:
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
  EXPECT_EQ(error_of("base: base.yaml\nscenes: {a: }\nvariants: {v: {objects: w}}\n"),
            "sweep.yaml:3:25: variants.v.objects: no variant 'w' that trains a field");
  EXPECT_EQ(error_of("base: base.yaml\nscenes: {a: }\nvariants: {v: {objects: w, fuse: {method: average}}, w: }\n"),
            "sweep.yaml:3:25: variants.v: a row is of 'fuse' or of 'objects'; make two rows of it");
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

TEST_F(SweepFile, PackedCellsKeepLabelsAndSizes) {
  const std::vector<Cell> all = cells(
      "base: base.yaml\nscenes: {a: {pack: true, set: {scene.labels.frames: 10%, scene.load.downscale: 2}}}\n"
      "variants: {x: , y: {set: {scene.labels.frames: 50%}}, z: {set: {scene.hfov_deg: 80}}}\n");
  EXPECT_EQ(all[0].pack, all[1].pack) << "labels are no part of the packed scene";
  EXPECT_NE(all[0].pack, all[2].pack);
  const ConfigNode config =
      parse_config_text(with_packed_scene(all[0].config, registry_.pack_reader(), "/p.sfpack"), "t");
  const ConfigNode& scene = *config.find("scene");
  EXPECT_EQ(scene.find("type")->text(), "packed");
  EXPECT_EQ(scene.find("root"), nullptr);
  EXPECT_EQ(scene.find("labels")->find("frames")->text(), "10%");
  Diagnostics d;
  (void)read_run_config(config, registry_, d);
  EXPECT_FALSE(d.has_errors()) << d.all()[0].text();
}

TEST_F(SweepFile, ErrorsNameTheirPlaceAllAtOnce) {
  EXPECT_EQ(error_of("base: base.yaml\nscenes: {a: }\nvariants: {v: {sett: {}, x: one}}\nsplit: val\nseeds: [1, 1]\n"),
            "sweep.yaml:4:8: split: expected test or train\n"
            "sweep.yaml:5:12: seeds: 1 stands twice\n"
            "sweep.yaml:3:16: variants.v: unknown key 'sett'; did you mean 'set'?\n"
            "sweep.yaml:3:29: variants.v.x: expected a number");
  EXPECT_EQ(error_of("base: bas.yaml\nscenes: {a: }\nvariants: {v: }\n"),
            "sweep.yaml:1:7: base: no file 'bas.yaml', and none '" + shared_root() +
                "/configs/bas.yaml'; paths are relative to the file that writes them");
  EXPECT_EQ(error_of("base: base.yaml\nscenes: {a: }\nuse_scenes: [b]\n"
                     "variants: {v: {fuse: {method: bayes, field: w}}}\n"),
            "sweep.yaml:3:13: use_scenes: no scene 'b'; known: a\n"
            "sweep.yaml:4:22: variants.v.fuse.method: expected monocular, bayesian or average, got 'bayes'\n"
            "sweep.yaml:4:22: variants.v.fuse.field: no variant 'w' that trains a field");
  EXPECT_EQ(error_of("base: base.yaml\nscenes: {a: }\n"),
            "sweep.yaml:1:1: expected either 'variants' (a map of named differences) or 'grid' (lists of values by key "
            "path)");
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
  EXPECT_EQ(error_of("variants: {v: }\n"),
            "sweep.yaml:1:1: scenes: expected a map of at least one scene {base, set}; write one, or base: FILE alone, "
            "whose own scene is taken then");
  EXPECT_EQ(error_of("name: a/b\nbase: base.yaml\nvariants: {v: }\n"),
            "sweep.yaml:1:7: name: 'a/b': files are named after it, so it cannot hold '/'");
}

// The schema and the reader know the same keys.
TEST_F(SweepFile, TheSchemaHasTheKeysThatAreRead) {
  const nlohmann::json schema = nlohmann::json::parse(sweep_schema());
  const auto keys_of = [](const nlohmann::json& map) {
    std::set<std::string> keys;
    for (const auto& [key, value] : map["properties"].items()) keys.insert(key);
    return keys;
  };
  const auto known = [&](const std::string& text) {
    const std::string what = error_of(text);
    const std::size_t begin = what.find("known: ");
    std::set<std::string> keys;
    std::istringstream words(begin == std::string::npos ? ""
                                                        : what.substr(begin + 7, what.find('\n', begin) - begin - 7));
    for (std::string word; words >> word;) keys.insert(word.substr(0, word.find(',')));
    return keys;
  };
  const std::string rest = "base: base.yaml\n";
  std::set<std::string> top = known(rest + "variants: {v: }\nqqqqqqqqqqqq: 1\n");
  top.insert({"sweeps", "include"});
  EXPECT_EQ(keys_of(schema), top);
  const auto each = [&](const char* key) { return schema["properties"][key]["additionalProperties"]; };
  EXPECT_EQ(keys_of(each("variants")), known(rest + "variants: {v: {qqqqqqqqqqqq: 1}}\n"));
  EXPECT_EQ(keys_of(each("scenes")), known(rest + "scenes: {a: {qqqqqqqqqqqq: 1}}\nvariants: {v: }\n"));
  EXPECT_EQ(keys_of(each("variants")["properties"]["fuse"]),
            known(rest + "variants: {v: {fuse: {method: average, qqqqqqqqqqqq: 1}}}\n"));
}

// Every file that is shipped reads, and its cells' configurations too.
TEST_F(SweepFile, ShippedExperimentsArePlanned) {
  const fs::path experiments = fs::path(SEMFIELD_SOURCE_DIR) / "configs" / "experiments";
  const Sweep all = read_sweep((experiments / "all.yaml").string());
  int files = 0;
  for (const auto& entry : fs::directory_iterator(experiments)) files += entry.is_regular_file() ? 1 : 0;
  const Sweep gpu = read_sweep((experiments / "gpu.yaml").string());
  EXPECT_EQ(static_cast<int>(all.experiments.size() + gpu.experiments.size()), files - 5)
      << "all.yaml and gpu.yaml list every experiment, but for propagate.yaml, which needs the labels of first runs, "
         "and "
         "objects.yaml, which is not of the method";
  EXPECT_EQ(plan_cells(read_sweep((experiments / "objects.yaml").string()), registry_).size(), 66u);
  EXPECT_EQ(plan_cells(read_sweep((experiments / "propagate.yaml").string()), registry_).size(), 5u);
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
    EXPECT_EQ(table.svg(), "");
  }
}

TEST(SweepTables, ThePlotIsAFileOfItsOwn) {
  const Example x;
  const std::string svg = ExperimentTable(x.sweep, 0, x.cells, x.results).svg();
  EXPECT_EQ(svg.rfind("<svg xmlns=\"http://www.w3.org/2000/svg\"", 0), 0u);
  EXPECT_HAS(svg, "Noise: miou");
  Example bare;
  for (SweepVariant& v : bare.sweep.experiments[0].variants) v.x.reset();
  EXPECT_EQ(ExperimentTable(bare.sweep, 0, bare.cells, bare.results).svg(), "");
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
  std::filesystem::remove_all(folder);
}

}  // namespace
}  // namespace semfield
