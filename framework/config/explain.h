// A configuration as text: what a composed one is made of, what is wrong with it, how two differ.
#pragma once

#include <string>
#include <vector>

#include "config/config_tree.h"
#include "config/params.h"
#include "core/error.h"

namespace semfield {

/// What a node is, for messages: "nothing", "'12'", "text '12'", "a list", "a map".
std::string kind_text(const ConfigNode& node);

/// The tree as YAML with the origin of every value as an aligned comment: "  levels: 8   # room.yaml:7:13"; values of
/// no file (filled in by the program) say "default". Parsing the text gives an equal tree.
std::string explain_config(const ConfigNode& node);

/// `resolved` (every value, defaults included) with the values and places of `written` where that has them.
ConfigNode with_origins(const ConfigNode& resolved, const ConfigNode& written);

/// In place of a value that one side lacks.
inline constexpr const char* kAbsent = "(absent)";

/// A value of a tree that `--set KEY=VALUE` takes as it stands here.
struct ConfigSetting {
  std::string key, value;
  std::string from;  ///< where it was written: "room.yaml:7:5", "default"
};
/// Every value, a list of plain values being one.
std::vector<ConfigSetting> config_settings(const ConfigNode& tree);

/// A value that differs, in one line of YAML on either side, or kAbsent.
struct ConfigDifference {
  std::string key;  ///< path; "(top)" for the whole tree
  std::string left, right;
  std::string text() const { return key + ": " + left + " -> " + right; }  ///< "train.steps: 100 -> 200"
};

/// In the order of `a` and then of what only `b` has. Places and the order of keys do not count.
std::vector<ConfigDifference> config_differences(const ConfigNode& a, const ConfigNode& b);

/// The keys of one map for the reference, `path` being its key path: "train.adam", "passes[].semantic".
struct SectionDoc {
  std::string path, sentence;
  std::vector<ParamDoc> params;
};

}  // namespace semfield
