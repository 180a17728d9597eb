// A configuration of files: what it includes, and what is set over it.
#pragma once

#include <string>
#include <vector>

#include "config/config_tree.h"
#include "config/config_words.h"
#include "core/error.h"

namespace semfield {

/// Loads `path`, a name as find_config takes it, resolves `include:` (a file or a list of files relative to the
/// including file, else among the shipped configurations; cycles refused), then local keys, then the file's own
/// `overrides:`, a map of key paths, which reach into lists, then `overrides` (parse_overrides, with_overrides). Throws Error(config); but a mistake in what is included or overridden goes into
/// `problems` where they are given, and the rest is composed without it, or with the file whose name is nearest.
ConfigNode compose_config(const std::string& path, const std::vector<std::string>& overrides = {},
                          Diagnostics* problems = nullptr);
/// The same with overrides that are nodes.
ConfigNode compose_config_with(const std::string& path, const std::vector<ConfigOverride>& overrides);
/// The same of a tree that no file holds: what it includes is looked for from the working folder.
ConfigNode compose_config_tree(const ConfigNode& tree, const std::vector<ConfigOverride>& overrides);

/// Paths in a config are relative to the file that wrote them: the absolute path of a scalar node's text.
std::string resolve_path(const ConfigNode& scalar);

}  // namespace semfield
