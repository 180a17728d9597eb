// A JSON schema of the configuration, for editors: fixed sections and plugin slots by key path.
#pragma once

#include <string>
#include <vector>

#include "config/params.h"

namespace semfield {

/// The keys of one map, `path` being its key path: "train", "train.adam", "" for the top; "passes[]" is each item of a
/// list. With `alternatives` ("scene", "passes[].sampler") the map's key `type` chooses one of them by its `path`, and
/// sections at or below the same path ("scene.labels") are allowed with every alternative.
struct SchemaSection {
  std::string path;
  std::string sentence;
  std::vector<ParamDoc> params = {};
  bool or_list = false;  ///< a list of such maps may stand there too
  std::vector<SchemaSection> alternatives = {};
};

/// JSON schema (draft 7), indented by two spaces. Every map refuses keys that are not listed; a slot without `type` may
/// hold keys of any alternative, since `include` or `like` can bring the type. The top also allows `include`.
std::string json_schema_of(const std::string& title, const std::vector<SchemaSection>& sections);

}  // namespace semfield
