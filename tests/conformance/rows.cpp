// Rows from the registry and the settings files.
#include "tests/conformance/rows.h"

#include <filesystem>

#include "plugin/loader.h"

namespace semfield::testkit {

namespace {

std::vector<Settings> settings_for(PluginKind kind, const std::string& name) {
  const std::string source = SEMFIELD_SOURCE_DIR;
  const std::string own = std::string(kind_folder(kind)) + "/" + name + "/conformance.txt";
  std::vector<Settings> rows;
  for (const std::string& file : {source + "/plugins/" + own, source + "/framework/" + own}) {
    if (!std::filesystem::exists(file)) continue;
    for (SettingsLine& line : read_settings_lines(file)) rows.push_back(std::move(line.settings));
  }
  if (rows.empty()) rows.emplace_back();
  return rows;
}

}  // namespace

const Registry& linked_registry() {
  static const Registry registry = [] {
    Registry filled;
    register_linked_plugins(filled);
    return filled;
  }();
  return registry;
}

std::string Row::text() const {
  return std::string(kind_name(kind)) + "_" + name + "_" + std::string(device_name(device)) + "_" +
         std::to_string(number);
}

std::ostream& operator<<(std::ostream& out, const Row& row) { return out << row.text(); }

std::vector<Row> rows_of(PluginKind kind, Device device) {
  std::vector<Row> rows;
  for (const std::string& name : linked_registry().names(kind)) {
    int number = 0;
    for (const Settings& settings : settings_for(kind, name)) rows.push_back({kind, name, device, number++, settings});
  }
  return rows;
}

}  // namespace semfield::testkit
