// The command line's words, and what verbs print as JSON.
#include <algorithm>
#include <nlohmann/json.hpp>
#include <regex>
#include <sstream>
#include <vector>

#include "core/error.h"
#include "loading/packed_scene.h"
#include "system/files.h"
#include "testkit/analytic_scene.h"
#include "tests/program.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_program;

// Verbs and flags as they are typed: what is listed, what is refused, and what is suggested instead.

class Words : public ::testing::Test {
 protected:
  Result run(const std::string& words) { return testing_program::semfield_run(words, dir_.path()); }
  // Refused with exit code 2, with this on stderr and nothing on stdout.
  void refused(const std::string& words, Code code, const std::string& sentence) {
    const Result r = run(words);
    EXPECT_EQ(r.code, 2) << words << "\n" << r.err;
    EXPECT_EQ(r.err, "semfield: " + sentence + " [" + code.text() + "]\n") << words;
    EXPECT_EQ(r.out, "") << words;
  }
  TempDir dir_;
};

TEST_F(Words, WithoutAVerbTheVerbsAreListed) {
  const Result alone = run("");
  EXPECT_EQ(alone.code, 2);
  EXPECT_EQ(alone.err, "");
  EXPECT_HAS(alone.out, "\n  train  ");
  const Result group = run("config");
  EXPECT_EQ(group.code, 2);
  EXPECT_HAS(group.out, "\nVerbs:\n  check  ");
  for (const char* asked : {"help", "--help", "-h"}) {
    const Result help = run(asked);
    EXPECT_EQ(help.code, 0) << asked;
    EXPECT_EQ(help.out, alone.out) << asked;
  }
  EXPECT_EQ(run("-q help").out, alone.out);
}

TEST_F(Words, HelpOfAVerbIsTheSameHoweverItIsAsked) {
  for (const char* verb : {"render", "config", "config check", "help", "check-numerics"}) {
    const Result help = run(std::string("help ") + verb), flag = run(std::string(verb) + " --help");
    EXPECT_EQ(help.code, 0) << verb;
    EXPECT_EQ(flag.code, 0) << verb;
    EXPECT_EQ(help.out, flag.out) << verb;
    EXPECT_EQ(help.out.find(std::string("Usage: semfield ") + verb), 0u) << help.out;
  }
  // Ranges, defaults and choices are stated.
  const std::string render = run("help render").out;
  for (const char* part : {"--frames N", "(1 to 100000; default: 240)", "(default: test)", "-q, --quiet"})
    EXPECT_HAS(render, part) << part << " in\n" << render;
}

// Verbs that the help of a group, or of the program, lists.
std::vector<std::string> verbs_of(const std::string& help, const std::string& group) {
  static const std::regex row("\\n  ([a-z-]+) ");
  const std::size_t list = std::min(help.find("\nVerbs:"), help.size());
  std::vector<std::string> out;
  for (std::sregex_iterator it(help.begin() + static_cast<std::ptrdiff_t>(list), help.end(), row), end; it != end; ++it)
    out.push_back(group + (*it)[1].str());
  return out;
}

TEST_F(Words, NoOptionSaysItsDefaultTwice) {
  std::vector<std::string> verbs = verbs_of(run("help").out, "");
  for (std::size_t i = 0; i < verbs.size(); ++i) {
    const std::string verb = verbs[i], text = run("help " + verb).out;
    for (const std::string& word : verbs_of(text, verb + " ")) verbs.push_back(word);
    std::size_t begin = 0;
    while (begin < text.size()) {  // an option, with the lines that belong to it
      const std::size_t end = std::min(text.find("--", begin + 1), text.size());
      const std::string option = text.substr(begin, end - begin);
      const std::size_t first = option.find("default: ");
      EXPECT_TRUE(first == std::string::npos || option.find("default: ", first + 1) == std::string::npos) << option;
      begin = end;
    }
  }
  EXPECT_GT(verbs.size(), 20u);
}

TEST_F(Words, VersionSaysWhatTheProgramIs) {
  const Result text = run("--version"), object = run("--version --json");
  EXPECT_EQ(text.code, 0);
  EXPECT_TRUE(std::regex_match(text.out, std::regex("semfield .*\ncompiler .*\nplugin api .*\ncpu .*\nkernels .*\n")))
      << text.out;
  EXPECT_EQ(object.code, 0);
  for (const char* key : {"\"verb\":\"version\"", "\"compiler\":", "\"cpu\":"})
    EXPECT_HAS(object.out, key) << key << " in " << object.out;
}

TEST_F(Words, AMisspelledVerbGetsASuggestion) {
  refused("trian room.yaml", "usage.verb.unknown", "there is no verb 'trian'; did you mean `semfield train`?");
  refused("-q trian", "usage.verb.unknown", "there is no verb 'trian'; did you mean `semfield train`?");
  refused("config chek", "usage.verb.unknown", "there is no verb 'config chek'; did you mean `semfield config check`?");
  refused("explain", "usage.verb.unknown", "there is no verb 'explain'; did you mean `semfield config explain`?");
  refused("help config chek", "usage.verb.unknown",
          "there is no verb 'config chek'; did you mean `semfield config check`?");
  refused("xyzzy", "usage.verb.unknown", "there is no verb 'xyzzy'; `semfield help` lists the verbs");
  refused("bench xyzzy", "usage.verb.unknown", "there is no verb 'bench xyzzy'; `semfield help bench` lists the verbs");
}

TEST_F(Words, AnUnknownFlagGetsASuggestionOrTheVerbThatItBelongsTo) {
  refused("train --thread 4 room.yaml", "usage.flag.unknown", "train has no flag --thread; did you mean --threads?");
  refused("eval --spilt=train run", "usage.flag.unknown", "eval has no flag --spilt; did you mean --split?");
  refused("eval -split train run", "usage.flag.unknown", "eval has no flag -split; did you mean --split?");
  refused("eval --video run", "usage.flag.unknown", "eval has no flag --video; it belongs to `semfield render`");
  refused("eval run --viddeo", "usage.flag.unknown",
          "eval has no flag --viddeo; did you mean --video of `semfield render`?");
  refused("--dry-run train room.yaml", "usage.flag.unknown",
          "no verb before the flag --dry-run; it belongs to `semfield train` or `semfield sweep`, and comes after "
          "the verb");
  refused("train --xyzzy", "usage.flag.unknown", "train has no flag --xyzzy; see `semfield help train`");
  refused("eval --vers run", "usage.flag.unknown", "eval has no flag --vers; did you mean --version?");
}

TEST_F(Words, WordsThatAreMissingOrTooMany) {
  refused("eval", "usage.word.missing", "eval: RUN is required; see `semfield help eval`");
  refused("eval a b", "usage.word.unexpected", "unexpected word 'b': the usage is `semfield eval RUN [OPTIONS]`");
  refused("capture room.yaml", "usage.word.missing", "capture: --out is required; see `semfield help capture`");
  refused("render run --panels", "usage.word.missing",
          "render: --panels: its value is missing; see `semfield help render`");
  refused("--plugin", "usage.word.missing", "--plugin: its value is missing; see `semfield help`");
  refused("mesh run --format ply,,glb", "usage.value.invalid",
          "--format ply,,glb: an item between the commas is empty");
  refused("render run --split tset", "usage.value.invalid", "--split tset: expected test or train; did you mean test?");
}

// A run folder may be called as a verb is.
TEST_F(Words, AnOperandIsNoVerb) {
  for (const char* words : {"eval config", "--json eval mesh", "eval --split test render", "eval -- help"}) {
    const Result r = run(words);
    EXPECT_EQ(r.code, 66) << words;
    EXPECT_HAS(r.err, "there is no run folder '");
  }
  // A list takes one word, and leaves the next to the operand; so does a flag that may be given several times.
  EXPECT_EQ(run("mesh --format ply,glb run").code, 66);
  EXPECT_EQ(run("eval --set runtime.threads=2 --set train.rays=64 run").code, 66);
  const Result plugin = run("--plugin none.so eval run");
  EXPECT_EQ(plugin.code, 69) << plugin.err;
  EXPECT_HAS(plugin.err, "none.so");
}

// Every option with a range, as its own help states it.
TEST_F(Words, NumbersOutsideTheirRangesAreRefused) {
  const std::regex row(R"(    (--[a-z-]+) (N|X|GB)\b)"), range(R"(\((-?[0-9.e+]+) to (-?[0-9.e+]+)[;)])");
  int options = 0;
  std::vector<std::string> verbs;
  const auto verbs_of = [&](const std::string& help) {
    std::vector<std::string> found;
    const std::string list = help.substr(std::min(help.find("\nVerbs:"), help.size()));
    const std::regex name(R"(\n  ([a-z-]+) )");
    for (auto it = std::sregex_iterator(list.begin(), list.end(), name); it != std::sregex_iterator(); ++it)
      found.push_back((*it)[1]);
    return found;
  };
  for (const std::string& verb : verbs_of(run("help").out)) {
    const std::vector<std::string> below = verbs_of(run("help " + verb).out);
    if (below.empty()) verbs.push_back(verb);
    for (const std::string& word : below) verbs.push_back(verb + " " + word);
  }
  EXPECT_GE(verbs.size(), 30u);
  for (const std::string& verb : verbs) {
    // One line an option: sentences are wrapped.
    const std::string help = std::regex_replace(run("help " + verb).out, std::regex("\n {28}"), " ");
    std::istringstream lines(help);
    for (std::string line; std::getline(lines, line);) {
      std::smatch option, bounds;
      if (!std::regex_search(line, option, row)) continue;
      if (line.find("runtime.") != std::string::npos || line.find("train.steps") != std::string::npos) continue;
      if (line.find("what is free") != std::string::npos && verb == "train") continue;  // a setting, checked as such
      ++options;
      const bool positive = line.find("(more than 0") != std::string::npos;
      ASSERT_TRUE(positive || std::regex_search(line, bounds, range)) << verb << ": " << line;
      std::vector<std::string> wrong{"-1", "nan", "inf", "x", "''", "1e400"};
      if (positive) wrong.push_back("0");
      for (const std::string& value : wrong) {
        const Result r = run(verb + " " + option[1].str() + "=" + value);
        EXPECT_EQ(r.code, 2) << verb << " " << option[1] << " " << value;
        EXPECT_HAS(r.err, option[1].str());
      }
      const std::string expected = positive ? "a positive number" : bounds[1].str() + " to " + bounds[2].str();
      const Result r = run(verb + " " + option[1].str() + " -7");
      EXPECT_EQ(r.code, 2) << verb;
      EXPECT_EQ(r.err, "semfield: " + option[1].str() + " -7: expected " + expected + " [usage.value.invalid]\n")
          << verb;
    }
  }
  EXPECT_GE(options, 14);
}

TEST_F(Words, JsonIsRefusedWhereThereIsNone) {
  const Result r = run("help --json train");
  EXPECT_EQ(r.code, 2);
  EXPECT_EQ(r.err.find("semfield: help takes no --json; these verbs do: "), 0u) << r.err;
  EXPECT_HAS(r.err, "eval");
}

// --json of every verb: one object with the keys that all have, or a refusal.

using namespace testing_train;
using nlohmann::json;

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

// These measure for long, or need a device, the shipped room, a module or COLMAP; serve is tried below, prepare by
// tests/capture, objects by tests/objects.
const std::set<std::string> kElsewhere{"bench gpu",     "bench step", "serve",   "demo",
                                       "plugins check", "prepare",    "objects", "view"};

class JsonOutput : public ::testing::Test {
 protected:
  void SetUp() override {
    testkit::AnalyticSceneOptions options{.with_depth = true};
    const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene(options);
    Diagnostics diagnostics;
    const SceneInfo info = scene->open(diagnostics);
    write_packed_scene(dir_ / "room.sfpack", info, [&](int frame, FrameBuffer& buffer) { scene->read(frame, buffer); });
    std::string yaml =
        with_scene(hash_config("report: {eval_every_s: 0, strips: 0}\n"), "{type: packed, file: room.sfpack}");
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
    EXPECT_HAS(r.err, verb + " takes no --json; these verbs do: ");
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
    for (const std::string& key : c.keys) EXPECT_HAS(keys, "`" + key + "`") << verb << " " << key;
  }
  for (const std::string& verb : kElsewhere) EXPECT_HAS(page, "\n| `" + verb + "` |") << verb;
}

}  // namespace
}  // namespace semfield
