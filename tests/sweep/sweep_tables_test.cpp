// Statistics, tables and result files of a sweep, by hand.
#include "report/sweep/sweep_tables.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <filesystem>

#include "system/files.h"

namespace semfield {
namespace {

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
    Experiment e;
    e.name = "noise";
    e.title = "Noise";
    e.paper = "mIoU";
    e.metrics = {"miou", "psnr"};
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
  EXPECT_NE(text.find("| miou | a | b | mean | paper (mIoU) |\n|---|---|---|---|---|\n"
                      "| 50 %, even | 0.101 ± 0.013 | 0.201 ± 0.013 | 0.151 ± 0.009 | 0.951 |\n"
                      "| p\\|q | 0.111 ± 0.013 | 0.210 | 0.161 | – |\n"),
            std::string::npos)
      << text;  // a cell is missing: one seed of scene b, whose interval is then unknown
  EXPECT_NE(text.find("| PSNR, dB | a | b | mean |\n"), std::string::npos) << text;
}

TEST(SweepTables, CsvQuotesAndCountsOnlyFinishedCells) {
  const Example x;
  const std::string csv = results_csv(x.sweep, x.cells, x.results);
  EXPECT_EQ(csv.substr(0, csv.find('\n')), "experiment,scene,variant,seed,metric,value");
  EXPECT_NE(csv.find("noise,a,\"50 %, even\",1,miou,0.1\n"), std::string::npos) << csv;
  EXPECT_EQ(std::count(csv.begin(), csv.end(), '\n'), 1 + 7 * 2);
  const std::string table = ExperimentTable(x.sweep, 0, x.cells, x.results).csv();
  EXPECT_NE(table.find("p|q,b,miou,1,"), std::string::npos) << table;
}

TEST(SweepTables, ThePlotIsAFileOfItsOwn) {
  const Example x;
  const std::string svg = ExperimentTable(x.sweep, 0, x.cells, x.results).svg();
  EXPECT_EQ(svg.rfind("<svg xmlns=\"http://www.w3.org/2000/svg\"", 0), 0u);
  EXPECT_NE(svg.find("Noise: miou"), std::string::npos);
  Example bare;
  for (SweepVariant& v : bare.sweep.experiments[0].variants) v.x.reset();
  EXPECT_EQ(ExperimentTable(bare.sweep, 0, bare.cells, bare.results).svg(), "");
}

TEST(SweepResults, AreWrittenReadAndTakenFromRunsAndFusions) {
  const std::string folder =
      (std::filesystem::path(testing::TempDir()) / ("semfield_sweep_results_" + std::to_string(::getpid()))).string();
  std::filesystem::create_directories(folder);
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
  std::filesystem::remove_all(folder);
}

}  // namespace
}  // namespace semfield
