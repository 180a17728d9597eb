// One optimiser step after the other, and everything of it that a checkpoint must hold.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "model/pipeline.h"
#include "optim/adam.h"
#include "optim/schedule.h"
#include "train/ray_source.h"
#include "train/safetensors.h"

namespace semfield {

class Trainer {
 public:
  /// Borrows both; the pipeline must be trainable.
  Trainer(Pipeline<float>& pipeline, const RaySource& rays, const AdamParams& adam, const ScheduleParams& schedule);

  /// Steps done so far.
  std::int64_t step() const { return step_; }

  /// One step: batch, losses, gradients, finite check, Adam, derived tensors, samplers' observe. A loss or gradient
  /// that is not finite throws Error(failure) naming the tensor and its element; values, moments and samplers are then
  /// untouched.
  StepLosses advance();

  /// Tensors of a checkpoint: every learned and state tensor under its name, moments under adam/m/NAME and adam/v/NAME.
  /// Borrowed.
  std::vector<TensorRef> state() const;
  /// Strict: every tensor must be there with its shape and nothing else may be. Throws Error(data) naming file and
  /// tensor; nothing is changed then.
  void load(const TensorFile& file, std::int64_t step);

 private:
  void check_finite(const StepLosses& losses) const;
  void update();

  Pipeline<float>& pipeline_;
  const RaySource& rays_;
  AdamParams adam_;
  ScheduleParams schedule_;
  std::int64_t step_ = 0;
  BatchBuffers batch_;
};

/// Tensors of a pipeline alone (no moments), for rendering: strict for those, moments are ignored.
void load_pipeline(Pipeline<float>& pipeline, const TensorFile& file);

}  // namespace semfield
