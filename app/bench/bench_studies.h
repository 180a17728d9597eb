// What the verbs of `bench` hand to their studies: a library of its own, loaded when asked for.
#pragma once

#include <string>
#include <vector>

#include "app/verb.h"

namespace semfield::app {

struct BenchOptions : Options {
  using Options::Options;
  const bool& peers = flag("--peers", "alternate with the same steps in PyTorch and print ratios");
  const int& repeats = value_in("--repeats N", 5, 1, 1000, "rounds; figures are medians of them");
  const std::string& python = value("--python PROGRAM", "interpreter with torch (default: python3)");
};

struct BenchGpuOptions : BenchOptions {
  using BenchOptions::BenchOptions;
  const std::string& only = value("--only NAME", "measurements whose names begin with this: --only 'paper bf16'");
};

struct BenchStepOptions : BenchOptions {
  using BenchOptions::BenchOptions;
  const int& threads = value_in("--threads N", 0, 1, 4096, "CPU threads (default: every core)");
  const std::string& size =
      choice("--size SIZE", "full", {"full", "tiny"}, "full, or tiny: narrow networks and few rays, for tests");
  const std::vector<std::string>& set =
      repeated("--set KEY=VALUE", "override a value of both networks: --set runtime.tile_rays=8");
  const std::string& peer_script = value("--peer-script FILE", "the PyTorch script (default: the shipped one)");
};

}  // namespace semfield::app
