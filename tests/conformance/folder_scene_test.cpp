// What `semfield init` finds in folders: the reader that each dataset's own files call for, and the configuration.
#include "app/scene/folder_scene.h"

#include <gtest/gtest.h>

#include "config/compose.h"
#include "core/text.h"
#include "plugin/linked_plugins.h"
#include "tests/conformance/dataset_samples.h"
#include "tests/scene/tiny_scene.h"

namespace semfield::app {
namespace {

using testing_room::error_of;
using testing_room::fresh_folder;

class FolderScenes : public testing::Test {
 protected:
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
    const ConfigNode tree = compose_config_tree(config_of(scene, kUsualPreset), std::vector<std::string>{});
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
  EXPECT_EQ(error_of([&] { find(folder, "replica"); }).find("'" + folder + "' holds nothing that replica knows"), 0u);
}

TEST_F(FolderScenes, LargeImagesAreDividedAndNamesArePlain) {
  FolderScene scene;
  scene.section = ConfigNode::make_map({}, {});
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

TEST_F(FolderScenes, PhotographsWithoutPosesGetTheCommandsThatFindThem) {
  const std::string folder = fresh_folder("it's mine");
  std::filesystem::create_directories(folder + "/images");
  for (const char* name : {"a", "b", "c"})
    write_png_rgb(folder + "/images/" + name + ".png", 4, 2, std::vector<std::uint8_t>(24, 9));
  const std::string said = error_of([&] { find(folder); });
  EXPECT_NE(said.find("holds 3 photographs and no camera poses"), std::string::npos) << said;
  EXPECT_NE(
      said.find("colmap feature_extractor --database_path " + shell_word(folder + "/database.db") + " --image_path " +
                shell_word(folder + "/images") + " --ImageReader.camera_model OPENCV --ImageReader.single_camera 1\n"),
      std::string::npos)
      << said;
  for (const char* part : {"colmap exhaustive_matcher ", "colmap mapper ", "then: semfield init "})
    EXPECT_NE(said.find(part), std::string::npos) << said;
  write_png_rgb(folder + "/images/d.png", 2, 4, std::vector<std::uint8_t>(24, 9));
  EXPECT_EQ(error_of([&] { find(folder); }).find("single_camera"), std::string::npos) << "two cameras took them";
}

TEST_F(FolderScenes, WhatIsNoSceneIsRefused) {
  const std::string folder = fresh_folder("empty");
  EXPECT_EQ(error_of([&] {
              find(folder);
            }).find("'" + folder + "' holds no scene that a dataset knows: colmap, llff, obj_room, packed, replica, "),
            0u);
  EXPECT_EQ(error_of([&] { find(folder + "/none"); }), "no folder '" + folder + "/none'; check the path");
  write_file_atomic(folder + "/run.yaml", "name: x\n");
  EXPECT_FALSE(names_a_scene(folder, context)) << "a run";
  EXPECT_FALSE(names_a_scene(folder + "/run.yaml", context));
}

}  // namespace
}  // namespace semfield::app
