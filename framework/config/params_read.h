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
/// "room.yaml:9:21: encoder.log2_entries: expected int, got 'big'". `path` is the key path of `node` for messages. A
/// missing key keeps its default.
void read_params(const ConfigNode& node, const std::string& path, const Describe& describe, Diagnostics& diagnostics,
                 const std::vector<std::string>& other_keys = {});

/// The resolved values as a tree: every parameter, defaults included, in declaration order.
ConfigNode params_to_config(const Describe& describe);

/// One parameter, as the reference page, help and schema need it. `type` is bool, int, number, text, choice, or list of
/// int, number or text; `range` is "[1, 32]", ">= 1", "<= 5" or empty, and `limits` the same in numbers.
struct ParamDoc {
  std::string name, type, default_value, range, help;
  std::vector<std::string> choices;
  Range limits{};
};
std::vector<ParamDoc> describe_params(const Describe& describe);

/// Shortest decimal that reads back as the same double, a number to YAML 1.1 too: "64.0", "1.0e-05".
std::string shortest_number(double value);

/// "[1, 32]", ">= 1", "<= 5" or "" for messages and tables; `hide_type_limits` leaves out a bound that only says what
/// the field's type can hold.
std::string range_text(const Range& range, bool hide_type_limits);

/// Scalar readers for keys that belong to no struct; they report into `diagnostics` and return the fallback on error.
std::string read_text(const ConfigNode& parent, const std::string& path, const std::string& key,
                      const std::string& fallback, Diagnostics& diagnostics);

}  // namespace semfield
