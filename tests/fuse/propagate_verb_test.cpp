// `semfield propagate` as a user runs it: its line, JSON, files that train again, the same bytes for any threads,
// refusals.
#include <gtest/gtest.h>

#include <filesystem>
#include <nlohmann/json.hpp>

#include "loading/packed_scene.h"
#include "system/files.h"
#include "testkit/analytic_scene.h"
#include "tests/program.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using namespace testing_train;
using nlohmann::json;
using testing_program::Result;

Result semfield(const std::string& words, const TempDir& dir) {
  return testing_program::semfield_run(words, dir.path());
}

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
  EXPECT_NE(line.out.find("accuracy=1.0000->0."), std::string::npos) << line.out;
  EXPECT_NE(line.out.find(" folder=soft\n"), std::string::npos) << line.out;
  EXPECT_NE(line.err.find("propagate.cell_m is 0."), std::string::npos) << line.err;

  const json m = manifest_of(dir / "soft");
  EXPECT_EQ(m["steps"][0]["type"], "propagation");
  EXPECT_EQ(m["steps"][1]["type"], "propagate surface");
  EXPECT_EQ(m["frames"].size(), 9u);
  EXPECT_EQ(m["total"]["labelled_px"], 9 * 48 * 36);
  EXPECT_GT(m["total"]["accuracy"].get<double>(), 0.6);  // the field has seen 200 steps
  EXPECT_NE(m["config"].get<std::string>().find("propagate:"), std::string::npos);

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
    EXPECT_NE(r.err.find(message), std::string::npos) << words << ": " << r.err;
    EXPECT_TRUE(r.out.empty()) << r.out;
    EXPECT_FALSE(fs::exists(dir / "soft")) << words;
  };
  refused("run --out run", 73, "holds files already");
  refused("nowhere --out soft", 66, "nowhere");
  refused("run --out soft --method mean", 78, "surface");
  refused("run --out soft --set 'propagate.vote_cells_m=[0.2, 0.1]'", 78, "the edges do not ascend");
  refused("run --out soft --set 'propagate.vote_cells_m=[]'", 78, "no edge is given");
  refused("run --out soft --set scene.labels.frames=none", 65, "no training pixel carries a label");

  testkit::AnalyticSceneOptions options;
  options.with_labels = false;
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
