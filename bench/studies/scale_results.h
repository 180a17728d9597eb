// What `semfield-study scale` measured, on one machine or brought together from several.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "studies/scale_model.h"
#include "studies/step_bench.h"

namespace semfield {

/// A step of a preset on some ranks.
struct ScaleRow {
  std::string machine;  ///< "AMD EPYC, 2 cores", "NVIDIA H200, ..."
  std::string step;     ///< paper, hash
  std::string device;   ///< cpu, cuda
  int ranks = 1;
  std::int64_t rays = 0;      ///< of all ranks together
  Spread seconds;             ///< a step
  std::int64_t batches = 0;   ///< that `seconds` is of
  double gradient_bytes = 0;  ///< of tensors that are summed whole
  double table_bytes = 0;     ///< gradients of position encoders that learn
  bool operator==(const ScaleRow&) const;
};

/// A training whose end is compared with that of the first of its name.
struct ScaleBits {
  std::string machine, name;  ///< "quickstart", "quickstart_frequency", "quickstart on cuda, deterministic"
  int ranks = 1, threads = 1;
  std::string difference;  ///< "": every bit is equal
  bool operator==(const ScaleBits&) const = default;
};

/// The same cells by one worker and by two.
struct ScaleSweep {
  std::string machine, workers;  ///< "processes of one thread", "GPUs"
  int cells = 0;
  double one_s = 0, two_s = 0;
  bool operator==(const ScaleSweep&) const = default;
};

/// What something was measured on.
struct ScaleMachine {
  std::string name;    ///< as in the rows
  std::string device;  ///< cpu, cuda
  int units = 1;       ///< cores, or GPUs
  std::string about;   ///< build, date and command
  bool operator==(const ScaleMachine&) const = default;
};

struct ScaleResults {
  bool quick = false;  ///< small networks and few rays: figures of tests
  std::vector<ScaleMachine> machines;
  std::vector<ScaleRow> rows;
  std::vector<ScaleBits> bits;
  std::vector<ScaleSweep> sweeps;
  std::vector<std::string> missing;  ///< why something could not be measured; not kept in a file

  /// The row, or null.
  const ScaleRow* find(const std::string& machine, const std::string& step, int ranks, std::int64_t rays) const;
};

/// Rays per step: on one rank in weak scaling, on all ranks in strong scaling, and so few that a step on one rank shows
/// what it costs beside its rays.
struct ScaleSizes {
  std::int64_t weak = 0, strong = 0, few = 0;
};
ScaleSizes scale_sizes(const std::string& step, const std::string& device, bool quick);

/// How many times the rays per second of one rank `ranks` ranks have on a machine, where both were measured.
std::optional<double> measured_speedup(const ScaleResults& results, const ScaleMachine& machine,
                                       const std::string& step, int ranks, bool strong);

/// Names and values of the last line, in its order; "-" for what was not measured.
std::vector<std::pair<std::string, std::string>> scale_goals(const ScaleResults& results);

std::string scale_json(const ScaleResults& results);
/// `name` of the file. Throws Error(data).
ScaleResults parse_scale_json(const std::string& text, const std::string& name);
/// What `fresh` measured replaces the same measurements of `old`; others stay. Throws Error(usage) where one of them is
/// `quick` alone.
ScaleResults merged(ScaleResults old, const ScaleResults& fresh);

}  // namespace semfield
