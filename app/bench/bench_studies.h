// What the verbs of `bench` hand to their studies: a library of its own, loaded when asked for.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "app/app_context.h"

namespace semfield::app {

struct BenchGpuOptions {
  bool peers = false;
  std::string only;  ///< beginning of the measurements' names; "": all
  int repeats = 5;
  std::string python;
};

struct BenchStepOptions {
  bool peers = false;
  int threads = 0;  ///< 0: every core
  int repeats = 5;
  std::string size = "full";  ///< full, or tiny: narrow networks and few rays, for tests
  std::string peer_script, python;
  std::vector<std::string> set;  ///< overrides of both networks' configurations
};

}  // namespace semfield::app
