// A JSON schema of the configuration, for editors: fixed sections and plugin slots by key path.
#pragma once

#include <string>
#include <vector>

#include "config/params.h"

namespace semfield {

/// The keys of one map. `path` is its key path: "train", "train.adam", "" for the top; "passes[]" is each item of a
/// list; "passes[].semantic[?]" is a map or each item of a list.
struct SchemaSection {
  std::string path;
  std::string sentence;
  std::vector<ParamDoc> docs;
};

/// One plugin that can fill a slot.
struct SchemaAlternative {
  std::string name;
  std::string sentence;
  std::vector<ParamDoc> docs;
};

/// A map whose key `type` chooses one of `alternatives`: "scene", "passes[].sampler". Sections at or below the same
/// path
/// ("scene.labels") are allowed with every alternative.
struct SchemaChoice {
  std::string path;
  std::string sentence;
  std::vector<SchemaAlternative> alternatives;
};

/// JSON schema (draft 7), indented by two spaces. Every map refuses keys that are not listed; a slot without `type` may
/// hold keys of any alternative, since `include` or `like` can bring the type. The top also allows `include`.
std::string json_schema_of(const std::string& title, const std::vector<SchemaSection>& sections,
                           const std::vector<SchemaChoice>& choices = {});

}  // namespace semfield
