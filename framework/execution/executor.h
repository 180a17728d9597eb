// Where a pipeline's steps and rendering run: lanes of the CPU, or a stream of a device.
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "core/device_id.h"
#include "core/error.h"
#include "execution/pixel_pool.h"
#include "execution/ray_batch.h"
#include "execution/render_rays.h"
#include "model/optim/adam.h"

namespace semfield {

/// Gradients of a step, between backward and update.
template <class Real>
struct StepGradients {
  std::int64_t step = 0;
  /// Of every learned tensor, in the order of checkpoints; View::device says whose memory they are.
  std::span<const View<Real>> tensors;
  /// The cudaStream_t on which backward was queued and the update will be: whatever reads or writes the gradients must
  /// be queued there or wait for it. Null where they are host memory: backward is done.
  void* stream = nullptr;
};

/// Called in every step, after backward and before the gradients are checked and Adam uses them. It may change them, as
/// a sum over several processes does. An Error that it throws ends the step. On the CPU a step that met a value
/// of a ray that is not finite ends before it; on a device nobody knows yet.
template <class Real>
using GradientHook = std::function<void(const StepGradients<Real>&)>;

/// Steps that were queued and are done.
struct StepResults {
  std::span<const StepLosses> losses;  ///< of the steps that were made, in order; valid until the next call of queue
  /// The step that met a value that is not finite, of which the executor knows no more; nothing changed in it or since.
  std::optional<std::int64_t> failed;
  std::optional<Error> afterwards;  ///< samplers could not refresh their state after the last of these steps
};

template <class Real>
class PointNetwork;

/// The tensors of a pipeline's store are what checkpoints hold; an executor may keep copies of its own. Throws Error.
template <class Real>
class Executor {
 public:
  virtual ~Executor() = default;
  virtual DeviceId device() const = 0;
  /// "cpu", or the device's own name and size.
  virtual std::string description() const = 0;
  /// Who computes matrix products.
  virtual std::string matrix_products() const = 0;
  /// The store's values, moments and states were written from outside, as those after `step` steps: the executor takes
  /// them over and makes derived tensors of them.
  virtual void upload(std::int64_t step) = 0;
  /// Brings the store up to date, derived tensors too; before any of it is read.
  virtual void download(std::int64_t step) = 0;
  /// Rays that are walked together, of a step of `rays` rays: those with a label come first in each such tile.
  virtual std::int64_t tile_rays(std::int64_t rays) const = 0;

  /// One training step: gradients, hook, checks, Adam, derived tensors, samplers' observe. The batch is copied or used
  /// before it returns. Nothing of the step may be relied on before finish(); at most most_queued() steps wait. An
  /// Error means that the step was not made, and no step may be queued behind it before finish().
  virtual void queue(std::int64_t step, const RayBatch& batch, const AdamStep& update) = 0;
  /// Takes the pixels in, so that queue_drawn can draw steps from them; again after labels have changed. false: it does
  /// not (take_notes may say why), and batches are to be given. Between steps.
  virtual bool hold(const PixelPool&) { return false; }
  /// As queue, of the batch that RaySource::fill makes of the held pixels; `terms`: RayBatch::terms.
  virtual void queue_drawn(std::int64_t, std::uint32_t, const AdamStep&) {
    throw Error(ErrorKind::internal, "internal.executor.batches", "this executor draws no batches");
  }
  virtual int most_queued() const = 0;
  /// Waits for all queued steps.
  virtual StepResults finish() = 0;
  /// What users should know of the steps made so far, a sentence each; told once.
  virtual std::vector<std::string> take_notes() { return {}; }
  /// From the next step on; null: none. Not while steps are queued.
  virtual void set_gradient_hook(GradientHook<Real> hook) = 0;

  /// As Pipeline::render and Pipeline::density.
  virtual void render(const RenderJob<Real>& job) = 0;
  virtual void density(View<const double> positions, View<Real> sigma) = 0;
  /// The semantic part at points (execution/point_network.h), which lives as long as the executor.
  virtual PointNetwork<Real>& points() {
    throw Error(ErrorKind::internal, "internal.executor.points", "this executor has no network at points");
  }
};

}  // namespace semfield
