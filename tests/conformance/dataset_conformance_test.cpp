// Every registered dataset on a tiny scene in its own format: its laws, and what `semfield init` finds.

#include "app/scene/folder_scene.h"
#include "config/config_words.h"
#include "plugin/loader.h"
#include "tests/conformance/dataset_samples.h"
#include "tests/conformance/rows.h"
#include "tests/scene/tiny_scene.h"
#include "tests/temp_dir.h"

namespace semfield::testkit {
namespace {

using testing_room::fresh_folder;
using namespace app;

std::string name_of(const testing::TestParamInfo<Row>& info) { return info.param.text(); }

class DatasetConformance : public testing::TestWithParam<Row> {};

TEST_P(DatasetConformance, Laws) {
  const Row& row = GetParam();
  const auto found = dataset_samples().find(row.name);
  ASSERT_NE(found, dataset_samples().end())
      << "dataset '" << row.name << "' has no " << row.name << "_sample.cpp that writes a tiny scene";
  const TempDir folder;
  const DatasetSample sample = found->second(folder.path());
  if (!sample.absent.empty()) GTEST_SKIP() << sample.absent;
  Settings settings = sample.settings;
  for (const auto& [name, value] : row.settings) settings[name] = value;
  const Failures failures =
      dataset_laws(linked_registry(), row.name, settings, DatasetBuild{folder.path()}, sample.expected);
  EXPECT_TRUE(failures.empty()) << to_text(failures);
}

// `semfield init` finds a reader by this: what a dataset recognises in a folder, it opens with those parameters.
TEST_P(DatasetConformance, WhatIsRecognisedOpens) {
  const TempDir folder;
  const PluginEntry& entry = linked_registry().get(PluginKind::dataset, GetParam().name);
  EXPECT_EQ(entry.new_params()->recognise(folder.path()), "") << "an empty folder";
  EXPECT_EQ(entry.new_params()->recognise(folder / "none"), "");
  const DatasetSample sample = dataset_samples().at(GetParam().name)(folder.path());
  if (!sample.absent.empty()) GTEST_SKIP() << sample.absent;
  const std::unique_ptr<PluginParams> params = entry.new_params();
  if (!params->recognise(folder.path()).empty()) {
    Diagnostics diagnostics;
    EXPECT_FALSE(entry.dataset(*params, {})->open(diagnostics).frames.empty());
  }
}

INSTANTIATE_TEST_SUITE_P(Linked, DatasetConformance, testing::ValuesIn(rows_of(PluginKind::dataset)), name_of);

// What `semfield init` finds in folders: the reader that each dataset's own files call for, and the configuration.

struct FolderScenes : testing::Test {
  FolderScenes() { register_linked_plugins(context.registry); }
  FolderScene find(const std::string& path, const std::string& type = "") { return find_scene(path, type, context); }
  AppContext context;
};

TEST_F(FolderScenes, EveryDatasetKnowsItsOwnFiles) {
  for (const auto& [name, write] : testkit::dataset_samples()) {
    const std::string folder = fresh_folder(name);
    if (!write(folder).absent.empty()) continue;
    EXPECT_TRUE(names_a_scene(folder, context)) << name;
    const FolderScene scene = find(folder + "/");
    EXPECT_EQ(scene.type, name);
    EXPECT_NE(scene.what, "");
    EXPECT_GT(scene.train_frames + scene.test_frames, 0) << name;
    const ConfigNode tree = compose_config_tree(config_of(scene, kUsualPreset), {});
    const RunConfig config = run_config_of(tree, context.registry);
    Diagnostics diagnostics;
    EXPECT_EQ(std::ssize(config.dataset.entry->dataset(*config.dataset.params, {})->open(diagnostics).frames),
              scene.train_frames + scene.test_frames)
        << name;
  }
}

TEST_F(FolderScenes, OfTwoReadersThatWhichBringsMostIsTaken) {
  const std::string folder = fresh_folder("both");
  testkit::dataset_samples().at("transforms_json")(folder);
  testkit::dataset_samples().at("colmap")(folder);
  const FolderScene both = find(folder);
  EXPECT_EQ(both.type, "transforms_json");
  EXPECT_EQ(both.others, std::vector<std::string>{"colmap (a COLMAP model in sparse/0)"});
  EXPECT_EQ(find(folder, "colmap").type, "colmap");
  const std::string run = fresh_folder("run");
  write_file_atomic(run + "/run.yaml", "name: x\n");
  EXPECT_FALSE(names_a_scene(run, context));
  EXPECT_FALSE(names_a_scene(run + "/run.yaml", context));
}

TEST_F(FolderScenes, LargeImagesAreDividedAndNamesArePlain) {
  FolderScene scene{.section = ConfigNode::make_map({}, {})};
  for (const auto& [longest, by] : {std::pair{800, 1}, {801, 2}, {1600, 2}, {4032, 6}}) {
    scene.width_px = 600;
    scene.height_px = longest;
    EXPECT_EQ(downscale_of(scene), by);
  }
  const std::string folder = fresh_folder("my photos (2)");
  testkit::dataset_samples().at("packed")(folder);
  const std::string name = find(folder).name;
  EXPECT_TRUE(name.ends_with("my_photos__2_")) << name;
}

}  // namespace
}  // namespace semfield::testkit
