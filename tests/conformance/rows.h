// Which settings each registered plugin is tested with.
#pragma once

#include <ostream>

#include "plugin/registry.h"
#include "testkit/laws.h"

namespace semfield::testkit {

/// Every plugin that this build links.
const Registry& linked_registry();

struct Row {
  PluginKind kind = PluginKind::encoder;
  std::string name;
  Device device = Device::cpu;
  int number = 0;  ///< which of the plugin's settings
  Settings settings;
  std::string text() const;  ///< "encoder_hash_grid_cpu_0"
};

std::ostream& operator<<(std::ostream& out, const Row& row);

/// Rows of one kind on a device: entry x settings. Settings are the lines "name=value name=value" of `conformance.txt`
/// in the plugin's folder; without it, the defaults.
std::vector<Row> rows_of(PluginKind kind, Device device = Device::cpu);

}  // namespace semfield::testkit
