// Key paths of configurations, as messages and pages write them.
#pragma once

#include <map>
#include <set>
#include <string>
#include <vector>

#include "config/params_read.h"
#include "plugin/registry.h"

namespace semfield::docs {

/// Every key that `--set` takes; an index of a list is N: "passes.N.sampler.samples".
class Keys {
 public:
  Keys();

  /// `dataset`: the one whose keys count beside the framework's; "": none.
  bool known(const std::string& key, const std::string& dataset) const;
  /// Whether the framework or any dataset has it.
  bool known_somewhere(const std::string& key) const;
  /// Last parts of keys that a message could name bare: "near_m" for "scene.load.near_m".
  std::set<std::string> bare() const;

 private:
  void add(const std::string& path, const std::vector<ParamDoc>& params);

  Registry registry_;
  std::set<std::string> keys_;
  std::map<std::string, std::set<std::string>> datasets_;
};

}  // namespace semfield::docs
