// Files whose poses or depth keep another convention than their dataset expects: named, with keys that mend them.
#include <gtest/gtest.h>
#include <unistd.h>

#include <cmath>
#include <filesystem>
#include <functional>
#include <nlohmann/json.hpp>
#include <sstream>

#include "compute/parallel.h"
#include "formats/image_io.h"
#include "loading/frame_source.h"
#include "system/files.h"
#include "tests/conformance/dataset_samples.h"
#include "tests/conformance/rows.h"

namespace semfield::testkit {
namespace {

namespace fs = std::filesystem;
using Matrix = std::vector<double>;  // 16 numbers, row by row
using Break = std::function<Matrix(const Matrix&)>;

Matrix product(const Matrix& a, const Matrix& b) {
  Matrix out(16);
  for (std::size_t i = 0; i < 16; ++i) {
    for (std::size_t k = 0; k < 4; ++k) out[i] += a[i / 4 * 4 + k] * b[k * 4 + i % 4];
  }
  return out;
}
const Matrix kFlip{1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1};
Matrix flipped(const Matrix& m) { return product(m, kFlip); }
Matrix inverted(const Matrix& m) {
  Matrix out{m[0], m[4], m[8], 0, m[1], m[5], m[9], 0, m[2], m[6], m[10], 0, 0, 0, 0, 1};
  for (std::size_t r = 0; r < 3; ++r) out[4 * r + 3] = -(m[r] * m[3] + m[4 + r] * m[7] + m[8 + r] * m[11]);
  return out;
}
Matrix scaled(Matrix m, double by) {
  for (const std::size_t i : {3u, 7u, 11u}) m[i] *= by;
  return m;
}

Matrix numbers_of(std::istream& in) {
  Matrix out(16);
  for (double& v : out) in >> v;
  return out;
}
std::string text_of(const Matrix& m, const char* after = "\n") {
  std::ostringstream out;
  out.precision(17);
  for (std::size_t i = 0; i < 16; ++i) out << m[i] << (i % 4 == 3 ? after : " ");
  return out.str();
}

// Rewrites every pose of a sample's files.
void break_poses(const std::string& dataset, const fs::path& root, const Break& how) {
  if (dataset == "replica") {
    std::istringstream in(read_text_file((root / "traj_w_c.txt").string()));
    std::string out;
    for (std::string line; std::getline(in, line);) {
      std::istringstream row(line);
      out += text_of(how(numbers_of(row)), " ") + "\n";
    }
    write_file_atomic((root / "traj_w_c.txt").string(), out);
  } else if (dataset == "scannet") {
    for (const auto& entry : fs::directory_iterator(root / "pose")) {
      std::istringstream in(read_text_file(entry.path().string()));
      write_file_atomic(entry.path().string(), text_of(how(numbers_of(in))));
    }
  } else {
    nlohmann::json index = nlohmann::json::parse(read_text_file((root / "transforms.json").string()));
    for (nlohmann::json& frame : index["frames"]) {
      Matrix m;
      for (const nlohmann::json& row : frame["transform_matrix"]) {
        for (const double v : row) m.push_back(v);
      }
      m = how(m);
      for (std::size_t i = 0; i < 16; ++i) frame["transform_matrix"][i / 4][i % 4] = m[i];
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
    const auto* test = testing::UnitTest::GetInstance()->current_test_info();
    root = fs::path(testing::TempDir()) /
           (std::string("semfield_poses_") + test->name() + "_" + dataset + "_" + std::to_string(::getpid()));
    fs::remove_all(root);
    fs::create_directories(root);
    settings = dataset_samples().at(dataset)(root.string()).settings;
  }
  ~Sample() { fs::remove_all(root); }

  std::unique_ptr<Opened> open(const SceneLoadOptions& options = {}) const {
    const PluginEntry& entry = linked_registry().get(PluginKind::dataset, name);
    const std::unique_ptr<Dataset> dataset = entry.dataset(*make_params(entry, settings), DatasetBuild{root.string()});
    auto out = std::make_unique<Opened>();
    out->scene = load_scene(*dataset, options, out->diagnostics);
    return out;
  }

  std::string name;
  fs::path root;
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
      {"axes", flipped, {.flip_camera_axes = true}, {"OpenGL axes"}},
      {"inverse", inverted, {.invert_poses = true}, {"world-to-camera"}},
      {"inverse_of_other_axes",
       [](const Matrix& m) { return inverted(flipped(m)); },
       {.flip_camera_axes = true, .invert_poses = true},
       {"OpenGL axes", "world-to-camera"}},
      {"millimetres", [](const Matrix& m) { return scaled(m, 1000); }, {.pose_scale = 0.001}, {"millimetres"}},
      {"kilometres", [](const Matrix& m) { return scaled(m, 0.001); }, {.pose_scale = 1000}, {"1000 times too small"}},
      {"inverse_in_millimetres",
       [](const Matrix& m) { return scaled(inverted(m), 1000); },
       {.invert_poses = true, .pose_scale = 0.001},
       {"world-to-camera", "millimetres"}},
      {"axes_in_millimetres",
       [](const Matrix& m) { return scaled(flipped(m), 1000); },
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
  EXPECT_NE(right->scene.geometry.find("poses agree with depth"), std::string::npos) << right->scene.geometry;
  for (const Case& c : cases()) {
    SCOPED_TRACE(c.what);
    const Sample sample(GetParam());
    break_poses(GetParam(), sample.root, c.how);
    const std::unique_ptr<Opened> wrong = sample.open();
    const std::vector<Diagnostic> said = findings(wrong->diagnostics);
    ASSERT_EQ(said.size(), 1u) << wrong->scene.geometry;  // and no consequence beside it
    EXPECT_EQ(said[0].severity, Severity::error);
    for (const std::string& name : c.named) EXPECT_NE(said[0].message.find(name), std::string::npos) << said[0].text();
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
    SceneLoadOptions unchecked;
    unchecked.check_geometry = false;
    EXPECT_FALSE(sample.open(unchecked)->diagnostics.has_errors());
  }
}

INSTANTIATE_TEST_SUITE_P(Files, PoseConventions, testing::Values("replica", "transforms_json", "scannet"),
                         [](const auto& dataset) { return std::string(dataset.param); });

}  // namespace
}  // namespace semfield::testkit
