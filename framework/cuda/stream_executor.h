// Steps and rendering on a stream of one CUDA device.
#pragma once

#include <functional>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "cuda/kernels/kernels.h"
#include "cuda/launch.h"
#include "cuda/ranks/gradient_sums.h"
#include "cuda/steps/batch_drawer.h"
#include "cuda/store.h"
#include "execution/device_library.h"
#include "execution/lane_executor.h"
#include "execution/pipeline.h"

namespace semfield::cuda {

/// A step is: one copy of its batch to the device, one graph of every kernel from sampling to Adam, one copy of its
/// sums back, all queued without waiting. The graph is captured in the third step of a shape: the first sizes arenas
/// and chooses algorithms. A batch is walked as a whole, or this rank's part of it
/// (cuda/ranks/gradient_sums.h). Rays of a part beyond the last labelled one of any part carry no semantics; their
/// number is rounded to an eighth of a part, so that few shapes occur, the same ones on every rank.
///
/// With several ranks each has the whole batch, and ends a step with the same tensors. Samplers' states are refreshed
/// by every rank for itself, from the same tensors.
class StreamExecutor final : public Executor<float> {
 public:
  StreamExecutor(Pipeline<float>& host, std::vector<PassParts<float>> parts, const DeviceOptions& options);
  ~StreamExecutor() override;

  DeviceId device() const override { return {Device::cuda, options_.ordinal}; }
  std::string description() const override;
  std::string matrix_products() const override { return "cuBLASLt and our own"; }
  void upload(std::int64_t step) override;
  void download(std::int64_t step) override;
  std::int64_t tile_rays(std::int64_t rays) const override;
  void queue(std::int64_t step, const RayBatch& batch, const AdamStep& update) override;
  bool hold(const PixelPool& pool) override;
  void queue_drawn(std::int64_t step, std::uint32_t terms, const AdamStep& update) override;
  int most_queued() const override { return kSlots; }
  StepResults finish() override;
  std::vector<std::string> take_notes() override;
  void render(const RenderJob<float>& job) override;
  void density(View<const double> positions, View<float> sigma) override;
  PointNetwork<float>& points() override;

  SampleRoom& sample_room() { return room_; }

 private:
  static constexpr int kSlots = 32;
  static constexpr int kGroups = 8;  // shapes of a step: eighths of a part with semantics

  // One shape of a step: how many rays of a part have semantics, and which terms of the loss there are.
  struct Shape {
    std::int64_t semantic_rays = 0;
    std::uint32_t terms = 0;  // of the loss that work: LossScales::active
    int runs = 0;
    cudaGraphExec_t graphs[2] = {};  // two where the host works between backward and update
    bool captured() const { return runs >= kRunsBeforeCapture; }
  };
  static constexpr int kRunsBeforeCapture = 2;  // a capture must find the arenas grown
  struct Queued {
    std::int64_t step;
    BatchScales scales;
    std::int64_t semantic_rays;
    std::uint32_t terms;
    bool drawn;
  };
  Launch step_launch() const;
  StepContext context(std::int64_t step, bool training, Workspace& arena) const;
  Shape& known_shape(std::int64_t semantic_rays, std::uint32_t terms);
  /// A step of the batch in `slot`, which `prepare` sends to the device; it gives the step's shape.
  Shape& run_step(std::int64_t step, int slot, const std::function<Shape&()>& prepare);
  /// The steps in slots from `first` on, with room for all samples.
  void run_again(std::span<const Queued> queued, std::size_t first);
  /// drawn: where the batch lies on the device; null: `batch` is all of it.
  Shape& stage(const StepCell& cell, const RayBatch& batch, const BatchScales& scales, const std::byte* drawn);
  void queue_batch(std::int64_t step, const RayBatch& batch, const AdamStep& update, const std::byte* drawn);
  /// The part of a step on which no other rank relies: backward, or the graphs that hold it.
  void begin_step(Shape& shape, std::int64_t step);
  void end_step(Shape& shape, std::int64_t step);
  void drop_gradients();
  void capture(cudaGraphExec_t& graph, const std::function<void()>& body);
  void backward(const Shape& shape, std::int64_t step, bool overlapped);
  void update(std::int64_t step);
  void derive(const StepContext& ctx) const;
  void walk(const Shape& shape, std::int64_t step, std::int64_t most);
  class Walk;
  class Points;
  std::int64_t growths() const;
  /// The error of a step that did not fit, with settings that do.
  Error with_settings_that_fit(const Error& error, const Shape& shape, std::int64_t step);
  void forget_graphs();
  /// Waits, and gives a step's memory back.
  void forget_step();
  /// Of the batch; `sums`: of each rank.
  StepLosses losses_of(std::span<const StepSums* const> sums, const BatchScales& scales) const;
  /// Of a call that is no step, with its fault reset.
  Launch begin_call() const;
  void explain_fault(const std::function<void()>& on_the_host);

  Pipeline<float>& host_;
  DeviceOptions options_;
  std::vector<DeviceLoss> losses_;  // of the list, in its order
  cudaStream_t stream_ = nullptr;
  cudaStream_t beside_ = nullptr;  // semantic branches, which need nothing of the colour gradients; in a step alone
  cudaEvent_t forked_ = nullptr, joined_ = nullptr;
  std::unique_ptr<Store> store_;
  std::vector<Pass<float>> passes_;
  std::optional<CameraCorrections<float>> cameras_;
  std::unique_ptr<GradientSums> sums_;
  SampleRoom room_, reached_room_;  // of samples that are drawn, and that light reaches
  std::unique_ptr<BatchDrawer> drawer_;
  std::vector<std::string> notes_;
  bool told_of_pixels_ = false;
  Workspace train_arena_, beside_arena_, render_arena_;
  std::int64_t chunk_rays_ = 16384;   // rendered at a time; halved where memory is short
  std::int64_t growths_ = 0;          // of a step's arenas when graphs were last forgotten
  std::unique_ptr<Staging> staging_;  // of this rank's rays
  std::int64_t rays_ = 0;             // of a whole batch
  double color_normaliser_ = 1;       // of a whole batch
  Buffer<float> class_weight_;
  Buffer<FaultKey> render_fault_;
  std::vector<Shape> shapes_;
  std::vector<Queued> queued_;
  std::vector<StepLosses> done_;
  std::unique_ptr<PointNetwork<float>> points_;
};

}  // namespace semfield::cuda
