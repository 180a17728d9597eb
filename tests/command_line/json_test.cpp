// --json of every verb: one object with the keys that all have, or a refusal.
#include <gtest/gtest.h>

#include <filesystem>
#include <map>
#include <memory>
#include <nlohmann/json.hpp>
#include <regex>
#include <set>

#include "loading/packed_scene.h"
#include "testkit/analytic_scene.h"
#include "tests/program.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using namespace testing_train;
using nlohmann::json;
using testing_program::Result;

struct Case {
  std::string words;              ///< behind the verb
  std::vector<std::string> keys;  ///< beside `semfield` and `verb`
  int code = 0;
};

// Everything that takes --json, in an order in which a run is there when it is needed.
const std::vector<std::pair<std::string, Case>>& cases() {
  static const std::vector<std::pair<std::string, Case>> all{
      {"config check", {"config.yaml", {"config", "errors"}}},
      {"config explain", {"config.yaml", {"settings"}}},
      {"inspect", {"config.yaml", {"scene", "frames", "bounds", "classes", "findings"}}},
      {"init", {"room.sfpack --out init.yaml", {"file", "type", "others", "downscale"}}},
      {"train", {"config.yaml --steps 200 --out run", {"run", "step", "train_s", "values", "report"}}},
      {"config diff", {"config.yaml run/run.yaml", {"differences"}}},
      {"eval", {"run", {"run", "split", "step", "miou_present", "per_class_iou", "confusion", "per_frame"}}},
      {"render", {"run --out images", {"run", "step", "frames", "s_per_frame", "width_px", "height_px", "folder"}}},
      {"report", {"run", {"runs", "file"}}},
      {"sweep", {"sweep.yaml --dry-run --out swept", {"folder", "planned"}}},
      {"mesh", {"run --resolution 24", {"run", "vertices", "faces", "files"}}},
      {"capture", {"config.yaml --out captured", {"frames", "bytes", "folder"}}},
      {"pack", {"config.yaml --out again.sfpack", {"frames", "bytes", "file"}}},
      {"degrade", {"config.yaml --out degraded", {"frames", "labelled_px", "accuracy", "folder"}}},
      {"fuse", {"config.yaml --method bayesian", {"scores"}}},
      {"propagate", {"run --out spread", {"method", "labelled_share", "accuracy", "folder"}}},
      {"export", {"run --out labels.json", {"run", "frames", "shapes", "format", "out"}}},
      {"classes", {"nyu13", {"classes"}}},
      {"runs equal", {"run run", {"equal", "step", "tensors"}}},
      {"plugins list", {"", {"plugins"}}},
      {"plugins show", {"hash_grid", {"plugins"}}},
      {"check-numerics", {"--only A01", {"passed", "failed", "cases", "rows"}}},
  };
  return all;
}

// These measure for long, or need a device, the shipped room or a module; serve is tried below.
const std::set<std::string> kElsewhere{"bench gpu", "bench step", "serve", "demo", "plugins check"};

class JsonOutput : public ::testing::Test {
 protected:
  void SetUp() override {
    testkit::AnalyticSceneOptions options;
    options.with_depth = true;
    const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene(options);
    Diagnostics diagnostics;
    const SceneInfo info = scene->open(diagnostics);
    write_packed_scene(dir_ / "room.sfpack", info, [&](int frame, FrameBuffer& buffer) { scene->read(frame, buffer); });
    std::string yaml = hash_config("report: {eval_every_s: 0, strips: 0}\n");
    yaml.replace(yaml.find("{type: analytic_room}"), 21, "{type: packed, file: room.sfpack}");
    write_file_atomic(dir_ / "config.yaml", yaml);
    write_file_atomic(dir_ / "sweep.yaml",
                      std::string_view("name: tried\nbase: config.yaml\ngrid: {train.rays: [64, 128]}\n"));
  }
  Result run(const std::string& words) { return testing_program::semfield_run(words, dir_.path()); }
  TempDir dir_;
};

std::vector<std::string> verbs_of(const std::string& help) {
  std::vector<std::string> found;
  const std::string list = help.substr(std::min(help.find("\nVerbs:"), help.size()));
  const std::regex name(R"(\n  ([a-z-]+) )");
  for (auto it = std::sregex_iterator(list.begin(), list.end(), name); it != std::sregex_iterator(); ++it)
    found.push_back((*it)[1]);
  return found;
}

TEST_F(JsonOutput, EveryVerbPrintsOneObjectOrRefuses) {
  const std::string version = json::parse(run("--version --json").out).at("semfield");
  std::set<std::string> tried;
  for (const auto& [verb, c] : cases()) {
    const Result r = run(verb + " " + c.words + " --json -q");
    EXPECT_EQ(r.code, c.code) << verb << ": " << r.err;
    ASSERT_TRUE(json::accept(r.out)) << verb << ": " << r.out;
    EXPECT_EQ(r.out.find('\n'), r.out.size() - 1) << verb;
    const json object = json::parse(r.out);
    ASSERT_TRUE(object.is_object()) << verb;
    EXPECT_EQ(r.out.find("{\"semfield\":\"" + version + "\",\"verb\":\"" + verb + "\""), 0u) << r.out.substr(0, 80);
    for (const std::string& key : c.keys) EXPECT_TRUE(object.contains(key)) << verb << " has no " << key;
    tried.insert(verb);
  }
  int refused = 0;
  std::vector<std::string> verbs;
  for (const std::string& verb : verbs_of(run("help").out)) {
    const std::vector<std::string> below = verbs_of(run("help " + verb).out);
    if (below.empty()) verbs.push_back(verb);
    for (const std::string& word : below) verbs.push_back(verb + " " + word);
  }
  for (const std::string& verb : verbs) {
    if (tried.contains(verb) || kElsewhere.contains(verb)) continue;
    // What its operands are does not matter: it is refused before they are read.
    const std::string help = run("help " + verb).out;
    ASSERT_EQ(help.find("--json"), std::string::npos) << verb << " takes --json, and no case of this test tries it";
    const std::string usage = help.substr(0, help.find('\n'));
    std::string words;
    for (const char* operand : {" SHELL", " CONFIG", " RUN"}) {
      if (usage.find(operand) != std::string::npos) words += std::string(operand) == " SHELL" ? " bash" : " x";
    }
    const Result r = run(verb + words + " --json");
    EXPECT_EQ(r.code, 2) << verb;
    EXPECT_NE(r.err.find(verb + " takes no --json; these verbs do: "), std::string::npos) << r.err;
    EXPECT_EQ(r.out, "") << verb;
    ++refused;
  }
  EXPECT_GE(refused, 3);
}

TEST_F(JsonOutput, WhatDiffersIsTold) {
  ASSERT_EQ(run("train config.yaml --steps 5 --out a").code, 0);
  ASSERT_EQ(run("train config.yaml --steps 5 --out b --set runtime.seed=7").code, 0);
  const Result r = run("runs equal a b --json");
  EXPECT_EQ(r.code, 1);
  EXPECT_EQ(json::parse(r.out).at("equal"), false);
  EXPECT_NE(json::parse(r.out).at("difference"), "");
  const Result error = run("eval nowhere --json");
  EXPECT_EQ(error.code, 66);
  EXPECT_EQ(error.out, "");
}

TEST_F(JsonOutput, ServeTellsItsAddress) {
  testing_program::Process serve(testing_program::program(),
                                 {"serve", dir_ / "config.yaml", "--json", "-q", "--out", dir_ / "labelled"},
                                 dir_.path());
  std::string out;
  for (int i = 0; i < 1200 && out.find('\n') == std::string::npos; ++i) {
    if (serve.wait_for(0.05)) GTEST_SKIP() << "this build has no labelling page";
    out = read_text_file(dir_ / "stdout");
  }
  ASSERT_TRUE(json::accept(out)) << out;
  EXPECT_EQ(json::parse(out).at("verb"), "serve");
  EXPECT_EQ(json::parse(out).at("url").get<std::string>().find("http://127.0.0.1:"), 0u) << out;
  serve.send(SIGINT);
  EXPECT_EQ(serve.wait().code, 130);
}

// The keys that the page names are those that verbs print.
TEST_F(JsonOutput, ThePageNamesEveryVerbThatTakesIt) {
  const std::string page = read_text_file(std::string(SEMFIELD_SOURCE_DIR) + "/docs/reference/json.md");
  for (const auto& [verb, c] : cases()) {
    const std::size_t row = page.find("\n| `" + verb + "` |");
    ASSERT_NE(row, std::string::npos) << verb << " is not in docs/reference/json.md";
    const std::string keys = page.substr(row, page.find('\n', row + 1) - row);
    for (const std::string& key : c.keys)
      EXPECT_NE(keys.find("`" + key + "`"), std::string::npos) << verb << " " << key;
  }
  for (const std::string& verb : kElsewhere) {
    EXPECT_NE(page.find("\n| `" + verb + "` |"), std::string::npos) << verb;
  }
}

}  // namespace
}  // namespace semfield
