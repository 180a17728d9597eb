// One optimiser step after the other, and everything of it that a checkpoint must hold.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "execution/pipeline.h"
#include "formats/safetensors.h"
#include "model/optim/adam.h"
#include "session/ray_source.h"

namespace semfield {

/// Steps in a row without any density after which a pass counts as dead.
inline constexpr std::int64_t kDeadSteps = 100;

class Trainer {
 public:
  /// Borrows all; the pipeline must be trainable. Steps run on its executor. `steps`: of the run, which shares are of;
  /// 0: not known yet, so that terms of the loss that wait for a share of them wait.
  Trainer(Pipeline<float>& pipeline, const RaySource& rays, const AdamParams& adam, const ScheduleParams& schedule,
          std::int64_t steps = 0);

  /// Steps done so far.
  std::int64_t step() const { return step_; }
  /// From the next step on.
  void set_length(const ScheduleParams& schedule, std::int64_t steps);

  /// One step: batch, losses, gradients, checks, Adam, derived tensors, samplers' observe. A value of a ray, a
  /// gradient, a parameter, a moment or a state that is not finite (or too large for an update) throws Error: it names
  /// the value, frame and pixel of the ray it belongs to, and the tensor and element that it comes from. Values,
  /// moments, samplers and the step count are then untouched. A density that is not finite where a sampler asks for it
  /// in `observe` is found after the update: the step then counts as made and the sampler's state stays as it was.
  /// After kDeadSteps steps in which the density of a pass was 0 at every sample, while colours are not explained, the
  /// next one is an Error too: nothing of it can learn.
  StepLosses advance();
  /// Up to `most` steps, as many as run without waiting in between. Their losses, in order, valid until the next call.
  std::span<const StepLosses> advance_many(std::int64_t most);
  /// Brings values, moments and states into the pipeline's store; before any of them is read, stored or checked.
  void collect() { pipeline_.executor().download(step_); }

  /// Throws Error(failure) naming the tensor for a value, moment or state that is not finite: such a state is no
  /// checkpoint.
  void check_storable() const;

  /// Tensors of a checkpoint: every learned and state tensor under its name, moments under adam/m/NAME and adam/v/NAME.
  /// Borrowed.
  std::vector<TensorRef> state() const;
  /// Strict: every tensor must be there with its shape and nothing else may be. Throws Error(data) naming file and
  /// tensor; nothing is changed then.
  void load(const TensorFile& file, std::int64_t step);

 private:
  std::string bad_tensor() const;
  [[noreturn]] void fail(const Error& error);
  [[noreturn]] void explain_failed_step();
  void note_density(const StepLosses& losses);
  void check_alive() const;
  std::uint32_t terms_of(std::int64_t step) const;
  void hold_pixels();
  void fill(std::int64_t step);

  Pipeline<float>& pipeline_;
  const RaySource& rays_;
  AdamParams adam_;
  ScheduleParams schedule_;
  std::int64_t steps_ = 0;  // of the run
  std::int64_t step_ = 0;
  BatchBuffers batch_;
  std::uint64_t held_ = 0;       // version of rays_ that the executor has looked at
  bool drawn_ = false;           // by the executor
  std::int64_t dead_steps_ = 0;  // in a row
  std::size_t dead_pass_ = 0;
};

/// Tensors of a pipeline alone (no moments), for rendering: strict for those, moments are ignored.
void load_pipeline(Pipeline<float>& pipeline, const TensorFile& file);

}  // namespace semfield
