// What plugins there are and what they take, as text and Markdown, from their own declarations.
#pragma once

#include <string>
#include <vector>

#include "config/params_read.h"
#include "plugin/registry.h"

namespace semfield {

/// One plugin a line, grouped by kind: name, sentence, module.
std::string plugins_list_text(const Registry& registry);
/// Every plugin of that name (kinds may share one), with its parameters: type, default, range, sentence. Throws
/// Error(config) for an unknown name, with the nearest known.
std::string plugin_details_text(const Registry& registry, const std::string& name);
/// "cpu, cuda": where one entry runs in this build.
std::string devices_text(const Registry& registry, const PluginEntry& entry);
/// Plugins by device: which kernels this build has. Datasets run on the host and have none.
std::string support_matrix_text(const Registry& registry);

/// Markdown table of parameters, or a sentence when there are none. Ends with a line feed.
std::string parameter_table_markdown(const std::vector<ParamDoc>& params);
std::string parameter_table_markdown(const PluginEntry& entry);
/// The page of all plugins (docs/reference/plugins.md of the built documents).
std::string plugins_markdown(const Registry& registry);

}  // namespace semfield
