// What the verbs of `bench` hand to their library, which is loaded when one is asked for.
#pragma once

#include <string>
#include <vector>

#include "app/verb.h"

namespace semfield::app {

struct BenchOptions : Options {
  using Options::Options;
  const int& repeats = value_in("--repeats N", 5, 1, 1000, "rounds; figures are medians of them");
  const std::string& only = value("--only NAME", "measurements whose names begin with this: --only 'paper bf16'");
  const int& threads = value_in("--threads N", 0, 1, 4096, "CPU threads (default: every core)");
  const std::string& size =
      choice("--size SIZE", "full", {"full", "tiny"}, "full, or tiny: narrow networks and few rays, for tests");
  const std::vector<std::string>& set =
      repeated("--set KEY=VALUE", "override a value of every network: --set runtime.tile_rays=8");
};

/// `semfield_bench` of the library: measures on "cpu" or "cuda", prints, and returns the exit code.
using BenchFunction = int (*)(const BenchOptions& options, const char* device, AppContext& context);

}  // namespace semfield::app
