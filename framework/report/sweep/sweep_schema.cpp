// A JSON schema of sweep files.
#include "report/sweep/sweep_schema.h"

#include <nlohmann/json.hpp>

namespace semfield {

namespace {

using Json = nlohmann::ordered_json;

Json described(Json schema, const char* sentence) {
  schema["description"] = sentence;
  return schema;
}

// An unquoted number or bool is read as text where text is asked for.
Json text(const char* sentence) {
  return described({{"type", Json::array({"string", "number", "boolean"})}}, sentence);
}
Json number(const char* sentence) { return described({{"type", "number"}}, sentence); }
Json list(Json items, const char* sentence) {
  return described({{"type", "array"}, {"items", std::move(items)}}, sentence);
}
Json closed_map(Json properties, const char* sentence) {
  return described({{"type", Json::array({"object", "null"})},
                    {"properties", std::move(properties)},
                    {"additionalProperties", false}},
                   sentence);
}
Json named_maps(Json each, const char* sentence) {
  return described({{"type", "object"}, {"minProperties", 1}, {"additionalProperties", std::move(each)}}, sentence);
}
Json overrides(const char* sentence) { return described({{"type", Json::array({"object", "null"})}}, sentence); }

Json scene_schema() {
  return closed_map({{"base", text("configuration of this scene, instead of the sweep's")},
                     {"set", overrides("key paths and values, before the sweep's and the variant's own")},
                     {"after", overrides("key paths and values, after the variant's own")},
                     {"pack", {{"type", "boolean"}, {"description", "all cells read one packed copy"}}}},
                    "a scene");
}

Json variant_schema() {
  const Json method =
      described({{"enum", Json::array({"monocular", "bayesian", "average"})}}, "how views are combined");
  const Json fuse =
      closed_map({{"method", method}, {"field", text("variant whose field gives the depth; else the true depth")}},
                 "fuse labels over views instead of training");
  return closed_map({{"base", text("configuration instead of the scene's")},
                     {"set", overrides("key paths and values of this row")},
                     {"x", number("abscissa of the plot")},
                     {"paper", number("the paper's figure")},
                     {"fuse", fuse},
                     {"objects", text("variant in whose run objects are found instead of training")}},
                    "a row of the table");
}

}  // namespace

std::string sweep_schema() {
  const Json path{{"type", "string"}};
  const Json seed{{"type", "integer"}, {"minimum", 0}, {"maximum", 4294967295}};
  const Json values{{"type", "array"}, {"minItems", 1}};
  const Json properties{
      {"name", text("of the experiment, its folder and files; default: the file's name")},
      {"title", text("of table and plot")},
      {"note", text("sentences above the table")},
      {"split", described({{"enum", Json::array({"test", "train"})}}, "whose frames are scored; default: test")},
      {"metrics", list(path,
                       "columns, by their names in metrics.jsonl, training_... and given_... of training frames; the "
                       "first is plotted")},
      {"paper", text("what the paper's figures are")},
      {"x_label", text("of the plot")},
      {"base", text("configuration that every cell starts from")},
      {"set", overrides("key paths and values for every cell, before the variant's own")},
      {"scenes", named_maps(scene_schema(), "scenes by name; without them the base's own")},
      {"use_scenes", list(path, "only these of them")},
      {"seeds", list(seed, "each goes to runtime.seed and scene.labels.seed")},
      {"variants", named_maps(variant_schema(), "rows by name")},
      {"grid", named_maps(values, "instead of variants: key paths to lists of values, every combination a row")},
      {"sweeps", list(path, "instead of all that: such files; the other keys are merged over each")},
      {"include", described({{"oneOf", Json::array({path, Json{{"type", "array"}, {"items", path}}})}},
                            "sweep files to start from, relative to this one; later ones win")}};
  Json schema{{"$schema", "http://json-schema.org/draft-07/schema#"}, {"title", "Semfield sweep"}, {"type", "object"}};
  schema["properties"] = properties;
  schema["additionalProperties"] = false;
  return schema.dump(2) + "\n";
}

}  // namespace semfield
