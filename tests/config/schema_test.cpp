// The JSON schema says what the readers take: checked by a small validator on values that must and must not pass.
#include "config/schema.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <nlohmann/json.hpp>

namespace semfield {

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
  ParamDoc odd;
  odd.name = "files";
  odd.type = "texts";
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
}  // namespace semfield
