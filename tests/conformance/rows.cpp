// Rows from the registry and the settings files.
#include "tests/conformance/rows.h"

#include <fstream>
#include <sstream>

#include "plugin/linked_plugins.h"

namespace semfield::testkit {

namespace {

Settings parse_line(const std::string& line) {
  Settings settings;
  std::istringstream words(line);
  for (std::string word; words >> word;) {
    const std::size_t equals = word.find('=');
    settings[word.substr(0, equals)] = equals == std::string::npos ? "" : word.substr(equals + 1);
  }
  return settings;
}

std::vector<Settings> settings_for(PluginKind kind, const std::string& name) {
  const std::string source = SEMFIELD_SOURCE_DIR;
  const std::string own = source + "/plugins/" + std::string(kind_name(kind)) + "s/" + name + "/conformance.txt";
  std::vector<Settings> rows;
  std::ifstream file(own);
  for (std::string line; std::getline(file, line);) {
    if (!line.empty() && line[0] != '#') rows.push_back(parse_line(line == "defaults" ? "" : line));
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
