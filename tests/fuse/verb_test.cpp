// `semfield fuse` and `semfield propagate` as a user runs them: lines, JSON, maps, depth of a trained run, refusals.
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

namespace fs = std::filesystem;

using namespace testing_train;

using namespace testing_program;

Result semfield(const std::string& words, const TempDir& dir) {
  return testing_program::semfield_run(words, dir.path());
}

// A packed analytic room and a configuration that trains on it for a moment.
std::string write_scene(const TempDir& dir, bool with_depth = true) {
  testkit::AnalyticSceneOptions options{.with_depth = with_depth};
  const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene(options);
  Diagnostics diagnostics;
  const SceneInfo info = scene->open(diagnostics);
  write_packed_scene(dir / "room.sfpack", info, [&](int frame, FrameBuffer& buffer) { scene->read(frame, buffer); });
  std::string yaml =
      with_scene(hash_config("report: {eval_every_s: 0, strips: 0}\n"), "{type: packed, file: room.sfpack}");
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
  EXPECT_HAS(lines.err, "predictions are the scene's own labels");

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
  testkit::AnalyticSceneOptions moved{.frames = 10};
  const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene(moved);
  Diagnostics diagnostics;
  const SceneInfo info = scene->open(diagnostics);
  write_packed_scene(dir / "other.sfpack", info, [&](int frame, FrameBuffer& b) { scene->read(frame, b); });
  const Result other =
      semfield("fuse " + shell_word(config) + " --set " + shell_word("scene.file=" + (dir / "other.sfpack")) +
                   " --depth-from " + shell_word(dir / "run"),
               dir);
  EXPECT_EQ(other.code, 65);
  EXPECT_HAS(other.err, "the camera stands elsewhere in the scene of");

  // In a room a ten-thousandth as large, cameras a fifth farther out are elsewhere too.
  const auto scaled = [](const std::string& by) {
    return " --set scene.load.pose_scale=" + by + " --set scene.load.depth_scale=" + by;
  };
  ASSERT_EQ(
      semfield("train " + shell_word(config) + scaled("1e-4") + " --steps 2 --out " + shell_word(dir / "small"), dir)
          .code,
      0);
  const std::string fuse = " --depth-from " + shell_word(dir / "small");
  EXPECT_EQ(semfield("fuse " + shell_word(config) + scaled("1e-4") + fuse, dir).code, 0);
  const Result elsewhere = semfield("fuse " + shell_word(config) + scaled("1.2e-4") + fuse, dir);
  EXPECT_EQ(elsewhere.code, 65);
  EXPECT_HAS(elsewhere.err, "the camera stands elsewhere in the scene of");
}

TEST(FuseVerb, RealProbabilities) {
  const std::string root = std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/shelf_bin";
  if (!std::filesystem::exists(root)) GTEST_SKIP() << "the optional shelf bin is not at hand";
  const TempDir dir;
  const std::string yaml =
      with_scene(hash_config(), "{type: transforms_json, root: " + root +
                                    ", labels: {from: {type: npz, folder: " + root + "/predictions}}}");
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
    EXPECT_HAS(r.err, message);
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

// `semfield propagate` as a user runs it: its line, JSON, files that train again, the same bytes for any threads,
// refusals.

using nlohmann::json;

json manifest_of(const std::string& folder) { return json::parse(read_text_file(folder + "/manifest.json")); }

constexpr const char* kClicks = " --set 'scene.labels.degrade=[{type: propagation}]'";
constexpr const char* kNoise = " --set 'scene.labels.degrade=[{type: pixel_noise, ratio: 0.6}]'";
constexpr const char* kNpz =
    " --set 'scene.labels.from={type: npz, folder: soft/probability, pattern: \"{name}.npy\"}'";

TEST(PropagateVerb, ClicksBecomeLabelsThatTrainAgain) {
  const TempDir dir;
  write_packed_config(dir, 200, 0);
  ASSERT_EQ(semfield(std::string("train config.yaml --out run") + kClicks, dir).code, 0);
  const Result line = semfield("propagate run --out soft", dir);
  ASSERT_EQ(line.code, 0) << line.err;
  EXPECT_EQ(line.out.rfind("propagate: method=surface labelled_share=0.00", 0), 0u) << line.out;
  EXPECT_HAS(line.out, "accuracy=1.0000->0.", " folder=soft\n");
  EXPECT_HAS(line.err, "propagate.cell_m is 0.");

  const json m = manifest_of(dir / "soft");
  EXPECT_EQ(m["steps"][0]["type"], "propagation");
  EXPECT_EQ(m["steps"][1]["type"], "propagate surface");
  EXPECT_EQ(m["frames"].size(), 9u);
  EXPECT_EQ(m["total"]["labelled_px"], 9 * 48 * 36);
  EXPECT_GT(m["total"]["accuracy"].get<double>(), 0.6);  // the field has seen 200 steps
  EXPECT_HAS(m["config"].get<std::string>(), "propagate:");

  const Result one = semfield("propagate run --json --threads 1 --out one", dir);
  ASSERT_EQ(one.code, 0) << one.err;
  const json row = json::parse(one.out);
  EXPECT_EQ(row["method"], "surface");
  EXPECT_EQ(row["accuracy"]["before"], 1.0);
  EXPECT_EQ(row["accuracy"]["after"], m["total"]["accuracy"]);
  EXPECT_EQ(row["miou_present"]["after"], m["total"]["miou_present"]);
  EXPECT_LT(row["labelled_share"]["before"].get<double>(), 0.01);
  EXPECT_EQ(row["labelled_share"]["after"], 1.0);
  int files = 0;
  for (const auto& file : fs::recursive_directory_iterator(dir / "soft")) {
    if (!file.is_regular_file() || file.path().filename() == "manifest.json") continue;  // which names the threads
    const std::string other = dir / "one/" + fs::relative(file.path(), dir / "soft").string();
    EXPECT_TRUE(read_text_file(file.path().string()) == read_text_file(other)) << other;
    ++files;
  }
  EXPECT_EQ(files, 3 * 9 + 2);

  // What was written is what trains: the same labels come back through the reader, and a run goes on with them.
  const Result again = semfield(std::string("degrade config.yaml --out again") + kNpz, dir);
  ASSERT_EQ(again.code, 0) << again.err;
  EXPECT_EQ(manifest_of(dir / "again")["total"], m["total"]);
  const Result trained = semfield(std::string("train config.yaml --steps 20 --out second") + kNpz, dir);
  EXPECT_EQ(trained.code, 0) << trained.err;
}

TEST(PropagateVerb, PoolingNoisyLabels) {
  const TempDir dir;
  write_packed_config(dir, 200, 0);
  ASSERT_EQ(semfield(std::string("train config.yaml --out run") + kNoise, dir).code, 0);
  const Result r =
      semfield("propagate run --json --method vote --set 'propagate.vote_cells_m=[0.1, 0.3]' --out soft", dir);
  ASSERT_EQ(r.code, 0) << r.err;
  const json row = json::parse(r.out);
  EXPECT_EQ(row["method"], "vote");
  EXPECT_LT(row["accuracy"]["before"].get<double>(), 0.6);
  EXPECT_GT(row["accuracy"]["after"].get<double>(), row["accuracy"]["before"].get<double>() + 0.2);
  EXPECT_EQ(row["labelled_share"]["after"], row["labelled_share"]["before"]);
  EXPECT_EQ(manifest_of(dir / "soft")["steps"][1]["type"], "propagate vote");
}

TEST(PropagateVerb, Refusals) {
  const TempDir dir;
  write_packed_config(dir, 5, 0);
  ASSERT_EQ(semfield("train config.yaml --out run", dir).code, 0);
  const auto refused = [&](const std::string& words, int code, const std::string& message) {
    const Result r = semfield("propagate " + words, dir);
    EXPECT_EQ(r.code, code) << words;
    EXPECT_HAS(r.err, message) << words << ": " << r.err;
    EXPECT_TRUE(r.out.empty()) << r.out;
    EXPECT_FALSE(fs::exists(dir / "soft")) << words;
  };
  refused("run --out run", 73, "holds files already");
  refused("nowhere --out soft", 66, "nowhere");
  refused("run --out soft --method mean", 78, "surface");
  refused("run --out soft --set 'propagate.vote_cells_m=[0.2, 0.1]'", 78, "the edges do not ascend");
  refused("run --out soft --set scene.labels.frames=none", 65, "no training pixel carries a label");

  testkit::AnalyticSceneOptions options{.with_labels = false};
  const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene(options);
  Diagnostics diagnostics;
  SceneInfo info = scene->open(diagnostics);
  info.classes = {};
  write_packed_scene(dir / "room.sfpack", info, [&](int frame, FrameBuffer& b) { scene->read(frame, b); });
  ASSERT_EQ(semfield("train config.yaml --out plain", dir).code, 0);
  refused("plain --out soft", 65, "the run's scene has no classes");
}

}  // namespace
}  // namespace semfield
