// What the grammar of the command line makes: completions, manual pages, names.
#include <cstdio>
#include <fstream>
#include <nlohmann/json.hpp>
#include <regex>
#include <sstream>

#include "tests/program.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using nlohmann::json;
using namespace testing_program;

// Completion scripts in the shells that they are for: what is offered for words as they are typed.

using Words = std::set<std::string>;

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
    const testing_program::Result r = testing_program::semfield_run("completion " + shell_, dir_.path());
    ASSERT_EQ(r.code, 0) << r.err;
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
    write_file_atomic(dir_ / "try.fish",
                      std::string_view("source $argv[1]; complete -C $argv[2] | string split -f 1 \\t\n"));
  }

  // What is offered where `line` ends, without what stands before "=" and the last comma.
  Words offered(const std::string& line) {
    const std::string script = shell_word(dir_ / "script"), words = shell_word(line);
    const std::string tool =
        shell_ == "zsh" ? SEMFIELD_SOURCE_DIR "/tests/command_line/zsh_candidates.zsh" : dir_ / ("try." + shell_);
    const std::string flags = shell_ == "bash" ? " --norc " : shell_ == "zsh" ? " -f " : " --no-config ";
    std::istringstream lines(
        output_of("cd " + shell_word(dir_ / "work") + " && HOME=" + shell_word(dir_.path()) +
                  " PATH=" + shell_word(fs::path(testing_program::program()).parent_path().string()) +
                  ":\"$PATH\" timeout 60 " + shell_ + flags + shell_word(tool) + " " + script + " " + words + " 2>&1"));
    Words out;
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
  const Words verbs = offered("semfield ");
  for (const char* verb : {"train", "config", "check-numerics", "completion", "help"})
    EXPECT_TRUE(verbs.contains(verb)) << verb;
  EXPECT_FALSE(verbs.contains("check"));
  EXPECT_EQ(offered("semfield tr"), Words{"train"});
  EXPECT_EQ(offered("semfield config "), (Words{"check", "diff", "explain", "schema"}));
  EXPECT_EQ(offered("semfield -q config ch"), Words{"check"});
  EXPECT_EQ(offered("semfield --plugin x.so config ch"), Words{"check"});
  EXPECT_EQ(offered("semfield help conf"), Words{"config"});
}

TEST_P(Completion, Flags) {
  EXPECT_EQ(offered("semfield eval --sp"), Words{"--split"});
  EXPECT_EQ(offered("semfield train room.yaml --dr"), Words{"--dry-run"});
  EXPECT_EQ(offered("semfield bench step --pe"), (Words{"--peers", "--peer-script"}));
  EXPECT_EQ(offered("semfield eval --vid"), Words{});
  EXPECT_EQ(offered("semfield --pl"), Words{"--plugin"});
  // --json where there is one.
  EXPECT_EQ(offered("semfield eval --js"), Words{"--json"});
  EXPECT_EQ(offered("semfield help --js"), Words{});
}

TEST_P(Completion, ChoicesOfValues) {
  EXPECT_EQ(offered("semfield eval runs --split "), (Words{"test", "train"}));
  EXPECT_EQ(offered("semfield eval runs --split te"), Words{"test"});
  EXPECT_EQ(offered("semfield eval runs --split=te"), Words{"test"});
  EXPECT_EQ(offered("semfield train --device c"), (Words{"cpu", "cuda"}));
  EXPECT_EQ(offered("semfield export runs --format co"), (Words{"coco", "coco_rle"}));
  EXPECT_EQ(offered("semfield mesh runs --format g"), Words{"glb"});
  EXPECT_EQ(offered("semfield mesh runs --format ply,g"), Words{"glb"});
  EXPECT_EQ(offered("semfield completion "), (Words{"bash", "fish", "zsh"}));
}

TEST_P(Completion, FilesAndFolders) {
  EXPECT_EQ(offered("semfield train "), (Words{"room.yaml", "runs"}));
  EXPECT_EQ(offered("semfield config check roo"), Words{"room.yaml"});
  EXPECT_EQ(offered("semfield eval "), Words{"runs"});
  EXPECT_EQ(offered("semfield train --out r"), Words{"runs"});
  EXPECT_EQ(offered("semfield inspect room.yaml --frusta roo"), Words{"room.yaml"});
  EXPECT_EQ(offered("semfield render runs --trajectory r"), (Words{"room.yaml", "runs"}));
  EXPECT_EQ(offered("semfield render runs --trajectory sm"), Words{"smooth"});
  EXPECT_EQ(offered("semfield train --steps "), Words{});
}

INSTANTIATE_TEST_SUITE_P(Shells, Completion, ::testing::Values("bash", "zsh", "fish"),
                         [](const auto& tried) { return tried.param; });

TEST(CompletionVerb, UnknownShell) {
  const TempDir dir;
  const testing_program::Result r = testing_program::semfield_run("completion zhs", dir.path());
  EXPECT_EQ(r.code, 2);
  EXPECT_EQ(r.err, "semfield: SHELL zhs: expected bash, zsh or fish; did you mean zsh? [usage.value.invalid]\n");
}

// Manual pages: one per verb, and nothing that their readers complain about.

bool installed(const char* program) {
  return std::system(("command -v " + std::string(program) + " >/dev/null").c_str()) == 0;
}

TEST(Man, PageOfAVerbHasItsWords) {
  const TempDir dir;
  const Result page = semfield_run("help --man render", dir.path(), "SOURCE_DATE_EPOCH=86400 ");
  ASSERT_EQ(page.code, 0) << page.err;
  EXPECT_EQ(page.out.find(".TH SEMFIELD\\-RENDER 1 \"1970-01-02\" \"Semfield "), 0u) << page.out;
  for (const char* part :
       {".SH NAME\nsemfield\\-render \\-\nrender colour", ".SH SYNOPSIS\n.B semfield render\nRUN [OPTIONS]\n",
        ".SH OPERANDS\n.TP\n.I RUN\n", ".BI \\-\\-frames \" N\"\n", "(1 to 100000; default: 240)",
        ".SH SEE ALSO\n.BR semfield (1)\n"})
    EXPECT_HAS(page.out, part) << part << " in\n" << page.out;
  const Result whole = semfield_run("help --man", dir.path());
  EXPECT_HAS(whole.out, ".TP\n.BR semfield\\-render (1)\n", ".SH EXIT STATUS\n.TP\n.B 0\ndone\n");
  EXPECT_EQ(semfield_run("help --man rendr", dir.path()).err,
            "semfield: there is no verb 'rendr'; did you mean `semfield render`? [usage.verb.unknown]\n");
  EXPECT_EQ(semfield_run("help --man render --out all", dir.path()).code, 2);
}

class ManPages : public ::testing::Test {
 protected:
  void SetUp() override {
    const Result r = semfield_run("help --man --out all", dir_.path());
    ASSERT_EQ(r.code, 0) << r.err;
    for (const auto& entry : fs::directory_iterator(dir_ / "all")) pages_.push_back(entry.path().string());
    EXPECT_GE(pages_.size(), 25u);
    EXPECT_TRUE(fs::exists(dir_ / "all/semfield.1"));
    EXPECT_TRUE(fs::exists(dir_ / "all/semfield-config-check.1"));
  }
  // What the command prints of any page; nothing is expected.
  void expect_silence(const std::string& command) {
    for (const std::string& page : pages_) {
      const std::string out = dir_ / "out";
      EXPECT_EQ(std::system((command + " " + shell_word(page) + " >" + shell_word(out) + " 2>&1").c_str()), 0) << page;
      EXPECT_EQ(read_text_file(out), "") << page;
    }
  }
  TempDir dir_;
  std::vector<std::string> pages_;
};

TEST_F(ManPages, ManHasNoWarnings) {
  if (!installed("man")) GTEST_SKIP() << "man is not installed: no page was formatted by it";
  for (const std::string& page : pages_) {
    const std::string out = dir_ / "out", err = dir_ / "err";
    const int status = std::system(
        ("man -l --warnings " + shell_word(page) + " >" + shell_word(out) + " 2>" + shell_word(err)).c_str());
    EXPECT_EQ(status, 0) << page;
    EXPECT_EQ(read_text_file(err), "") << page;
    EXPECT_GT(read_text_file(out).size(), 200u) << page;
  }
}

TEST_F(ManPages, MandocHasNothingToSay) {
  if (!installed("mandoc")) GTEST_SKIP() << "mandoc is not installed: no page was checked by it";
  expect_silence("mandoc -T lint");
}

// Names of settings: what the program prints is what --set takes.

std::string preset(const char* name) { return shell_word(SEMFIELD_SOURCE_DIR "/configs/" + std::string(name)); }

class Names : public ::testing::Test {
 protected:
  Result run(const std::string& words) { return testing_program::semfield_run(words, dir_.path()); }
  json explained(const std::string& words) {
    const Result r = run("config explain --json " + words);
    EXPECT_EQ(r.code, 0) << r.err.substr(0, 2000);
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
  const Result r = run("config diff --json " + preset("quickstart.yaml") + " b.yaml");
  ASSERT_EQ(r.code, 0) << r.err;
  std::string set;
  const json parsed = json::parse(r.out);
  for (const json& d : parsed.at("differences")) {
    if (d.at("key") == "base_dir") continue;
    set += " --set " + shell_word(d.at("key").get<std::string>() + "=" + d.at("b").get<std::string>());
  }
  EXPECT_EQ(set, " --set train.rays=500");
  const Result text = run("config explain " + preset("quickstart.yaml") + set);
  EXPECT_EQ(text.code, 0);
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
  const Result r = run("train --dry-run " + preset("quickstart.yaml") +
                       " --set scene.frames=20 --set scene.width_px=64 "
                       "--set scene.height_px=48");
  ASSERT_EQ(r.code, 0) << r.err;
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
  const Result r = run("config check " + preset("paper.yaml") + " --set passes.corse.field.depth=4");
  EXPECT_EQ(r.code, 78);
  EXPECT_HAS(r.err,
             "expected an item's name (coarse, fine) or its index (0 to 1), got 'corse'; did you mean 'coarse'?");
}

}  // namespace
}  // namespace semfield
