// The command line's words, and what verbs print as JSON.
#include <algorithm>
#include <cstdio>
#include <fstream>
#include <nlohmann/json.hpp>
#include <regex>
#include <sstream>
#include <vector>

#include "loading/packed_scene.h"
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
  // Refused with exit code 2 and this code, with `named` among the words on stderr and nothing on stdout.
  void refused(const std::string& words, Code code, const std::string& named) {
    const Result r = run(words);
    EXPECT_EQ(r.code, 2) << words << "\n" << r.err;
    EXPECT_TRUE(r.err.ends_with(" [" + std::string(code.text()) + "]\n")) << words << "\n" << r.err;
    EXPECT_HAS(r.err, named) << words;
    EXPECT_EQ(r.out, "") << words;
  }
  // Verbs that the help of a group, or of the program, lists.
  static std::vector<std::string> verbs_in(const std::string& help) {
    std::vector<std::string> found;
    const std::string list = help.substr(std::min(help.find("\nVerbs:"), help.size()));
    const std::regex name(R"(\n  ([a-z-]+) )");
    for (auto it = std::sregex_iterator(list.begin(), list.end(), name); it != std::sregex_iterator(); ++it)
      found.push_back((*it)[1]);
    return found;
  }
  // Verbs that do something: "train", "config check".
  std::vector<std::string> verbs() {
    std::vector<std::string> out;
    for (const std::string& verb : verbs_in(run("help").out)) {
      const std::vector<std::string> below = verbs_in(run("help " + verb).out);
      if (below.empty()) out.push_back(verb);
      for (const std::string& word : below) out.push_back(verb + " " + word);
    }
    return out;
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
    const Result help = succeeded(run(asked));
    EXPECT_EQ(help.out, alone.out) << asked;
  }
  EXPECT_EQ(run("-q help").out, alone.out);
}

TEST_F(Words, HelpOfAVerbIsTheSameHoweverItIsAsked) {
  for (const char* verb : {"render", "config", "config check", "help", "check-numerics"}) {
    const Result help = succeeded(run(std::string("help ") + verb)), flag = run(std::string(verb) + " --help");
    EXPECT_EQ(flag.code, 0) << verb;
    EXPECT_EQ(help.out, flag.out) << verb;
    EXPECT_HAS(help.out, std::string("Usage: semfield ") + verb);
  }
  // Ranges, defaults and choices are stated.
  const std::string help = std::regex_replace(run("help render").out, std::regex("\n {20,}"), " ");
  EXPECT_HAS(help, "--frames N ", "(1 to 100000; default: 240)", "({test,train}; default: test)");
  EXPECT_HAS(run("--help-all").out, "--frames N ");
}

TEST_F(Words, VersionSaysWhatTheProgramIs) {
  const Result text = succeeded(run("--version")), object = run("--version --json");
  EXPECT_TRUE(std::regex_match(text.out, std::regex("semfield .*\ncompiler .*\nplugin api .*\ncpu .*\nkernels .*\n")))
      << text.out;
  EXPECT_EQ(object.code, 0);
  for (const char* key : {"\"verb\":\"version\"", "\"compiler\":", "\"cpu\":"})
    EXPECT_HAS(object.out, key) << key << " in " << object.out;
}

TEST_F(Words, AMisspelledVerbGetsASuggestion) {
  const Code unknown = "usage.verb.unknown";
  refused("trian room.yaml", unknown, "`semfield train`");
  refused("-q trian", unknown, "`semfield train`");
  refused("config chek", unknown, "`semfield config check`");
  refused("explain", unknown, "`semfield config explain`");
  refused("help config chek", unknown, "`semfield config check`");
  refused("bench chek", unknown, "`semfield config check`");
  refused("hlep train", unknown, "`semfield help`");
  refused("xyzzy", unknown, "`semfield help`");
  refused("bench xyzzy", unknown, "`semfield help bench`");
  refused("bench pairs", unknown, "studies/leave_out.py");
}

TEST_F(Words, AnUnknownFlagGetsASuggestionOrTheVerbThatItBelongsTo) {
  const Code unknown = "usage.flag.unknown";
  refused("train --thread 4 room.yaml", unknown, "--threads?");
  refused("eval --spilt=train run", unknown, "--split?");
  refused("eval --video run", unknown, "`semfield render`");
  refused("--dry-run train room.yaml", unknown, "`semfield train`");
  refused("train --xyzzy", unknown, "`semfield help train`");
  refused("eval --versoin run", unknown, "--version?");
  refused("train --thr 4 room.yaml", unknown, "--threads?");
  refused("--out x train room.yaml", unknown, "and others, and comes after the verb");
}

TEST_F(Words, WordsThatAreMissingOrTooMany) {
  refused("eval", "usage.word.missing", "RUN");
  refused("eval a b", "usage.word.unexpected", "'b'");
  refused("capture room.yaml", "usage.word.missing", "--out");
  refused("render run --panels", "usage.word.missing", "--panels");
  refused("render run --panels rgb", "usage.word.missing", "--video");
  refused("render run --npy --video", "usage.word.missing", "--npy");
  refused("--plugin", "usage.word.missing", "--plugin");
  refused("mesh run --format ply,gbl", "usage.value.invalid", "did you mean glb?");
  refused("mesh run --format ply,,glb", "usage.value.invalid", "an item between the commas is empty");
  refused("train room.yaml --steps 2.5", "usage.value.invalid", "1 to 1000000000");
  refused("render run --split tset", "usage.value.invalid", "did you mean test?");
  refused("completion zhs", "usage.value.invalid", "did you mean zsh?");
}

// A run folder may be called as a verb is.
TEST_F(Words, AnOperandIsNoVerb) {
  for (const char* words : {"eval config", "--json eval mesh", "eval --split test render", "eval -- help"}) {
    EXPECT_ENDED(run(words), 66, "there is no run folder '") << words;
  }
  // A list takes one word, and leaves the next to the operand; so does a flag that may be given several times.
  EXPECT_EQ(run("mesh --format ply,glb run").code, 66);
  EXPECT_EQ(run("eval --set runtime.threads=2 --set train.rays=64 run").code, 66);
  EXPECT_ENDED(run("--plugin none.so eval run"), 69, "none.so");
}

TEST_F(Words, WholeNumbersAreDecimal) {
  for (const char* steps : {"08", "+8"}) EXPECT_EQ(run(std::string("train none.yaml --steps ") + steps).code, 66);
}

TEST_F(Words, HelpOfAllHasTheVerbsOfGroups) {
  const std::string all = run("--help-all").out;
  for (const char* verb : {"train", "config check", "bench step"}) EXPECT_HAS(all, std::string("semfield ") + verb);
}

// Every option with a range, as its own help states it.
TEST_F(Words, NumbersOutsideTheirRangesAreRefused) {
  const std::regex row(R"(\n *(--[a-z-]+) (?:N|X|GB|PX) [^\n]*\((more than 0|\S+ to [0-9.e+]+)[;)])");
  int options = 0;
  const std::vector<std::string> all = verbs();
  EXPECT_GE(all.size(), 30u);
  for (const std::string& verb : all) {
    // One line an option: sentences are wrapped.
    const std::string help = std::regex_replace(run("help " + verb).out, std::regex("\n {20,}"), " ");
    for (auto option = std::sregex_iterator(help.begin(), help.end(), row); option != std::sregex_iterator();
         ++option) {
      ++options;
      std::vector<std::string> wrong{"-7", "nan", "inf", "x", "1e400"};
      if ((*option)[2] == "more than 0") wrong.push_back("0");
      const std::string flag = (*option)[1];
      for (const std::string& value : wrong) refused(verb + " " + flag + "=" + value, "usage.value.invalid", flag);
      refused(verb + " " + flag + "=''", "usage.word.missing", flag);
    }
  }
  EXPECT_GE(options, 14);
}

TEST_F(Words, JsonIsRefusedWhereThereIsNone) { EXPECT_REFUSED(run("help --json train"), 2, "usage.json.none"); }

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

class JsonOutput : public Words {
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
};

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
  int refusals = 0;
  for (const std::string& verb : verbs()) {
    if (tried.contains(verb) || kElsewhere.contains(verb)) continue;
    // What its operands are does not matter: it is refused before they are read.
    const std::string help = run("help " + verb).out;
    ASSERT_EQ(help.find("--json"), std::string::npos) << verb << " takes --json, and no case of this test tries it";
    const std::string usage = help.substr(help.find("Usage:"));
    std::string words;
    for (const char* operand : {" SHELL", " CONFIG", " RUN"}) {
      if (usage.find(operand) != std::string::npos) words += std::string(operand) == " SHELL" ? " bash" : " x";
    }
    refused(verb + words + " --json", "usage.json.none", verb);
    ++refusals;
  }
  EXPECT_GE(refusals, 3);
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

// What the words of the command line make: completions, a manual page, names.

namespace fs = std::filesystem;

// Completion scripts in the shells that they are for: what is offered for words as they are typed.

using GeneratedWords = std::set<std::string>;

std::string output_of(const std::string& command) {
  const std::unique_ptr<FILE, int (*)(FILE*)> pipe(popen(command.c_str(), "r"), pclose);
  std::string text;
  std::array<char, 4096> buffer{};
  while (pipe && fgets(buffer.data(), static_cast<int>(buffer.size()), pipe.get()) != nullptr) text += buffer.data();
  return text;
}

// A shell with the program's script, in a folder that has a file room.yaml and a folder runs.
class Completion : public ::testing::TestWithParam<std::string> {
 protected:
  void SetUp() override {
    shell_ = GetParam();
    if (output_of("command -v " + shell_).empty())
      GTEST_SKIP() << shell_ << " is not installed: its script was not tried";
    const testing_program::Result r = succeeded(testing_program::semfield_run("completion " + shell_, dir_.path()));
    write_file_atomic(dir_ / "script", r.out);
    fs::create_directories(dir_ / "work/runs");
    write_file_atomic(dir_ / "work/room.yaml", std::string_view(""));
    write_file_atomic(dir_ / "try.bash", std::string_view(R"(source "$1"
# As readline cuts words: at blanks and at '='.
read -ra COMP_WORDS <<<"${2//=/ = }"
[[ $2 != *' ' ]] || COMP_WORDS+=('')
COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
_semfield 2>/dev/null
printf '%s\n' "${COMPREPLY[@]}"
)"));
  }

  // What is offered where `line` ends, without what stands before "=" and the last comma.
  GeneratedWords offered(const std::string& line) {
    const std::string script = shell_word(dir_ / "script"), words = shell_word(line);
    const std::string tool =
        shell_ == "zsh" ? SEMFIELD_SOURCE_DIR "/tests/command_line/zsh_candidates.zsh" : dir_ / ("try." + shell_);
    const std::string flags = shell_ == "bash" ? " --norc " : " -f ";
    std::istringstream lines(
        output_of("cd " + shell_word(dir_ / "work") + " && HOME=" + shell_word(dir_.path()) +
                  " PATH=" + shell_word(fs::path(testing_program::program()).parent_path().string()) +
                  ":\"$PATH\" timeout 60 " + shell_ + flags + shell_word(tool) + " " + script + " " + words + " 2>&1"));
    GeneratedWords out;
    for (std::string word; std::getline(lines, word);) {
      word = word.substr(word.rfind(',') + 1);
      if (const std::size_t equals = word.find('='); word.starts_with("--") && equals != std::string::npos)
        word = word.substr(equals + 1);
      if (word.ends_with('/')) word.pop_back();
      if (!word.empty()) out.insert(word);
    }
    return out;
  }

  std::string shell_;
  TempDir dir_;
};

TEST_P(Completion, Verbs) {
  const GeneratedWords verbs = offered("semfield ");
  for (const char* verb : {"train", "config", "check-numerics", "completion", "help"})
    EXPECT_TRUE(verbs.contains(verb)) << verb;
  EXPECT_FALSE(verbs.contains("check"));
  EXPECT_EQ(offered("semfield tr"), GeneratedWords{"train"});
  EXPECT_EQ(offered("semfield config "), (GeneratedWords{"check", "diff", "explain", "schema"}));
  EXPECT_EQ(offered("semfield -q config ch"), GeneratedWords{"check"});
  EXPECT_EQ(offered("semfield --plugin x.so config ch"), GeneratedWords{"check"});
  EXPECT_EQ(offered("semfield help conf"), GeneratedWords{"config"});
}

TEST_P(Completion, Flags) {
  EXPECT_EQ(offered("semfield eval --sp"), GeneratedWords{"--split"});
  EXPECT_EQ(offered("semfield train room.yaml --dr"), GeneratedWords{"--dry-run"});
  EXPECT_EQ(offered("semfield bench step --pe"), (GeneratedWords{"--peers", "--peer-script"}));
  EXPECT_EQ(offered("semfield eval --vid"), GeneratedWords{});
  EXPECT_EQ(offered("semfield --pl"), GeneratedWords{"--plugin"});
  // --json where there is one.
  EXPECT_EQ(offered("semfield eval --js"), GeneratedWords{"--json"});
  EXPECT_EQ(offered("semfield help --js"), GeneratedWords{});
}

TEST_P(Completion, ChoicesOfValues) {
  EXPECT_EQ(offered("semfield eval runs --split "), (GeneratedWords{"test", "train"}));
  EXPECT_EQ(offered("semfield eval runs --split te"), GeneratedWords{"test"});
  EXPECT_EQ(offered("semfield eval runs --split=te"), GeneratedWords{"test"});
  EXPECT_EQ(offered("semfield train --device c"), (GeneratedWords{"cpu", "cuda"}));
  EXPECT_EQ(offered("semfield export runs --format co"), (GeneratedWords{"coco", "coco_rle"}));
  EXPECT_EQ(offered("semfield mesh runs --format g"), GeneratedWords{"glb"});
  EXPECT_EQ(offered("semfield mesh runs --format ply,g"), GeneratedWords{"glb"});
  EXPECT_EQ(offered("semfield completion "), (GeneratedWords{"bash", "zsh"}));
}

TEST_P(Completion, FilesAndFolders) {
  EXPECT_EQ(offered("semfield train "), (GeneratedWords{"room.yaml", "runs"}));
  EXPECT_EQ(offered("semfield config check roo"), GeneratedWords{"room.yaml"});
  EXPECT_EQ(offered("semfield eval "), GeneratedWords{"runs"});
  EXPECT_EQ(offered("semfield train --out r"), GeneratedWords{"runs"});
  EXPECT_EQ(offered("semfield inspect room.yaml --frusta roo"), GeneratedWords{"room.yaml"});
  EXPECT_EQ(offered("semfield render runs --trajectory r"), (GeneratedWords{"room.yaml", "runs"}));
  EXPECT_EQ(offered("semfield render runs --trajectory sm"), GeneratedWords{"smooth"});
  EXPECT_EQ(offered("semfield train --steps "), GeneratedWords{});
}

INSTANTIATE_TEST_SUITE_P(Shells, Completion, ::testing::Values("bash", "zsh"),
                         [](const auto& tried) { return tried.param; });

// The manual page has nothing that its reader complains about.
TEST(Man, PageHasNoWarnings) {
  const TempDir dir;
  const std::string page = dir / "semfield.1", out = dir / "out";
  const std::string make = SEMFIELD_SOURCE_DIR "/packaging/manual_page ";
  ASSERT_EQ(std::system((make + shell_word(testing_program::program()) + " 1.0.0 >" + shell_word(page)).c_str()), 0);
  EXPECT_HAS(read_text_file(page), "\\-\\-frames N");
  if (output_of("command -v man").empty()) GTEST_SKIP() << "man is not installed: no page was formatted by it";
  EXPECT_EQ(output_of("man -l --warnings " + shell_word(page) + " 2>&1 >" + shell_word(out)), "");
  EXPECT_HAS(read_text_file(out), "--frames N");
}

// Names of settings: what the program prints is what --set takes.

std::string preset(const char* name) { return shell_word(SEMFIELD_SOURCE_DIR "/configs/" + std::string(name)); }

class Names : public ::testing::Test {
 protected:
  Result run(const std::string& words) { return testing_program::semfield_run(words, dir_.path()); }
  json explained(const std::string& words) {
    const Result r = succeeded(run("config explain --json " + words));
    return r.code == 0 ? json::parse(r.out).at("settings") : json::array();
  }
  TempDir dir_;
};

TEST_F(Names, EveryKeyThatExplainPrintsCanBeSetBack) {
  for (const char* name : {"quickstart.yaml", "paper.yaml"}) {
    const json before = explained(preset(name));
    EXPECT_GT(before.size(), 100u) << name;
    std::string set;
    int named = 0;
    for (const json& setting : before) {
      const std::string key = setting.at("key"), value = setting.at("value");
      named += key.starts_with("passes.main.") || key.starts_with("passes.coarse.") ? 1 : 0;
      EXPECT_FALSE(std::regex_search(key, std::regex(R"(^passes\.[0-9])"))) << key;
      set += " --set " + shell_word(key + "=" + value);
    }
    EXPECT_GT(named, 5) << name;
    const json after = explained(preset(name) + set);
    ASSERT_EQ(after.size(), before.size()) << name;
    for (std::size_t i = 0; i < before.size(); ++i) {
      EXPECT_EQ(after[i].at("key"), before[i].at("key"));
      EXPECT_EQ(after[i].at("value"), before[i].at("value")) << before[i].at("key");
      EXPECT_EQ(after[i].at("from").get<std::string>().find("--set " + before[i].at("key").get<std::string>()), 0u)
          << before[i].at("key") << ": " << after[i].at("from");
    }
  }
}

TEST_F(Names, DifferencesSetTheOneAsTheOther) {
  const std::string other =
      " --set passes.main.position.levels=12 --set passes.main.semantic.few.dropout=0.3 --set "
      "train.rays=500 --set passes.main.sampler.max_samples=32";
  const json before = explained(preset("quickstart.yaml")), after = explained(preset("quickstart.yaml") + other);
  write_file_atomic(dir_ / "b.yaml", "include: " + std::string(SEMFIELD_SOURCE_DIR) +
                                         "/configs/quickstart.yaml\nname: quickstart\ntrain: {rays: 500}\n");
  const Result r = succeeded(run("config diff --json " + preset("quickstart.yaml") + " b.yaml"));
  std::string set;
  const json parsed = json::parse(r.out);
  for (const json& d : parsed.at("differences")) {
    if (d.at("key") == "base_dir") continue;
    set += " --set " + shell_word(d.at("key").get<std::string>() + "=" + d.at("b").get<std::string>());
  }
  EXPECT_EQ(set, " --set train.rays=500");
  const Result text = succeeded(run("config explain " + preset("quickstart.yaml") + set));
  EXPECT_HAS(text.out, "# train.ray_source is auto: where a step's rays come from", "# runtime.precision is auto: ");
  EXPECT_LACKS(text.out, "runtime.memory_gb is auto");
  // By index or by name, the same settings.
  const json by_index = explained(preset("quickstart.yaml") +
                                  " --set passes.0.position.levels=12 --set passes.0.semantic.1.dropout=0.3 --set "
                                  "train.rays=500 --set passes.0.sampler.max_samples=32");
  ASSERT_EQ(by_index.size(), after.size());
  int changed = 0;
  for (std::size_t i = 0; i < after.size(); ++i) {
    EXPECT_EQ(by_index[i].at("key"), after[i].at("key"));
    EXPECT_EQ(by_index[i].at("value"), after[i].at("value")) << after[i].at("key");
    changed += before[i].at("value") != after[i].at("value") ? 1 : 0;
  }
  EXPECT_EQ(changed, 4);
}

// What was chosen and left out, and why, with the key that changes it.
TEST_F(Names, KeysOfNotesCanBeSet) {
  const Result r = succeeded(run("train --dry-run " + preset("quickstart.yaml") +
                                 " --set scene.frames=20 --set scene.width_px=64 "
                                 "--set scene.height_px=48"));
  const std::string text = r.out + r.err;
  const std::regex key(R"((passes\.[A-Za-z0-9_.]*[a-z0-9_]))");
  std::set<std::string> keys;
  for (auto it = std::sregex_iterator(text.begin(), text.end(), key); it != std::sregex_iterator(); ++it)
    keys.insert((*it)[1]);
  EXPECT_GE(keys.size(), 2u) << text;
  for (const std::string& name : keys) {
    const Result set = run("config check " + preset("quickstart.yaml") + " --set " + name + ".nonsense=1");
    // The place is there: what is wrong is the key below it.
    EXPECT_EQ(set.code, 78) << name;
    EXPECT_HAS(set.err, "unknown key 'nonsense'") << name << ": " << set.err;
  }
}

TEST_F(Names, AWrongNameIsToldWithThoseThatThereAre) {
  EXPECT_ENDED(run("config check " + preset("paper.yaml") + " --set passes.corse.field.depth=4"), 78,
               "expected an item's name (coarse, fine) or its index (0 to 1), got 'corse'; did you mean 'coarse'?");
}

}  // namespace
}  // namespace semfield
