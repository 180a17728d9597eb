// What a check of plugins against the laws of their kinds hands over: the laws are a library of their own
// (libsemfield_laws.so, from testkit/law_suite.cpp), loaded when asked for.
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "plugin/registry.h"

namespace semfield {

enum class LawStatus : std::uint8_t {
  passed,
  failed,
  refused,  ///< the plugin's factory cannot be built so, and says why; some other way must work
};

/// The laws of one plugin with one set of parameters, built in one way.
struct LawRow {
  PluginKind kind = PluginKind::encoder;
  std::string name;
  std::string settings;  ///< "bands=7", "defaults"; "" for the laws of the declaration
  std::string build;     ///< "positions", "bf16, no direction"; "" where there is one way
  LawStatus status = LawStatus::passed;
  std::vector<std::string> found;  ///< a sentence for each way in which a law was broken, or why it was refused
};

struct LawRequest {
  std::vector<const PluginEntry*> entries;
  std::string settings_file;                    ///< lines as in conformance.txt; "": the defaults
  std::vector<std::string> scene;               ///< "root=room": parameters of the datasets among the entries
  std::string folder;                           ///< that relative paths of `scene` start at
  std::function<void(const LawRow&)> on_begin;  ///< of a row whose laws are asked now; may be empty
  std::function<void(const LawRow&)> on_row;
};

/// The library's one symbol. Throws before any law Error(config) for a line of the file that fits no entry or that an
/// entry's parameters refuse, and Error(usage) for a dataset that cannot open a scene with these parameters.
using LawSuite = void (*)(const Registry& registry, const LawRequest& request);
inline constexpr const char* kLawSuiteSymbol = "semfield_law_suite";

}  // namespace semfield
