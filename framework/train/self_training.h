// Self-training: at some steps the field labels the training pixels that it is sure of, for the rest of training.
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "eval/final_eval.h"
#include "train/ray_source.h"
#include "train/session.h"

namespace semfield {

/// The step of each round, ascending, each once: `at` times train.steps, to the nearest whole step from 1 on, and never
/// before the rate's first fall; none while train.steps is not settled.
std::vector<std::int64_t> round_steps(const RunConfig& config);

/// The rounds of one run [Lee13]. A round renders every training frame; a pixel without a label of its own whose most
/// probable class has at least `confidence`, at an opacity of at least `min_opacity`, takes that class as its label
/// until the next round replaces all that this one gave. Labels that were given never change, and neither do class
/// weights. A round's labels are written to `folder` before a step trains on them:
///   round_NNNNNNNN.safetensors: U8 tensor `INDEX/NAME` [height, width, 1 or 2] a frame, class indices with 255 or
///   65535 for none; metadata `step` and `rounds`, the JSON of this round and those before.
class SelfTraining {
 public:
  /// Borrows both; `rays` gets the labels. Nothing is due in a session without semantics or with `at` empty.
  SelfTraining(const Session& session, RaySource& rays, std::string folder);

  /// At the step of a checkpoint that names its round (named()): takes up that round and removes the files of later
  /// steps, which belong to a course that is left. Throws Error where the file is missing, damaged or another.
  void resume(std::int64_t step, const std::string& named);

  /// A round has to be made before the step after `step`.
  bool due(std::int64_t step) const;
  /// Steps until the next round is due, or `most`.
  std::int64_t steps_until_due(std::int64_t step, std::int64_t most) const;

  struct Hooks {
    std::function<void(const ScoreProgress&)> progress;  ///< may be null
    std::function<bool()> stop;                          ///< asked between frames; may be null
  };
  /// Renders, labels, writes and hands the labels on. False when it was stopped: nothing has changed then.
  bool make_round(std::int64_t step, const Hooks& hooks);

  /// The round that trains now, for a checkpoint: its step and the checksum of its labels; "" before the first.
  const std::string& named() const { return named_; }
  const std::vector<SelfTrainingRound>& rounds() const { return rounds_; }

 private:
  std::string path_of(std::int64_t step) const;
  std::string write(std::int64_t step) const;

  const Session& session_;
  RaySource& rays_;
  std::string folder_;
  std::vector<int> frames_;       // of the scene, in the ray source's order
  std::vector<LabelMap> labels_;  // of the last round, by frames_; empty before it
  std::vector<SelfTrainingRound> rounds_;
  std::string named_;
};

}  // namespace semfield
