// A JSON schema of the configuration, from the same descriptions that read it.
#include "config/schema.h"

#include <cmath>
#include <cstdint>
#include <nlohmann/json.hpp>
#include <string_view>

#include "core/check.h"

namespace semfield {
namespace {

using Json = nlohmann::ordered_json;

// A value of the tree as JSON; the declared type says whether a word is a text.
Json value_json(const ConfigNode& node, std::string_view type) {
  if (node.is_list()) {
    Json list = Json::array();
    const std::string_view item_type = type.starts_with("list of ") ? type.substr(8) : type;
    for (const ConfigNode& item : node.items()) list.push_back(value_json(item, item_type));
    return list;
  }
  if (type == "bool") return node.text() == "true";
  if (type == "int" || type == "number") return Json::parse(node.text());
  return node.text();
}

Json limits_json(const Range& limits) {
  Json out = Json::object();
  const auto bound = [](double value) -> Json {
    if (value == std::floor(value) && std::fabs(value) < 1e15) return static_cast<std::int64_t>(value);
    return value;
  };
  if (std::isfinite(limits.min)) out["minimum"] = bound(limits.min);
  if (std::isfinite(limits.max)) out["maximum"] = bound(limits.max);
  return out;
}

Json value_schema(std::string_view type, const Range& limits) {
  if (type == "bool") return {{"type", "boolean"}};
  if (type == "int" || type == "number") {
    Json out{{"type", type == "int" ? "integer" : "number"}};
    out.update(limits_json(limits));
    return out;
  }
  if (type.starts_with("list of ")) return {{"type", "array"}, {"items", value_schema(type.substr(8), limits)}};
  SEMFIELD_CHECK(type == "text", "no parameter type '" + std::string(type) + "' (see ParamDoc)");
  // An unquoted number or bool is read as text where text is asked for.
  return {{"type", Json::array({"string", "number", "boolean"})}};
}

Json param_schema(const ParamDoc& doc) {
  Json out = doc.type == "choice" ? Json{{"enum", doc.choices}} : value_schema(doc.type, doc.limits);
  if (!doc.help.empty()) out["description"] = doc.help;
  if (!doc.default_value.empty()) out["default"] = value_json(parse_config_text(doc.default_value, doc.name), doc.type);
  return out;
}

void add_params(Json& properties, const std::vector<ParamDoc>& docs) {
  for (const ParamDoc& doc : docs) properties[doc.name] = param_schema(doc);
}

Json closed_map(Json properties) {
  return {{"type", "object"}, {"properties", std::move(properties)}, {"additionalProperties", false}};
}

Json choice_schema(const std::vector<SchemaSection>& choices, const Json& shared) {
  Json alternatives = Json::array();
  Json any_key = shared;
  for (const SchemaSection& alternative : choices) {
    Json properties{{"type", {{"const", alternative.path}}}};
    add_params(properties, alternative.params);
    properties.update(shared);
    Json map = closed_map(std::move(properties));
    map["title"] = alternative.path;
    if (!alternative.sentence.empty()) map["description"] = alternative.sentence;
    map["required"] = Json::array({"type"});
    alternatives.push_back(std::move(map));
    for (const ParamDoc& doc : alternative.params) {
      if (!any_key.contains(doc.name)) any_key[doc.name] = Json::object();
    }
  }
  Json partial = closed_map(std::move(any_key));  // without the key 'type', so it never matches beside another one
  partial["title"] = "type from an include or like";
  alternatives.push_back(std::move(partial));
  return {{"oneOf", std::move(alternatives)}};
}

// The map at `path`: what sections of this path say of it, and the maps below.
Json map_schema(const std::vector<SchemaSection>& sections, const std::string& path) {
  Json below = Json::object();
  const SchemaSection *docs = nullptr, *choice = nullptr;
  std::string sentence;
  bool may_be_list = false;
  const std::string prefix = path.empty() ? "" : path + ".";
  for (const SchemaSection& section : sections) {
    if (section.path == path) {
      const SchemaSection*& place = section.alternatives.empty() ? docs : choice;
      SEMFIELD_CHECK(place == nullptr, "schema path '" + path + "' is described twice");
      place = &section;
      may_be_list = may_be_list || section.or_list;
      if (!section.sentence.empty()) sentence = section.sentence;
    } else if (section.path.starts_with(prefix)) {
      const std::string child = section.path.substr(0, section.path.find('.', prefix.size()));
      const bool is_list = child.ends_with("[]");
      const std::string key = child.substr(prefix.size(), child.size() - prefix.size() - (is_list ? 2 : 0));
      SEMFIELD_CHECK(!key.empty(), "empty key in schema path '" + section.path + "'");
      if (!below.contains(key)) below[key] = map_schema(sections, child);
      SEMFIELD_CHECK((below[key].value("type", Json()) == "array") == is_list,
                     "schema path '" + section.path + "' is a list here and a map elsewhere");
    }
  }
  Json properties = Json::object();
  if (docs != nullptr) add_params(properties, docs->params);
  properties.update(below);
  Json map = choice != nullptr ? choice_schema(choice->alternatives, properties) : closed_map(std::move(properties));
  if (choice == nullptr && !path.ends_with("[]"))
    map["type"] = Json::array({"object", "null"});  // a section with every line commented out
  if (path.ends_with("[]")) map = Json{{"type", "array"}, {"items", std::move(map)}};
  if (may_be_list) map = Json{{"oneOf", Json::array({map, Json{{"type", "array"}, {"items", map}}})}};
  if (!sentence.empty()) map["description"] = sentence;
  return map;
}

}  // namespace

std::string json_schema_of(const std::string& title, const std::vector<SchemaSection>& sections) {
  Json schema{{"$schema", "http://json-schema.org/draft-07/schema#"}, {"title", title}};
  schema.update(map_schema(sections, ""));
  const Json file{{"type", "string"}};
  schema["properties"]["include"] = {
      {"description", "config files to start from, relative to this one; later ones win"},
      {"oneOf", Json::array({file, Json{{"type", "array"}, {"items", file}}})}};
  return schema.dump(2) + "\n";
}

}  // namespace semfield
