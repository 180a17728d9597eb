// The trainings that `semfield-study scale` starts: their configurations, and what their run folders tell.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "studies/study_tools.h"

namespace semfield {

/// A training without an end in view: steps, and no evaluation.
struct ScaleTraining {
  std::string step, device;  ///< as in ScaleRow
  std::string config;        ///< the preset's file
  int ranks = 1, threads = 1;
  std::int64_t rays = 0;  ///< 0: the preset's
  int batch_steps = 1;    ///< steps that are timed together
  int batches = 1;        ///< behind a first one that is not timed
  bool deterministic = false;
  std::string precision;         ///< "": the preset's
  std::string room;              ///< file of the scene and of what the run reports
  std::vector<std::string> set;  ///< further settings, as of --set
};

/// A step of the preset `step` on the shipped room with every ray labelled: `rays` rays of all ranks together.
ScaleTraining preset_training(const std::string& step, const std::string& device, int ranks, std::int64_t rays,
                              bool quick, const StudyTools& tools);
/// Twenty steps whose bits are compared.
ScaleTraining bits_training(const std::string& config, const std::string& device, bool quick, const StudyTools& tools);

/// Words that train it into the folder `run`; its configuration is written beside it, in `folder`.
std::vector<std::string> training_words(const ScaleTraining& training, const std::string& folder,
                                        const std::string& run);
/// A sweep of short cells that differ in their seed, written to `folder`; returns its file.
std::string sweep_file(int cells, const std::string& device, bool quick, const StudyTools& tools,
                       const std::string& folder);

/// Seconds per step of each timed batch of a run that has ended. Throws Error(data) where it logged none.
std::vector<double> batch_seconds(const std::string& run);

/// Bytes of the gradients that a run's network has.
struct GradientBytes {
  double dense = 0;  ///< of fields and heads
  double table = 0;  ///< of position encoders that learn
};
GradientBytes gradient_bytes(const std::string& run);

}  // namespace semfield
