// Names of settings: what the program prints is what --set takes.
#include <gtest/gtest.h>

#include <nlohmann/json.hpp>
#include <regex>

#include "tests/program.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using nlohmann::json;
using testing_program::Result;
using testing_train::TempDir;

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
  EXPECT_NE(text.out.find("# train.ray_source is auto: where a step's rays come from"), std::string::npos);
  EXPECT_NE(text.out.find("# runtime.precision is auto: "), std::string::npos);
  EXPECT_EQ(text.out.find("runtime.memory_gb is auto"), std::string::npos);
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
    EXPECT_NE(set.err.find("unknown key 'nonsense'"), std::string::npos) << name << ": " << set.err;
  }
}

TEST_F(Names, AWrongNameIsToldWithThoseThatThereAre) {
  const Result r = run("config check " + preset("paper.yaml") + " --set passes.corse.field.depth=4");
  EXPECT_EQ(r.code, 78);
  EXPECT_NE(
      r.err.find("expected an item's name (coarse, fine) or its index (0 to 1), got 'corse'; did you mean 'coarse'?"),
      std::string::npos)
      << r.err;
}

}  // namespace
}  // namespace semfield
