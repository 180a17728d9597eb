// `semfield fuse` as a user runs it: lines, JSON, maps, depth of a trained run, refusals.
#include <gtest/gtest.h>

#include <filesystem>
#include <nlohmann/json.hpp>

#include "formats/image_io.h"
#include "formats/png_codec.h"
#include "loading/packed_scene.h"
#include "system/files.h"
#include "testkit/analytic_scene.h"
#include "tests/program.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

using testing_program::Result;

Result semfield(const std::string& words, const TempDir& dir) {
  return testing_program::semfield_run(words, dir.path());
}

// A packed analytic room and a configuration that trains on it for a moment.
std::string write_scene(const TempDir& dir, bool with_depth = true) {
  testkit::AnalyticSceneOptions options;
  options.with_depth = with_depth;
  const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene(options);
  Diagnostics diagnostics;
  const SceneInfo info = scene->open(diagnostics);
  write_packed_scene(dir / "room.sfpack", info, [&](int frame, FrameBuffer& buffer) { scene->read(frame, buffer); });
  std::string yaml = hash_config("report: {eval_every_s: 0, strips: 0}\n");
  yaml.replace(yaml.find("{type: analytic_room}"), 21, "{type: packed, file: room.sfpack}");
  write_file_atomic(dir / "config.yaml", yaml);
  return dir / "config.yaml";
}

TEST(FuseVerb, LinesJsonAndMaps) {
  const TempDir dir;
  const std::string config = write_scene(dir);
  const Result lines = semfield("fuse " + shell_word(config) + " --method monocular,bayesian", dir);
  ASSERT_EQ(lines.code, 0) << lines.err;
  EXPECT_EQ(lines.out.find("fuse: method=monocular depth=true miou_present=1.0000 miou=1.0000 total_accuracy=1.0000 "
                           "average_accuracy=1.0000 filled=0 views=1.0000\nfuse: method=bayesian depth=true "),
            0u)
      << lines.out;
  EXPECT_NE(lines.err.find("predictions are the scene's own labels"), std::string::npos) << lines.err;

  const Result r = semfield(
      "fuse " + shell_word(config) + " --json --set fuse.relative_tolerance=0.03 --out " + shell_word(dir / "maps"),
      dir);
  ASSERT_EQ(r.code, 0) << r.err;
  const auto rows = nlohmann::json::parse(r.out).at("scores");
  ASSERT_EQ(rows.size(), 3u);
  EXPECT_EQ(rows[0]["method"], "monocular");
  EXPECT_EQ(rows[1]["method"], "bayesian");
  EXPECT_EQ(rows[2]["method"], "average");
  for (const auto& row : rows) {
    EXPECT_EQ(row["depth"], "true");
    for (const char* key : {"miou", "miou_present", "total_accuracy", "average_accuracy"})
      EXPECT_GT(row[key].get<double>(), 0.9) << key;
  }
  EXPECT_GT(rows[1]["visible_views_mean"].get<double>(), 2);
  const auto manifest = nlohmann::json::parse(read_text_file(dir / "maps/fuse.json"));
  EXPECT_EQ(manifest["scores"], rows);
  EXPECT_EQ(manifest["frames"], 9);
  EXPECT_EQ(manifest["pixels"], 9 * 48 * 36);
  for (const char* method : {"monocular", "bayesian", "average"}) {
    int maps = 0;
    for (const auto& entry : std::filesystem::directory_iterator(dir / ("maps/" + std::string(method)))) {
      const std::string bytes = read_text_file(entry.path().string());
      const PngImage png = decode_png(std::as_bytes(std::span(bytes)));
      EXPECT_EQ(png.width_px, 48);
      for (std::size_t i = 0; i < 48 * 36; ++i) ASSERT_LE(png.sample(i), 5u);  // ids, 0 = void
      ++maps;
    }
    EXPECT_EQ(maps, 18);
  }
}

TEST(FuseVerb, DepthOfARunAndItsOwnRow) {
  const TempDir dir;
  const std::string config = write_scene(dir);
  ASSERT_EQ(semfield("train " + shell_word(config) + " --steps 200 --out " + shell_word(dir / "run"), dir).code, 0);
  const Result r = semfield("fuse " + shell_word(config) + " --json --depth-from " + shell_word(dir / "run") +
                                " --set fuse.tolerance=0.2 " + "--out " + shell_word(dir / "maps"),
                            dir);
  ASSERT_EQ(r.code, 0) << r.err;
  const auto rows = nlohmann::json::parse(r.out).at("scores");
  ASSERT_EQ(rows.size(), 4u);
  EXPECT_EQ(rows[3]["method"], "field");
  EXPECT_TRUE(rows[3]["visible_views_mean"].is_null());
  EXPECT_GT(rows[3]["total_accuracy"].get<double>(), 0.6);
  EXPECT_EQ(rows[1]["depth"], "learned");
  EXPECT_GT(rows[1]["total_accuracy"].get<double>(), 0.7);
  EXPECT_GT(rows[1]["visible_views_mean"].get<double>(), 1.5);
  EXPECT_TRUE(std::filesystem::exists(dir / "maps/field"));
  EXPECT_EQ(nlohmann::json::parse(read_text_file(dir / "maps/fuse.json"))["depth_from"]["step"], 200);

  // A field of another scene: the same names, other places.
  testkit::AnalyticSceneOptions moved;
  moved.frames = 10;
  const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene(moved);
  Diagnostics diagnostics;
  const SceneInfo info = scene->open(diagnostics);
  write_packed_scene(dir / "other.sfpack", info, [&](int frame, FrameBuffer& b) { scene->read(frame, b); });
  const Result other =
      semfield("fuse " + shell_word(config) + " --set " + shell_word("scene.file=" + (dir / "other.sfpack")) +
                   " --depth-from " + shell_word(dir / "run"),
               dir);
  EXPECT_EQ(other.code, 65);
  EXPECT_NE(other.err.find("the camera stands elsewhere in the scene of"), std::string::npos) << other.err;
}

TEST(FuseVerb, RealProbabilities) {
  const std::string root = std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/shelf_bin";
  if (!std::filesystem::exists(root)) GTEST_SKIP() << "the optional shelf bin is not at hand";
  const TempDir dir;
  std::string yaml = hash_config("");
  yaml.replace(
      yaml.find("{type: analytic_room}"), 21,
      "{type: transforms_json, root: " + root + ", labels: {from: {type: npz, folder: " + root + "/predictions}}}");
  write_file_atomic(dir / "config.yaml", yaml);
  const Result r = semfield("fuse config.yaml --json", dir);
  ASSERT_EQ(r.code, 0) << r.err;
  const auto rows = nlohmann::json::parse(r.out).at("scores");
  ASSERT_EQ(rows.size(), 3u);
  const double alone = rows[0]["miou_present"].get<double>();
  EXPECT_NEAR(alone, 0.657, 0.001);
  EXPECT_GT(rows[1]["miou_present"].get<double>(), alone + 0.03);
  EXPECT_GT(rows[2]["miou_present"].get<double>(), alone + 0.04);
}

TEST(FuseVerb, Refusals) {
  const TempDir dir;
  const std::string config = write_scene(dir, false);
  const auto refused = [&](const std::string& words, int code, const std::string& message) {
    const Result r = semfield("fuse " + shell_word(config) + " " + words, dir);
    EXPECT_EQ(r.code, code) << words;
    EXPECT_NE(r.err.find(message), std::string::npos) << r.err;
    EXPECT_TRUE(r.out.empty()) << r.out;
  };
  refused("", 65, "no training frame of the scene has depth");
  refused("--depth learned", 2, "name its folder: --depth-from RUN");
  refused("--depth false", 2, "--depth false: expected true or learned");
  refused("--depth true --depth-from x", 2, "exclude each other");
  refused("--method bayesian,mean", 2, "--method bayesian,mean: expected monocular, bayesian or average");
  refused("--set fuse.methods=[mean]", 78, "there is no method 'mean'");
  refused("--depth-from " + shell_word(dir / "nowhere"), 66, "nowhere");
  refused("--set fuse.neighbourhood=2", 78, "a window of 2 pixels has no centre");
}

}  // namespace
}  // namespace semfield
