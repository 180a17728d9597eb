// Which settings each registered plugin is tested with, and how it is built for its laws with its twin in double.
#pragma once

#include <gtest/gtest.h>

#include <filesystem>
#include <ostream>

#include "testkit/laws.h"
#include "tests/linked_registry.h"

namespace semfield::testkit {

// Which settings each registered plugin is tested with.

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
inline std::vector<Settings> settings_for(PluginKind kind, const std::string& name) {
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

inline std::string Row::text() const {
  return std::string(kind_name(kind)) + "_" + name + "_" + std::string(device_name(device)) + "_" +
         std::to_string(number);
}

inline std::ostream& operator<<(std::ostream& out, const Row& row) { return out << row.text(); }

inline std::vector<Row> rows_of(PluginKind kind, Device device) {
  std::vector<Row> rows;
  for (const std::string& name : linked_registry().names(kind)) {
    int number = 0;
    for (const Settings& settings : settings_for(kind, name)) rows.push_back({kind, name, device, number++, settings});
  }
  return rows;
}

inline std::vector<Row> rows_of_kinds(std::initializer_list<PluginKind> kinds, Device device = Device::cpu) {
  std::vector<Row> rows;
  for (const PluginKind kind : kinds)
    for (Row& row : rows_of(kind, device)) rows.push_back(std::move(row));
  return rows;
}

// How the plugin of a row is built for its laws, and its twin in double on the CPU.

/// "", or "encoder 'waves' has no cuda kernels": a plugin of the CPU alone is left out of a device's laws by
/// name.
inline std::string lacks_kernels(const Registry& registry, PluginKind kind, const std::string& name, Device device) {
  const std::string owner = std::string(kind_name(kind)) + " '" + name + "'";
  if (registry.kernels().has(device, owner)) return {};
  return owner + " has no " + std::string(device_name(device)) + " kernels";
}

/// Ways of building that a factory may refuse with an Error; at least one must be accepted. `laws` gets the twins of
/// each that is.
template <class Build, class Laws>
void hold_for_any_accepted(const Registry& registry, const Row& row, const std::vector<Build>& builds,
                           const Laws& laws) {
  int accepted = 0;
  std::string refusals;
  for (const Build& build : builds) {
    decltype(make_twins(registry, row.name, row.settings, build)) twins;
    try {
      twins = make_twins(registry, row.name, row.settings, build);
    } catch (const Error& error) {
      EXPECT_NE(error.code(), Code("plugin.kernels.missing")) << error.what();
      refusals += std::string(error.what()) + "\n";
      continue;
    }
    ++accepted;
    SCOPED_TRACE("variant " + std::to_string(&build - builds.data()));
    const Failures failures = laws(*twins.single, *twins.oracle, build);
    EXPECT_TRUE(failures.empty()) << to_text(failures);
  }
  EXPECT_GT(accepted, 0) << "every way of building was refused:\n" << refusals;
}

/// The same for all ways in which a plugin of its kind is built.
template <class Laws>
void hold_for_any_accepted(const Registry& registry, const Row& row, const Laws& laws) {
  with_builds(registry, row.kind, row.name, row.device,
              [&](const auto& builds) { hold_for_any_accepted(registry, row, builds, laws); });
}

}  // namespace semfield::testkit
