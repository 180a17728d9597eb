// What `bench gpu` measures: training steps and frames on a GPU, and the same steps in PyTorch.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "studies/step_bench.h"
#include "studies/study_tools.h"

namespace semfield {

struct BenchGpuOptions {
  bool peers = false;
  std::string only;  ///< beginning of the measurements' names; "": all
  int repeats = 5;
  std::string python;
};

struct GpuRow {
  std::string name;
  Spread seconds;
};

struct GpuResults {
  std::string about, peer_about;  ///< the device; who answered as peer
  std::vector<GpuRow> rows;

  std::optional<double> ms(const std::string& name) const;
  /// Of the peer's fastest mode.
  std::optional<double> best_peer_ms() const;
  std::optional<double> ratio(const std::string& over, const std::string& under) const;
};

/// What cannot be measured is a note. Throws Error(unavailable) without a device.
GpuResults measure_gpu(const BenchGpuOptions& options, const StudyTools& tools);

}  // namespace semfield
