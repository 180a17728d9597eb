// What the processes of a run share: the lanes of a step on the CPU, and steps and rendering by all, where rank 0 says
// what is done and everyone does it.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "execution/pipeline.h"
#include "execution/ranks/ranks.h"

namespace semfield {

/// Rows of an encoder that learns, and the gradient at its outputs.
template <class Real>
struct EncodedRows {
  View<const double> x;        ///< [M, 3]
  View<const Real> d_encoded;  ///< [M, D]
};

/// Rank r has a range of lanes, and those of rank r + 1 follow them. Where some lanes have a tile more than others, the
/// ranges are as long as it takes for ranks to have equally many tiles. Every call is made by all ranks.
template <class Real>
class LaneRanks {
 public:
  LaneRanks(Ranks& ranks, int lanes);

  Ranks& all() const { return *ranks_; }
  /// Lanes of this process.
  int first() const { return first_of(ranks_->rank()); }
  int end() const { return first_of(ranks_->rank() + 1); }

  /// Before a step of so many tiles.
  void share_out(std::int64_t tiles);
  /// In: the losses of the tiles of own lanes. Out: of all.
  void gather_losses(std::vector<StepLosses>& tiles);
  /// Rows of all lanes in lane order, from those of own lanes; valid until the next call.
  EncodedRows<Real> gather_rows(const EncodedRows<Real>& own);
  /// Calls compute(begin, end) for this rank's part of the rows of `column` [N, 1], and brings those of the others.
  void share_rows(View<Real> column, const std::function<void(std::int64_t begin, std::int64_t end)>& compute);
  /// ParamStore::reduce_lanes over the lanes of all: the sum goes from rank to rank, each of which adds its lanes to
  /// it, and the last one's goes to all. A process sends and receives each gradient twice at most, however many there
  /// are.
  void sum_lanes(ParamStore<Real>& store);

 private:
  int first_of(int rank) const { return first_.empty() ? 0 : first_[static_cast<std::size_t>(rank)]; }

  Ranks* ranks_;
  int lanes_;
  std::vector<int> first_;  // [ranks + 1] lanes; none before a step
  std::vector<double> x_;
  std::vector<Real> d_encoded_;
};

/// Rank 0's program uses it as any other executor; the other ranks call serve(), which does what rank 0 is asked for.
/// A step is made by the inner executors of all ranks, each of which takes its share of the whole batch and ends with
/// the same tensors; rays and positions to render are shared here, a row of them each. An Error of a step or a frame is
/// that of one process: the ranks agree on it.
class RanksExecutor final : public Executor<float> {
 public:
  /// Borrows ranks and pipeline. `device` knows of the other ranks; null: the CPU's lanes, which are shared from
  /// now on.
  RanksExecutor(Ranks& ranks, Pipeline<float>& pipeline, std::unique_ptr<Executor<float>> device);
  /// Rank 0: the others leave serve().
  ~RanksExecutor() override;

  /// What the others do, until rank 0's executor ends. Throws RankLost, and Error(internal) where the ranks differ.
  void serve();

  DeviceId device() const override { return inner_.device(); }
  std::string description() const override;
  std::string matrix_products() const override { return inner_.matrix_products(); }
  std::int64_t tile_rays(std::int64_t rays) const override { return inner_.tile_rays(rays); }
  int most_queued() const override { return inner_.most_queued(); }
  std::vector<std::string> take_notes() override { return inner_.take_notes(); }

  void upload(std::int64_t step) override;
  /// Throws Error(failure) where the tensors of a rank differ from rank 0's.
  void download(std::int64_t step) override;
  void queue(std::int64_t step, const RayBatch& batch, const AdamStep& update) override;
  StepResults finish() override;
  void render(const RenderJob<float>& job) override;
  void density(View<const double> positions, View<float> sigma) override;

 private:
  enum class Task : std::int32_t { end, upload, compare, queue, finish, render, density };
  static constexpr std::size_t kMostArrays = 16;
  // What is broadcast before the data of a task.
  struct Order {
    Task task = Task::end;
    std::uint32_t terms = 0;  // RayBatch::terms
    std::int64_t step = 0, rows = 0;
    double footprint_per_m = 0;
    AdamStep update{};
    BatchShape shape{};
    std::array<std::int32_t, kMostArrays> cols{};  // of each array of a job; 0: it is not there
  };

  bool leads() const { return ranks_.rank() == 0; }
  void tell(const Order& order);
  void share_tensors();
  void compare_tensors();
  void serve_step(const Order& order);
  void lead_job(Order order, RenderJob<float> job);
  void share(const Order& order, RenderJob<float> job);

  Ranks& ranks_;
  Pipeline<float>& pipeline_;
  std::unique_ptr<Executor<float>> device_;
  Executor<float>& inner_;
  std::vector<std::byte> message_;
  std::vector<std::int64_t> label_only_;
};

}  // namespace semfield
