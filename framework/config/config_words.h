// What a user writes to mean a configuration: its name, and values over it; and the names of what is in its lists.
#pragma once

#include <cstddef>
#include <string>
#include <vector>

#include "config/config_tree.h"
#include "core/error.h"

namespace semfield {

// Configurations by name: files of the user's, then those that come with the program.

/// The shipped configuration that a relative name means: `quickstart`, `quickstart.yaml` and `configs/quickstart.yaml`
/// are one. "" where there is none.
std::string shipped_config(const std::string& name);

/// Where shipped_config looks for a file of exactly this name, for messages; "" for an absolute one, and where nothing
/// is shipped.
std::string shipped_place(const std::string& name);

/// The name of the configuration nearest to one that is not there, next to `own_place`, where it was looked for, or
/// among the shipped ones; "" when none is near.
std::string near_config(const std::string& name, const std::string& own_place);

/// The file that a name on the command line means: as it is written, then with .yaml behind it, then a shipped one.
/// Throws Error(no_input) with the places and the nearest name.
std::string find_config(const std::string& name);

// What is written over one.

/// `over` merged onto `base`: maps merge key by key, lists and scalars replace, and a map whose scalar `type` differs
/// from the base's is replaced whole.
ConfigNode merge_config(ConfigNode base, const ConfigNode& over);

/// A value set at a key path ("passes.main.sampler.samples"), written in some file: paths in it start there.
struct ConfigOverride {
  std::string key;
  ConfigNode value;
};

/// Of "a.b=value" each; what a flag of the command line sets is written "--threads runtime.threads=2", and messages
/// then name the flag. Throws Error(config), or notes in `problems` and leaves out what is no such text.
std::vector<ConfigOverride> parse_overrides(const std::vector<std::string>& texts, Diagnostics* problems = nullptr);

/// What a map of key paths sets: {train.steps: 500}. Throws Error(config) naming `what` where it is no map.
std::vector<ConfigOverride> overrides_of(const ConfigNode& map, const std::string& what);

/// Sets each in `root`, which is composed further; items of lists are called by item_key or by index. Errors as
/// with_overrides.
void set_values(ConfigNode& root, const std::vector<ConfigOverride>& overrides, Diagnostics* problems = nullptr);
/// `root` with each of them in order; items of lists are called by item_key or by index. Then `like: NAME` of an item
/// of `passes` is resolved: the item is merged onto the earlier one of that name. Throws Error(config), or notes in
/// `problems` and leaves out what cannot be set.
ConfigNode with_overrides(ConfigNode root, const std::vector<ConfigOverride>& overrides,
                          Diagnostics* problems = nullptr);

/// What overrides and messages call an item of a list: its `name`, or the `labels` that a semantic branch is for, where
/// that is one plain word and no other item has it; else its index. A pass that no `name` was written for has one
/// after composition.
std::string item_key(const ConfigNode& list, std::size_t index);
/// The name of a pass that is given none: "main", "pass1", ...
std::string usual_pass_name(std::size_t index);

// A configuration of files: what it includes, and what is set over it (compose.cpp).

/// Loads `path`, a name as find_config takes it, resolves `include:` (a file or a list of files relative to the
/// including file, else among the shipped configurations; cycles refused), then local keys, then the file's own
/// `overrides:`, a map of key paths, which reach into lists, then `overrides` (parse_overrides, with_overrides). Throws
/// Error(config); but a mistake in what is included or overridden goes into `problems` where they are given, and the
/// rest is composed without it, or with the file whose name is nearest.
ConfigNode compose_config(const std::string& path, const std::vector<std::string>& overrides = {},
                          Diagnostics* problems = nullptr);
/// The same with overrides that are nodes.
ConfigNode compose_config_with(const std::string& path, const std::vector<ConfigOverride>& overrides);
/// The same of a tree that no file holds: what it includes is looked for from the working folder.
ConfigNode compose_config_tree(const ConfigNode& tree, const std::vector<ConfigOverride>& overrides);

/// Paths in a config are relative to the file that wrote them: the absolute path of a scalar node's text.
std::string resolve_path(const ConfigNode& scalar);

}  // namespace semfield
