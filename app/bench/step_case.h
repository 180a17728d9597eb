// A whole training step on rays made up in memory, to be timed: batch, forward, losses, backward, scatter, Adam.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "core/non_copyable.h"
#include "plugin/registry.h"
#include "train/trainer.h"

namespace semfield {

struct StepCaseOptions {
  std::string config;            ///< configuration file; its scene is not opened
  std::vector<std::string> set;  ///< overrides, as of --set
  int classes = 29;              ///< C, every ray labelled; 0: no semantics
  std::int64_t rays = 1024;
};

/// One pipeline with optimiser and a source of rays: eight random pictures (colours and labels uniform) seen by
/// cameras in the inner half of the cube [-0.5, 0.5]^3 looking anywhere. A step is Trainer's, so what is timed is what
/// trains.
class StepCase : NonCopyable {
 public:
  /// Throws Error(config).
  StepCase(const StepCaseOptions& options, Registry& registry);

  /// Workers for steps on so many threads, so that the next call of seconds() starts none.
  static void start_threads(int threads);
  /// Mean seconds of `steps` steps on `threads` threads.
  double seconds(int threads, int steps);
  /// Seconds in which `rays` rays are rendered: colour, depth, label and entropy.
  double render_seconds(std::int64_t rays);
  /// Samples that the networks of all passes evaluate in a step.
  std::int64_t samples_per_step() const { return samples_all_; }
  /// Total loss of the last step.
  double loss() const { return losses_.total; }

 private:
  std::vector<StoredFrame> pixels_;
  std::vector<TrainingLabels::Frame> labels_;
  Session session_;  // of random pictures: network and settings alone
  std::unique_ptr<Trainer> trainer_;
  std::int64_t samples_last_ = 0, samples_all_ = 0;
  StepLosses losses_;
};

/// Median and ends of repeated measurements.
struct Spread {
  double median = 0, min = 0, max = 0;
};
Spread spread_of(std::vector<double> values);

/// Runs every measurement once per round, in order (A B A B ...), `repeats` rounds; what drifts then meets all alike.
/// Returns one spread a measurement.
std::vector<Spread> alternate(const std::vector<std::function<double()>>& measurements, int repeats);

}  // namespace semfield
