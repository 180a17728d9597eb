// A JSON schema of the configuration, from the same descriptions that read it.
#include "config/schema.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <nlohmann/json.hpp>
#include <string_view>

#include "core/check.h"

namespace semfield {
namespace {

using Json = nlohmann::ordered_json;

/// The map at one key path: what stands in it, and the maps below.
struct SchemaNode {
  std::string key;
  bool is_list = false;      // the maps are the items of a list
  bool may_be_list = false;  // or the map stands alone
  std::string sentence;
  const std::vector<ParamDoc>* docs = nullptr;
  const std::vector<SchemaSection>* alternatives = nullptr;
  std::vector<SchemaNode> children;
};

SchemaNode& node_at(SchemaNode& root, const std::string& path) {
  SchemaNode* node = &root;
  for (std::size_t begin = 0; begin < path.size();) {
    const std::size_t end = std::min(path.find('.', begin), path.size());
    std::string key = path.substr(begin, end - begin);
    const bool is_list = key.ends_with("[]");
    if (is_list) key.resize(key.size() - 2);
    SEMFIELD_CHECK(!key.empty(), "empty key in schema path '" + path + "'");
    SchemaNode* child = nullptr;
    for (SchemaNode& known : node->children) {
      if (known.key == key) child = &known;
    }
    if (child == nullptr) {
      node->children.push_back({});
      child = &node->children.back();
      child->key = key;
      child->is_list = is_list;
    }
    SEMFIELD_CHECK(child->is_list == is_list, "schema path '" + path + "' is a list here and a map elsewhere");
    node = child;
    begin = end + 1;
  }
  return *node;
}

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
  if (type == "list") return {{"type", "array"}, {"minItems", 1}};
  if (type == "map") return {{"type", Json::array({"object", "null"})}};
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

// What "*" stands for is allowed under any name, and stands there once at least.
Json closed_map(Json properties) {
  Json others = properties.value("*", Json(false));
  const bool any_name = properties.erase("*") > 0;
  Json map{{"type", "object"}, {"properties", std::move(properties)}, {"additionalProperties", std::move(others)}};
  if (any_name) map["minProperties"] = 1;
  return map;
}

Json choice_schema(const SchemaNode& node, const Json& shared) {
  Json alternatives = Json::array();
  Json any_key = shared;
  for (const SchemaSection& alternative : *node.alternatives) {
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

Json node_schema(const SchemaNode& node) {
  Json properties = Json::object();
  if (node.docs != nullptr) add_params(properties, *node.docs);
  for (const SchemaNode& child : node.children) properties[child.key] = node_schema(child);
  Json map;
  if (node.alternatives != nullptr) {
    map = choice_schema(node, properties);
  } else {
    map = closed_map(std::move(properties));
    if (!node.is_list) map["type"] = Json::array({"object", "null"});  // a section with every line commented out
  }
  if (node.is_list) map = Json{{"type", "array"}, {"items", std::move(map)}};
  if (node.may_be_list) map = Json{{"oneOf", Json::array({map, Json{{"type", "array"}, {"items", map}}})}};
  if (!node.sentence.empty()) map["description"] = node.sentence;
  return map;
}

}  // namespace

std::string json_schema_of(const std::string& title, const std::vector<SchemaSection>& sections) {
  SchemaNode root;
  for (const SchemaSection& section : sections) {
    SchemaNode& node = node_at(root, section.path);
    const bool known = section.alternatives.empty() ? node.docs != nullptr : node.alternatives != nullptr;
    SEMFIELD_CHECK(!known, "schema path '" + section.path + "' is described twice");
    if (section.alternatives.empty()) {
      node.docs = &section.params;
    } else {
      node.alternatives = &section.alternatives;
    }
    node.may_be_list = node.may_be_list || section.or_list;
    if (!section.sentence.empty()) node.sentence = section.sentence;
  }
  Json schema{{"$schema", "http://json-schema.org/draft-07/schema#"}, {"title", title}};
  schema.update(node_schema(root));
  const Json file{{"type", "string"}};
  schema["properties"]["include"] = {
      {"description", "config files to start from, relative to this one; later ones win"},
      {"oneOf", Json::array({file, Json{{"type", "array"}, {"items", file}}})}};
  return schema.dump(2) + "\n";
}

}  // namespace semfield
