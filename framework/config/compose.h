// include, override, replace-on-type-change.
#pragma once

#include <string>
#include <vector>

#include "config/config_tree.h"
#include "core/error.h"

namespace semfield {

/// `over` merged onto `base`: maps merge key by key, lists and scalars replace, and a map whose scalar `type` differs
/// from the base's is replaced whole.
ConfigNode merge_config(ConfigNode base, const ConfigNode& over);

/// Loads `path`, a name as find_config takes it, resolves `include:` (a file or a list of files relative to the
/// including file, else among the shipped configurations; cycles refused), then local keys, then each "a.b=value" of
/// `overrides` in order (items of lists by item_key or by index: "passes.main.sampler.samples=32"); what a flag of the
/// command line sets is written "--threads runtime.threads=2", and messages then name the flag. Also resolves `like:
/// NAME` of list items under `passes` (the item is merged onto the earlier item of that name). Throws Error(config);
/// but a mistake in what is included or overridden goes into `problems` where they are given, and the rest is composed
/// without it, or with the file whose name is nearest.
ConfigNode compose_config(const std::string& path, const std::vector<std::string>& overrides = {},
                          Diagnostics* problems = nullptr);

/// What overrides and messages call an item of a list: its `name`, or the `labels` that a semantic branch is for, where
/// that is one plain word and no other item has it; else its index. A pass that no `name` was written for has one
/// after composition.
std::string item_key(const ConfigNode& list, std::size_t index);
/// The name of a pass that is given none: "main", "pass1", ...
std::string usual_pass_name(std::size_t index);

/// A value set at a key path ("passes.main.sampler.samples"), written in some file: paths in it start there.
struct ConfigOverride {
  std::string key;
  ConfigNode value;
};
/// The same with overrides that are nodes.
ConfigNode compose_config_with(const std::string& path, const std::vector<ConfigOverride>& overrides);
/// The same of a tree that no file holds: what it includes is looked for from the working folder.
ConfigNode compose_config_tree(const ConfigNode& tree, const std::vector<ConfigOverride>& overrides);
/// The same with overrides as the command line has them.
ConfigNode compose_config_tree(const ConfigNode& tree, const std::vector<std::string>& overrides);

/// Paths in a config are relative to the file that wrote them: the absolute path of a scalar node's text.
std::string resolve_path(const ConfigNode& scalar);

}  // namespace semfield
