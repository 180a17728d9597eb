// Every registered dataset on a tiny scene in its own format: its laws, what `semfield init` finds, pose conventions.
#include <nlohmann/json.hpp>
#include <sstream>

#include "app/scene/folder_scene.h"
#include "compute/parallel.h"
#include "config/compose.h"
#include "core/files.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "plugin/loader.h"
#include "scene/loading/frame_source.h"
#include "tests/conformance/dataset_samples.h"
#include "tests/conformance/rows.h"
#include "tests/conformance/sample_files.h"
#include "tests/scene/tiny_scene.h"
#include "tests/temp_dir.h"

namespace semfield::testkit {
namespace {

using testing_room::fresh_folder;
namespace fs = std::filesystem;
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

// Files whose poses or depth keep another convention than their dataset expects: named, with keys that mend them.

using Break = std::function<Pose(const Pose&)>;

Pose inverted(const Pose& pose) {
  Pose out;
  for (std::size_t i = 0; i < 9; ++i) out.r[i / 3][i % 3] = pose.r[i % 3][i / 3];
  out.t = out.rotate(pose.t) * -1.0;
  return out;
}
Pose scaled(Pose pose, double by) {
  pose.t = pose.t * by;
  return pose;
}

// The rows of a pose in a text, changed.
std::string broken(const std::string& rows, const Break& how, const char* end) {
  std::vector<double> numbers;
  parse_numbers(rows, numbers);
  return pose_rows(how(pose_from_rows(numbers)), end);
}

// Rewrites every pose of a sample's files.
void break_poses(const std::string& dataset, const fs::path& root, const Break& how) {
  if (dataset == "replica") {
    std::istringstream in(read_text_file((root / "traj_w_c.txt").string()));
    std::string out;
    for (std::string line; std::getline(in, line);) out += broken(line, how, " ") + "\n";
    write_file_atomic((root / "traj_w_c.txt").string(), out);
  } else if (dataset == "scannet") {
    for (const auto& entry : fs::directory_iterator(root / "pose"))
      write_file_atomic(entry.path().string(), broken(read_text_file(entry.path().string()), how, "\n"));
  } else {
    nlohmann::json index = nlohmann::json::parse(read_text_file((root / "transforms.json").string()));
    for (nlohmann::json& frame : index["frames"]) {
      std::vector<double> numbers;
      for (const nlohmann::json& row : frame["transform_matrix"]) numbers.insert(numbers.end(), row.begin(), row.end());
      const Pose pose = how(pose_from_rows(numbers));
      for (std::size_t r = 0; r < 3; ++r)
        frame["transform_matrix"][r] = {pose.r[r][0], pose.r[r][1], pose.r[r][2], pose.t[static_cast<int>(r)]};
    }
    write_file_atomic((root / "transforms.json").string(), index.dump());
  }
}

struct Opened {
  LoadedScene scene;
  Diagnostics diagnostics;
};

struct Sample {
  explicit Sample(const std::string& dataset) : name(dataset) {
    settings = dataset_samples().at(dataset)(root.path()).settings;
  }

  std::unique_ptr<Opened> open(const SceneLoadOptions& options = {}) const {
    const PluginEntry& entry = linked_registry().get(PluginKind::dataset, name);
    const std::unique_ptr<Dataset> dataset = entry.dataset(*make_params(entry, settings), DatasetBuild{root.path()});
    auto out = std::make_unique<Opened>();
    out->scene = load_scene(*dataset, options, out->diagnostics);
    return out;
  }

  std::string name;
  const TempDir root;
  Settings settings;
};

// What `--set scene.load.KEY=VALUE` in the remedy says.
SceneLoadOptions by_remedy(const std::string& remedy) {
  SceneLoadOptions out;
  std::istringstream words(remedy);
  for (std::string word; words >> word;) {
    const std::string prefix = "scene.load.";
    if (word.rfind(prefix, 0) != 0 || word.find('=') == std::string::npos) continue;
    const std::string key = word.substr(prefix.size(), word.find('=') - prefix.size());
    const std::string value = word.substr(word.find('=') + 1);
    if (key == "flip_camera_axes") out.convention.flip_camera_axes = value == "true";
    if (key == "invert_poses") out.convention.invert_poses = value == "true";
    if (key == "pose_scale") out.convention.pose_scale = std::stod(value);
    if (key == "depth_scale") out.convention.depth_scale = std::stod(value);
  }
  return out;
}

std::vector<Diagnostic> findings(const Diagnostics& diagnostics) {
  std::vector<Diagnostic> out;
  for (const Diagnostic& d : diagnostics.all()) {
    if (d.severity != Severity::note) out.push_back(d);
  }
  return out;
}

struct Case {
  const char* what;
  Break how;
  PoseConvention convention;
  std::vector<std::string> named;
};

const std::vector<Case>& cases() {
  static const std::vector<Case> all{
      {"axes", opencv_from_opengl, {.flip_camera_axes = true}, {"OpenGL axes"}},
      {"inverse", inverted, {.invert_poses = true}, {"world-to-camera"}},
      {"inverse_of_other_axes",
       [](const Pose& m) { return inverted(opencv_from_opengl(m)); },
       {.flip_camera_axes = true, .invert_poses = true},
       {"OpenGL axes", "world-to-camera"}},
      {"millimetres", [](const Pose& m) { return scaled(m, 1000); }, {.pose_scale = 0.001}, {"millimetres"}},
      {"kilometres", [](const Pose& m) { return scaled(m, 0.001); }, {.pose_scale = 1000}, {"1000 times too small"}},
      {"inverse_in_millimetres",
       [](const Pose& m) { return scaled(inverted(m), 1000); },
       {.invert_poses = true, .pose_scale = 0.001},
       {"world-to-camera", "millimetres"}},
      {"axes_in_millimetres",
       [](const Pose& m) { return scaled(opencv_from_opengl(m), 1000); },
       {.flip_camera_axes = true, .pose_scale = 0.001},
       {"OpenGL axes", "millimetres"}},
  };
  return all;
}

class PoseConventions : public testing::TestWithParam<const char*> {};

TEST_P(PoseConventions, EachBreakIsNamedAndItsRemedyRestoresTheScene) {
  if (!images_available()) GTEST_SKIP() << "this build reads no images (SEMFIELD_WITH_IMAGES=OFF)";
  const Sample whole(GetParam());
  const std::unique_ptr<Opened> right = whole.open();
  EXPECT_TRUE(findings(right->diagnostics).empty()) << findings(right->diagnostics).front().text();
  EXPECT_HAS(right->scene.geometry, "poses agree with depth");
  for (const Case& c : cases()) {
    SCOPED_TRACE(c.what);
    const Sample sample(GetParam());
    break_poses(GetParam(), sample.root.path(), c.how);
    const std::unique_ptr<Opened> wrong = sample.open();
    const std::vector<Diagnostic> said = findings(wrong->diagnostics);
    ASSERT_EQ(said.size(), 1u) << wrong->scene.geometry;  // and no consequence beside it
    EXPECT_EQ(said[0].severity, Severity::error);
    for (const std::string& name : c.named) EXPECT_HAS(said[0].message, name) << said[0].text();
    const SceneLoadOptions options = by_remedy(said[0].remedy);
    EXPECT_EQ(options.convention, c.convention) << said[0].remedy;
    const std::unique_ptr<Opened> mended = sample.open(options);
    EXPECT_TRUE(findings(mended->diagnostics).empty()) << findings(mended->diagnostics).front().text();
    EXPECT_EQ(mended->scene.geometry, right->scene.geometry);
    for (std::size_t f = 0; f < right->scene.info.frames.size(); ++f) {
      const Pose &a = right->scene.info.frames[f].world_from_camera,
                 &b = mended->scene.info.frames[f].world_from_camera;
      EXPECT_LT(length(a.t - b.t), 1e-9);
      for (int axis = 0; axis < 3; ++axis) EXPECT_LT(length(a.axis(axis) - b.axis(axis)), 1e-9);
    }
    EXPECT_LT(length(mended->scene.bounds.lo - right->scene.bounds.lo), 1e-6);
    EXPECT_LT(length(mended->scene.bounds.hi - right->scene.bounds.hi), 1e-6);
    SceneLoadOptions unchecked{.check_geometry = false};
    EXPECT_FALSE(sample.open(unchecked)->diagnostics.has_errors());
  }
}

INSTANTIATE_TEST_SUITE_P(Files, PoseConventions, testing::Values("replica", "transforms_json", "scannet"),
                         [](const auto& dataset) { return std::string(dataset.param); });

}  // namespace
}  // namespace semfield::testkit
