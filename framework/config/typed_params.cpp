#include "config/typed_params.h"

#include <algorithm>

namespace semfield {

int find_type(const ConfigNode& node, const std::string& path, const std::vector<std::string>& types,
              Diagnostics& diagnostics) {
  const ConfigNode* type = node.is_map() ? node.find("type") : nullptr;
  if (type == nullptr || !type->is_scalar()) {
    diagnostics.error(node.location().text(), path + ": expected a map with 'type', one of " + join(types));
    return -1;
  }
  const auto found = std::find(types.begin(), types.end(), type->text());
  if (found != types.end()) return static_cast<int>(found - types.begin());
  const std::string near = did_you_mean(type->text(), types);
  diagnostics.error(type->location().text(), path + ": no type '" + type->text() + "'; known: " + join(types),
                    near.empty() ? "" : "did you mean '" + near + "'?");
  return -1;
}

ConfigNode typed_config(const std::string& type, const Describe& describe) {
  const ConfigNode params = params_to_config(describe);
  std::vector<ConfigNode::Entry> entries{{"type", ConfigNode::make_scalar(type, false, {})}};
  entries.insert(entries.end(), params.entries().begin(), params.entries().end());
  return ConfigNode::make_map(std::move(entries), {});
}

}  // namespace semfield
