// Parameters of a registry entry from a small map of texts, without a config file.
#pragma once

#include <map>
#include <memory>
#include <string>
#include <vector>

#include "plugin/registry.h"
#include "testkit/failures.h"

namespace semfield::testkit {

/// Parameter name to value as text: "16", "0.5", "true", a choice's name, lists as "1,2,3".
using Settings = std::map<std::string, std::string>;

struct SettingsLine {
  int number = 0;     ///< in its file, from 1
  Settings settings;  ///< empty: the defaults
};
/// Lines "name=value name=value" or "defaults" of a file as conformance.txt; blank ones and those that begin with '#'
/// are passed over. Throws Error(config) with file and line for a word without '=', Error(no_input).
std::vector<SettingsLine> read_settings_lines(const std::string& path);

/// Reads `settings` into the parameters and returns every problem: unknown names, wrong types, values out of range.
Failures apply_settings(PluginParams& params, const Settings& settings);
/// Every parameter with its value as text; apply_settings() of it gives the same parameters.
Settings settings_of(PluginParams& params);

/// The entry's defaults with `settings` applied and validated. Throws Error(config) listing every problem.
std::unique_ptr<PluginParams> make_params(const PluginEntry& entry, const Settings& settings = {});

}  // namespace semfield::testkit
