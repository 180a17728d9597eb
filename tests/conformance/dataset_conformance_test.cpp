// The dataset laws for every registered dataset, on a tiny scene written in its own format.
#include <gtest/gtest.h>
#include <unistd.h>

#include <filesystem>

#include "tests/conformance/dataset_samples.h"
#include "tests/conformance/rows.h"

namespace semfield::testkit {
namespace {

std::string name_of(const testing::TestParamInfo<Row>& info) { return info.param.text(); }

class DatasetConformance : public testing::TestWithParam<Row> {};

TEST_P(DatasetConformance, Laws) {
  const Row& row = GetParam();
  const auto found = dataset_samples().find(row.name);
  ASSERT_NE(found, dataset_samples().end())
      << "dataset '" << row.name << "' has no " << row.name << "_sample.cpp that writes a tiny scene";
  const std::filesystem::path folder =
      std::filesystem::path(testing::TempDir()) / ("semfield_sample_" + row.text() + "_" + std::to_string(::getpid()));
  std::filesystem::remove_all(folder);
  std::filesystem::create_directories(folder);
  const DatasetSample sample = found->second(folder.string());
  if (!sample.absent.empty()) GTEST_SKIP() << sample.absent;
  Settings settings = sample.settings;
  for (const auto& [name, value] : row.settings) settings[name] = value;
  const Failures failures =
      dataset_laws(linked_registry(), row.name, settings, DatasetBuild{folder.string()}, sample.expected);
  EXPECT_TRUE(failures.empty()) << to_text(failures);
  std::filesystem::remove_all(folder);
}

// `semfield init` finds a reader by this: what a dataset recognises in a folder, it opens with those parameters.
TEST_P(DatasetConformance, WhatIsRecognisedOpens) {
  const std::filesystem::path folder = std::filesystem::path(testing::TempDir()) /
                                       ("semfield_recognised_" + GetParam().text() + "_" + std::to_string(::getpid()));
  std::filesystem::remove_all(folder);
  std::filesystem::create_directories(folder);
  const PluginEntry& entry = linked_registry().get(PluginKind::dataset, GetParam().name);
  EXPECT_EQ(entry.new_params()->recognise(folder.string()), "") << "an empty folder";
  EXPECT_EQ(entry.new_params()->recognise((folder / "none").string()), "");
  const DatasetSample sample = dataset_samples().at(GetParam().name)(folder.string());
  if (!sample.absent.empty()) GTEST_SKIP() << sample.absent;
  const std::unique_ptr<PluginParams> params = entry.new_params();
  if (!params->recognise(folder.string()).empty()) {
    Diagnostics diagnostics;
    EXPECT_FALSE(entry.dataset(*params, {})->open(diagnostics).frames.empty());
  }
  std::filesystem::remove_all(folder);
}

INSTANTIATE_TEST_SUITE_P(Linked, DatasetConformance, testing::ValuesIn(rows_of(PluginKind::dataset)), name_of);

}  // namespace
}  // namespace semfield::testkit
