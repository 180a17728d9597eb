// What is shown of parameters: the JSON schema, and explanations of a key.
#include "config/schema.h"

#include <algorithm>
#include <array>
#include <nlohmann/json.hpp>

#include "config/compose.h"
#include "config/explain.h"
#include "config_testing.h"

namespace semfield {

// The JSON schema says what the readers take: checked by a small validator on values that must and must not pass.

enum class Mode { linear, smoothstep };
template <>
struct ChoiceNames<Mode> {
  static constexpr std::array<std::string_view, 2> names{"linear", "smoothstep"};
};

namespace {

using nlohmann::json;

struct GridParams {
  int levels = 16;
  Mode mode = Mode::smoothstep;
  double growth = 1.5;
  std::vector<double> betas{0.9};
};
void describe(ParamVisitor& visit, GridParams& p) {
  SEMFIELD_PARAM(visit, p, levels, "L, number of resolutions", {1, 32});
  SEMFIELD_PARAM(visit, p, mode, "Weights");
  SEMFIELD_PARAM(visit, p, growth, "b", {1});
  SEMFIELD_PARAM(visit, p, betas, "Decay", {0, 1});
}
struct RootParams {
  std::string root = "010";
  bool dense = true;
  std::vector<std::string> files;
};
void describe(ParamVisitor& visit, RootParams& p) {
  SEMFIELD_PARAM(visit, p, root, "Folder");
  SEMFIELD_PARAM(visit, p, dense, "Dense");
  SEMFIELD_PARAM(visit, p, files, "Files");
}

template <class Params>
std::vector<ParamDoc> docs_of() {
  Params params;
  return describe_params([&](ParamVisitor& visit) { describe(visit, params); });
}

json schema() {
  return json::parse(
      json_schema_of("test",
                     {{"train", "how long", docs_of<RootParams>()},
                      {"train.grid", "", docs_of<GridParams>()},
                      {"scene.labels", "", docs_of<RootParams>()}},
                     {{"scene",
                       "the dataset",
                       {{"replica", "Rendered rooms", docs_of<RootParams>()}, {"grid", "", docs_of<GridParams>()}}},
                      {"passes[].encoder", "", {{"hash_grid", "", docs_of<GridParams>()}}},
                      {"passes[].branch[?].encoder", "", {{"hash_grid", "", docs_of<GridParams>()}}}}));
}

bool has_type(const json& value, const std::string& type) {
  if (type == "integer") return value.is_number_integer();
  if (type == "number") return value.is_number();
  if (type == "null") return value.is_null();
  if (type == "string") return value.is_string();
  if (type == "boolean") return value.is_boolean();
  if (type == "array") return value.is_array();
  return type == "object" && value.is_object();
}

/// The words of draft 7 that the schema uses.
bool valid(const json& value, const json& rule) {
  for (const auto& [word, what] : rule.items()) {
    if (word == "type") {
      bool any = false;
      for (const json& type : what.is_array() ? what : json::array({what})) any = any || has_type(value, type);
      if (!any) return false;
    } else if (word == "minimum" || word == "maximum") {
      if (value.is_number() && (word == "minimum" ? value < what : value > what)) return false;
    } else if (word == "enum") {
      if (std::find(what.begin(), what.end(), value) == what.end()) return false;
    } else if (word == "const") {
      if (value != what) return false;
    } else if (word == "items") {
      for (const json& item : value) {
        if (value.is_array() && !valid(item, what)) return false;
      }
    } else if (word == "properties") {
      for (const auto& [key, child] : what.items()) {
        if (value.is_object() && value.contains(key) && !valid(value[key], child)) return false;
      }
    } else if (word == "additionalProperties") {
      EXPECT_EQ(what, false);
      if (!value.is_object()) continue;
      for (const auto& [key, child] : value.items()) {
        if (!rule["properties"].contains(key)) return false;
      }
    } else if (word == "required") {
      for (const json& key : what) {
        if (value.is_object() && !value.contains(key)) return false;
      }
    } else if (word == "oneOf") {
      int matches = 0;
      for (const json& one : what) matches += valid(value, one) ? 1 : 0;
      if (matches != 1) return false;
    } else if (word != "$schema" && word != "title" && word != "description" && word != "default") {
      ADD_FAILURE() << "a word the test does not know: " << word;
    }
  }
  return true;
}

TEST(Schema, TakesWhatTheReadersTake) {
  const json rule = schema();
  for (const char* text :
       {R"({})", R"({"include": "a.yaml"})", R"({"include": ["a.yaml", "b.yaml"]})",
        R"({"train": {"root": "x", "dense": false, "files": ["a"], "grid": {"levels": 32, "growth": 1.0}}})",
        R"({"train": null})", R"({"train": {"root": 10}})",
        R"({"train": {"grid": {"mode": "linear", "betas": [0, 1]}}})",
        R"({"scene": {"type": "replica", "root": "x", "labels": {"root": "y"}}})",
        R"({"scene": {"type": "grid", "levels": 2, "labels": {}}})", R"({"scene": {"root": "x", "levels": 3}})",
        R"({"passes": [{"encoder": {"type": "hash_grid", "levels": 4}}, {}]})",
        R"({"passes": [{"branch": {"encoder": {"type": "hash_grid", "levels": 4}}}, {"branch": null}]})",
        R"({"passes": [{"branch": [{"encoder": {"type": "hash_grid", "levels": 4}}, {}]}]})"}) {
    EXPECT_TRUE(valid(json::parse(text), rule)) << text;
  }
}

TEST(Schema, RefusesWhatTheReadersRefuse) {
  const json rule = schema();
  for (const char* text : {R"([])",
                           R"({"trian": {}})",
                           R"({"include": 3})",
                           R"({"train": {"rooot": "x"}})",
                           R"({"train": {"dense": "no"}})",
                           R"({"train": {"files": "a"}})",
                           R"({"train": {"grid": {"levels": 33}}})",
                           R"({"train": {"grid": {"levels": 0}}})",
                           R"({"train": {"grid": {"levels": 1.5}}})",
                           R"({"train": {"grid": {"growth": 0.5}}})",
                           R"({"train": {"grid": {"mode": "cubic"}}})",
                           R"({"train": {"grid": {"betas": [2]}}})",
                           R"({"train": {"grid": {"betas": 0.5}}})",
                           R"({"scene": {"type": "replika"}})",
                           R"({"scene": {"type": "replica", "levels": 2}})",
                           R"({"scene": {"type": "grid", "labels": {"x": 1}}})",
                           R"({"scene": {"nothing": 1}})",
                           R"({"passes": {}})",
                           R"({"passes": [{"encoder": {"type": "hash_grid", "n": 4}}]})",
                           R"({"passes": [{"branch": [{"encodr": {}}]}]})",
                           R"({"passes": [{"branch": {"encoder": {"type": "hash_grid", "n": 4}}}]})",
                           R"({"passes": [{"encodr": {}}]})"}) {
    EXPECT_FALSE(valid(json::parse(text), rule)) << text;
  }
}

TEST(Schema, RefusesDescriptionsThatMakeNoSense) {
  ParamDoc odd{.name = "files", .type = "texts"};
  const auto made_of = [](const std::vector<SchemaSection>& sections) {
    try {
      json_schema_of("test", sections);
    } catch (const Error& error) {
      return error.kind() == ErrorKind::internal ? "internal" : "another kind";
    }
    return "nothing was thrown";
  };
  EXPECT_STREQ(made_of({{"train", "", {odd}}}), "internal");
  EXPECT_STREQ(made_of({{"train", "", {}}, {"train", "", {}}}), "internal");
  EXPECT_STREQ(made_of({{"passes[]", "", {}}, {"passes.x", "", {}}}), "internal");
  odd.type = "list of text";
  EXPECT_STREQ(made_of({{"train", "", {odd}}}), "nothing was thrown");
}

TEST(Schema, CarriesSentencesAndDefaults) {
  const json rule = schema();
  const json& train = rule["properties"]["train"];
  EXPECT_EQ(rule["title"], "test");
  EXPECT_EQ(train["description"], "how long");
  EXPECT_EQ(train["properties"]["root"]["default"], "010");
  EXPECT_EQ(train["properties"]["dense"]["default"], true);
  EXPECT_EQ(train["properties"]["files"]["default"], json::array());
  const json& grid = train["properties"]["grid"]["properties"];
  EXPECT_EQ(
      grid["levels"],
      json::parse(
          R"({"type": "integer", "minimum": 1, "maximum": 32, "description": "L, number of resolutions", "default": 16})"));
  EXPECT_EQ(grid["growth"], json::parse(R"({"type": "number", "minimum": 1, "description": "b", "default": 1.5})"));
  EXPECT_EQ(grid["mode"]["default"], "smoothstep");
  EXPECT_EQ(grid["betas"]["default"], json::parse("[0.9]"));
  EXPECT_EQ(rule["properties"]["scene"]["oneOf"][0]["description"], "Rendered rooms");
}

}  // namespace

// Explaining where values come from, and what differs between two configs.

std::string diff(const std::string& a, const std::string& b) {
  return diff_config(parse_config_text(a, "a.yaml"), parse_config_text(b, "b.yaml"));
}

TEST(Explain, EveryValueWithItsOrigin) {
  const TempDir folder;
  const std::string base = folder.write("base.yaml", "train:\n  steps: 10\n  betas: [0.9, 0.999]\nlabels: {}\n");
  const std::string room =
      folder.write("room.yaml", "include: base.yaml\ntrain:\n  rate: 0.1\npasses:\n  - name: größe\n");
  const std::string text = explain_config(compose_config(room, {"train.steps=20", "train.betas.1=0.99"}));
  EXPECT_EQ(text,
            "train:\n"
            "  steps: 20           # --set train.steps=20\n"
            "  betas: [0.9, 0.99]  # " +
                base +
                ":3:10, --set train.betas.1=0.99\n"
                "  rate: 0.1           # " +
                room +
                ":3:9\n"
                "labels: {}            # " +
                base +
                ":4:9\n"
                "passes:\n"
                "  - name: \"größe\"     # " +
                room + ":5:11\n");
  EXPECT_TRUE(
      equal_config(parse_config_text(text, "again"), compose_config(room, {"train.steps=20", "train.betas.1=0.99"})));
}

TEST(Explain, DefaultsAndOddOrigins) {
  const ConfigNode tree = ConfigNode::make_map({{"a", ConfigNode::make_scalar("1", false, {})},
                                                {"b", parse_config_value("'x\n\n  y'", "--set b='x\n\n  y'")},
                                                {"long", ConfigNode::make_scalar(std::string(90, 'x'), false, {})}},
                                               {});
  const std::string text = explain_config(tree);
  EXPECT_EQ(text,
            "a: 1       # default\nb: \"x\\ny\"  # --set b='x    y'\nlong: " + std::string(90, 'x') + "  # default\n");
  EXPECT_TRUE(equal_config(parse_config_text(text, "again"), tree));
}

TEST(Explain, DefaultsBesideWhatWasWritten) {
  const ConfigNode written =
      parse_config_text("train: {rate: 1e-3}\npasses:\n  - name: x\nreport:\nextra: 1\n", "a.yaml");
  const ConfigNode resolved =
      parse_config_value("{train: {steps: 10, rate: 0.001}, passes: [{name: x, n: 2}], report: {strips: 4}}", "");
  EXPECT_EQ(explain_config(with_origins(resolved, written)),
            "train:\n"
            "  steps: 10   # default\n"
            "  rate: 1e-3  # a.yaml:1:15\n"
            "passes:\n"
            "  - name: x   # a.yaml:3:11\n"
            "    n: 2      # default\n"
            "report:\n"
            "  strips: 4   # default\n"
            "extra: 1      # a.yaml:5:8\n");
}

TEST(Diff, NothingDiffers) {
  EXPECT_EQ(diff("a: 1\nb: {c: word}\n", "# moved\nb:\n  c: 'word'\na: 1\n"), "");
  EXPECT_EQ(diff("", ""), "");
  EXPECT_EQ(diff("a: []\nb: {}", "b: {}\na: []"), "");
}

TEST(Diff, OnlyDifferencesByPath) {
  EXPECT_EQ(
      diff("train: {steps: 10, rate: 0.1, betas: [0.9, 0.99]}", "train: {steps: 20, rate: 0.1, betas: [0.9, 0.999]}"),
      "train.steps: 10 -> 20\ntrain.betas: [0.9, 0.99] -> [0.9, 0.999]\n");
  EXPECT_EQ(diff("a: 1", "a: '1'"), "a: 1 -> \"1\"\n");
  EXPECT_EQ(diff("a: 0.1", "a: 0.10"), "a: 0.1 -> 0.10\n");
  EXPECT_EQ(diff("passes: [{name: x, n: 1}]", "passes: [{name: x, n: 2}]"), "passes.x.n: 1 -> 2\n");
  // An index where the names differ: both sides take it.
  EXPECT_EQ(diff("passes: [{name: x, n: 1}]", "passes: [{name: y, n: 2}]"),
            "passes.0.name: x -> y\npasses.0.n: 1 -> 2\n");
}

TEST(Diff, WhatOneSideLacks) {
  EXPECT_EQ(diff("a: 1\nb: {c: 2, d: {e: 3}}\n", "a: 1\nf: [1]\n"),
            "b.c: 2 -> (absent)\nb.d.e: 3 -> (absent)\nf: (absent) -> [1]\n");
  EXPECT_EQ(diff("passes: [{n: 1}]", "passes: [{n: 1}, {n: 2, m: {}}]"),
            "passes.1.n: (absent) -> 2\npasses.1.m: (absent) -> {}\n");
  EXPECT_EQ(diff("passes: [{n: 1}, x]", "passes: []"), "passes.0.n: 1 -> (absent)\npasses.1: x -> (absent)\n");
  EXPECT_EQ(diff("a: {b: 1}", "a: 2"), "a: {b: 1} -> 2\n");
  EXPECT_EQ(diff("a: {b: 1}", "a: {}"), "a.b: 1 -> (absent)\n");
  EXPECT_EQ(diff("[1]", "[2]"), "(top): [1] -> [2]\n");
}
}  // namespace semfield
