// What the verbs of `bench` hand to their studies: a library of its own, loaded when asked for.
#pragma once

#include <string>
#include <vector>

#include "app/app_context.h"

namespace semfield::app {

struct BenchOptions {
  bool peers = false;
  int repeats = 5;
  std::string python;
};

struct BenchGpuOptions : BenchOptions {
  std::string only;  ///< beginning of the measurements' names; "": all
};

struct BenchStepOptions : BenchOptions {
  int threads = 0;            ///< 0: every core
  std::string size = "full";  ///< full, or tiny: narrow networks and few rays, for tests
  std::string peer_script;
  std::vector<std::string> set;  ///< overrides of both networks' configurations
};

}  // namespace semfield::app
