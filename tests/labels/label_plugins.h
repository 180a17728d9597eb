// Label readers and degradations of the registry, with the parameters of a YAML map.
#pragma once

#include "config/config_tree.h"
#include "config/params.h"
#include "labels/label_files.h"
#include "plugin/loader.h"
#include "plugin/registry.h"

namespace semfield::testing_labels {

inline const Registry& linked_registry() {
  static const Registry registry = [] {
    Registry filled;
    register_linked_plugins(filled);
    return filled;
  }();
  return registry;
}

/// Parameters of `entry` as the YAML map gives them; every error is thrown.
inline std::unique_ptr<PluginParams> params_from(const PluginEntry& entry, const std::string& yaml) {
  std::unique_ptr<PluginParams> params = entry.new_params();
  Diagnostics found;
  read_params(
      parse_config_text(yaml, "test.yaml"), entry.name, [&](ParamVisitor& visit) { params->describe(visit); }, found);
  params->validate(found);
  found.throw_if_errors(ErrorKind::config, "parameters:");
  return params;
}

inline std::unique_ptr<LabelReader> make_reader(const std::string& type, const std::string& yaml) {
  const PluginEntry& entry = linked_registry().get(PluginKind::label_reader, type);
  return entry.label_reader(*params_from(entry, yaml));
}

inline std::unique_ptr<Degradation> make_degradation(const std::string& type, const std::string& yaml = "{}") {
  const PluginEntry& entry = linked_registry().get(PluginKind::degradation, type);
  return entry.degradation(*params_from(entry, yaml));
}

}  // namespace semfield::testing_labels
