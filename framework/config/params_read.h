// From the tree to parameter structs, with every error of a node collected.
#pragma once

#include <functional>
#include <string>
#include <vector>

#include "config/config_tree.h"
#include "config/params.h"
#include "core/error.h"

namespace semfield {

/// Anything with parameters: calls describe(visitor, params) of some struct.
using Describe = std::function<void(ParamVisitor&)>;

/// Reads the keys of `node` into the parameters. Unknown keys are errors with "did you mean" unless listed in
/// `other_keys`; wrong types, ranges and choices are errors with place, path, expected and found, e.g.
/// "room.yaml:9:21: encoder.log2_entries: expected int, got 'big'". `path` is the key path of `node` for messages. A missing key keeps its default.
void read_params(const ConfigNode& node, const std::string& path, const Describe& describe, Diagnostics& diagnostics,
                 const std::vector<std::string>& other_keys = {});

/// The resolved values as a tree: every parameter, defaults included, in declaration order.
ConfigNode params_to_config(const Describe& describe);

/// One parameter, as the reference page, help and schema need it.
struct ParamDoc {
  std::string name, type, default_value, range, help;
  std::vector<std::string> choices;
};
std::vector<ParamDoc> describe_params(const Describe& describe);

/// Scalar readers for keys that belong to no struct; they report into `diagnostics` and return the fallback on error.
std::string read_text(const ConfigNode& parent, const std::string& path, const std::string& key, const std::string& fallback,
                      Diagnostics& diagnostics);

}  // namespace semfield
