// Steps and rendering on a stream of one CUDA device.
#pragma once

#include <functional>
#include <memory>
#include <vector>

#include "cuda/kernels/losses.h"
#include "cuda/memory.h"
#include "cuda/staging.h"
#include "cuda/store.h"
#include "execution/device_library.h"
#include "execution/pipeline.h"

namespace semfield::cuda {

/// A step is: one copy of its batch to the device, one graph of every kernel from sampling to Adam, one copy of its
/// sums back, all queued without waiting. The graph is captured in the third step of a shape: the first sizes arenas
/// and chooses algorithms. Rays beyond the last labelled one carry no semantics; a step's number of such rays is
/// rounded up to an eighth of the batch, so that few shapes occur.
class StreamExecutor final : public Executor<float> {
 public:
  StreamExecutor(Pipeline<float>& host, std::vector<PassParts<float>> parts, const DeviceOptions& options);
  ~StreamExecutor() override;

  DeviceId device() const override { return {Device::cuda, options_.ordinal}; }
  std::string description() const override;
  std::string matrix_products() const override { return "cuBLASLt and our own"; }
  void upload(std::int64_t step) override;
  void download(std::int64_t step) override;
  std::int64_t tile_rays(std::int64_t rays) const override { return rays; }
  void queue(std::int64_t step, const RayBatch& batch, const AdamStep& update) override;
  int most_queued() const override { return kSlots; }
  StepResults finish() override;
  void set_gradient_hook(GradientHook<float> hook) override;
  void render(const RenderJob<float>& job) override;
  void density(View<const double> positions, View<float> sigma) override;

 private:
  static constexpr int kSlots = 32;
  static constexpr int kGroups = 8;  // shapes of a step: eighths of the batch with semantics

  // One shape of a step: how many rays have semantics, and which terms of the loss there are.
  struct Shape {
    std::int64_t semantic_rays = 0;
    std::uint32_t terms = 0;  // of the loss that work: LossScales::active
    int runs = 0;
    cudaGraphExec_t graphs[2] = {};  // with a gradient hook two, one before and one after it
  };
  Launch step_launch() const;
  StepContext context(std::int64_t step, bool training, Workspace& arena) const;
  Shape& shape_of(const RayBatch& batch, std::uint32_t terms);
  void run(Shape& shape, std::int64_t step);
  void run_part(const Shape& shape, cudaGraphExec_t& graph, const std::function<void()>& body);
  void backward(const Shape& shape, std::int64_t step);
  void update(std::int64_t step);
  void train_passes(const Shape& shape, const RayBatch& batch, const StepContext& ctx);
  class BatchExecutor;
  std::int64_t growths() const { return train_arena_.growth_count() + beside_arena_.growth_count(); }
  /// Whether a step's forward and backward of its first `rays` rays do (memory_advice.cpp).
  bool fits(std::int64_t rays, const Shape& shape, std::int64_t step);
  /// The error of a step that did not fit, with settings that do.
  Error with_settings_that_fit(const Error& error, const Shape& shape, std::int64_t step);
  void forget_graphs();
  /// Waits, and gives a step's memory back.
  void forget_step();
  struct Queued {
    std::int64_t step;
    BatchScales scales;
  };
  StepLosses losses_of(const StepSums& sums, const BatchScales& scales) const;
  Launch render_launch() const;
  void explain_fault(const std::function<void()>& on_the_host);

  Pipeline<float>& host_;
  DeviceOptions options_;
  cudaStream_t stream_ = nullptr;
  cudaStream_t beside_ = nullptr;  // semantic branches, which need nothing of the colour gradients; in a step alone
  cudaEvent_t forked_ = nullptr, joined_ = nullptr;
  std::unique_ptr<Store> store_;
  std::vector<Pass<float>> passes_;
  Workspace train_arena_, beside_arena_, render_arena_;
  std::int64_t chunk_rays_ = 16384;  // rendered at a time; halved where memory is short
  std::int64_t growths_ = 0;         // of a step's arenas when graphs were last forgotten
  std::unique_ptr<Staging> staging_;
  Buffer<float> class_weight_;
  Buffer<FaultKey> render_fault_;
  std::vector<Shape> shapes_;
  std::vector<Queued> queued_;
  std::vector<StepLosses> done_;
  GradientHook<float> hook_;
};

}  // namespace semfield::cuda
