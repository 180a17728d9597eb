// Things that a configuration chooses by `type`, with parameters of their own: read, written and documented alike.
#pragma once

#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "config/config_tree.h"
#include "config/params_read.h"
#include "core/error.h"

namespace semfield {

/// A type that may be named. Item has describe(ParamVisitor&) and validate(Diagnostics&) const.
template <class Item>
struct TypeOf {
  std::string_view type, sentence;
  std::unique_ptr<Item> (*make)();
};

/// Place of the kind that `node` names under `type`, or -1 and an error; with "did you mean".
int find_type(const ConfigNode& node, const std::string& path, const std::vector<std::string>& types,
              Diagnostics& diagnostics);

/// An item of `kinds` (of TypeOf<Item>, or derived from it) with its parameters read; null with an error when the type
/// is none. Errors of parameters and of their relations go to `diagnostics`.
template <class Item, class Kind>
std::unique_ptr<Item> read_typed(const ConfigNode& node, const std::string& path, const std::vector<Kind>& kinds,
                                 std::string& type_out, Diagnostics& diagnostics) {
  std::vector<std::string> types;
  for (const Kind& kind : kinds) types.emplace_back(kind.type);
  const int found = find_type(node, path, types, diagnostics);
  if (found < 0) return nullptr;
  std::unique_ptr<Item> item = kinds[static_cast<std::size_t>(found)].make();
  const int errors = diagnostics.error_count();
  read_params(node, path, [&](ParamVisitor& visit) { item->describe(visit); }, diagnostics, {"type"});
  if (diagnostics.error_count() == errors) {
    Diagnostics relations;
    item->validate(relations);
    for (const Diagnostic& finding : relations.all()) {
      const std::string message = path + (finding.where.empty() ? "" : "." + finding.where) + ": " + finding.message;
      diagnostics.error(node.location().text(), message, finding.remedy);
    }
  }
  type_out = types[static_cast<std::size_t>(found)];
  return item;
}

/// {type, every parameter}.
ConfigNode typed_config(const std::string& type, const Describe& describe);

}  // namespace semfield
