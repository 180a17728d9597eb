#include "cuda/staging.h"

#include <cstring>

#include "core/check.h"

namespace semfield::cuda {

namespace {

constexpr std::size_t kAlignBytes = 256;

template <class T>
T* pinned(std::size_t count, const char* what) {
  void* memory = nullptr;
  check(cudaMallocHost(&memory, count * sizeof(T)), what);
  return static_cast<T*>(memory);
}

// Rows of a contiguous view behind each other.
template <class T>
void put(std::byte* to, View<const T> from) {
  if (from.empty()) return;
  SEMFIELD_CHECK(from.contiguous(), "rows of a batch lie behind each other");
  std::memcpy(to, from.data, static_cast<std::size_t>(from.size()) * sizeof(T));
}

std::int32_t soft_classes_of(const RayBatch& batch) { return batch.soft.empty() ? 0 : batch.soft.cols; }

}  // namespace

RayBatch rows_of(const RayBatch& batch, std::int64_t begin, std::int64_t count) {
  const auto rows = [&](const auto& view) { return view.empty() ? view : view.row_range(begin, count); };
  RayBatch out;
  out.origin = rows(batch.origin);
  out.direction = rows(batch.direction);
  out.near_far = rows(batch.near_far);
  out.target = rows(batch.target);
  out.label = rows(batch.label);
  out.soft = rows(batch.soft);
  out.depth = rows(batch.depth);
  out.label_only_share = batch.label_only_share;
  return out;
}

Staging::Staging(int slots, const RayBatch& like)
    : rays_(like.origin.rows),
      has_labels_(!like.label.empty()),
      has_depth_(!like.depth.empty()),
      soft_classes_(soft_classes_of(like)),
      label_only_share_(like.label_only_share) {
  std::size_t end = 0;
  const auto place = [&end](std::size_t bytes) {
    const std::size_t begin = end;
    end += (bytes + kAlignBytes - 1) / kAlignBytes * kAlignBytes;
    return begin;
  };
  const auto n = static_cast<std::size_t>(rays_);
  place(sizeof(StepCell));
  at_.origin = place(3 * n * sizeof(double));
  at_.direction = place(3 * n * sizeof(double));
  at_.near_far = place(2 * n * sizeof(double));
  at_.target = place(3 * n * sizeof(float));
  at_.label = place(has_labels_ ? n * sizeof(std::int16_t) : 0);
  at_.soft = place(n * static_cast<std::size_t>(soft_classes_) * sizeof(float));
  at_.depth = place(has_depth_ ? n * sizeof(float) : 0);
  at_.total = end;
  host_ = pinned<std::byte>(static_cast<std::size_t>(slots) * at_.total, "pinned memory of batches");
  host_sums_ = pinned<StepSums>(static_cast<std::size_t>(slots), "pinned memory of sums");
  device_ = Buffer<std::byte>(at_.total, "batch of rays");
  device_sums_ = Buffer<std::byte>(sizeof(StepSums), "sums of a step");
  check(cudaMemsetAsync(device_sums_.data(), 0xFF, sizeof(FaultKey), launch().stream), "resetting a fault");
}

Staging::~Staging() {
  (void)cudaFreeHost(host_);
  (void)cudaFreeHost(host_sums_);
}

bool Staging::fits(const RayBatch& batch) const {
  return batch.origin.rows == rays_ && batch.label.empty() != has_labels_ && batch.depth.empty() != has_depth_ &&
         soft_classes_of(batch) == soft_classes_ && batch.label_only_share == label_only_share_;
}

void Staging::send(int slot, const StepCell& cell, const RayBatch& batch) {
  std::byte* const block = host_ + static_cast<std::size_t>(slot) * at_.total;
  std::memcpy(block, &cell, sizeof cell);
  put(block + at_.origin, batch.origin);
  put(block + at_.direction, batch.direction);
  put(block + at_.near_far, batch.near_far);
  put(block + at_.target, batch.target);
  put(block + at_.label, batch.label);
  put(block + at_.soft, batch.soft);
  put(block + at_.depth, batch.depth);
  send_again(slot);
}

void Staging::send_again(int slot) {
  check(cudaMemcpyAsync(device_.data(), host_ + static_cast<std::size_t>(slot) * at_.total, at_.total,
                        cudaMemcpyHostToDevice, launch().stream),
        "sending a batch");
}

void Staging::fetch(int slot) {
  check(cudaMemcpyAsync(&host_sums_[slot], device_sums_.data(), sizeof(StepSums), cudaMemcpyDeviceToHost,
                        launch().stream),
        "fetching sums");
}

RayBatch Staging::batch() const {
  const auto view = [&]<class T>(std::size_t at, std::int32_t cols, T*) {
    return View<const T>(reinterpret_cast<const T*>(device_.data() + at), rays_, cols, cols, Device::cuda);
  };
  RayBatch out;
  out.origin = view(at_.origin, 3, static_cast<double*>(nullptr));
  out.direction = view(at_.direction, 3, static_cast<double*>(nullptr));
  out.near_far = view(at_.near_far, 2, static_cast<double*>(nullptr));
  out.target = view(at_.target, 3, static_cast<float*>(nullptr));
  if (has_labels_) out.label = view(at_.label, 1, static_cast<std::int16_t*>(nullptr));
  if (soft_classes_ > 0) out.soft = view(at_.soft, soft_classes_, static_cast<float*>(nullptr));
  if (has_depth_) out.depth = view(at_.depth, 1, static_cast<float*>(nullptr));
  out.label_only_share = label_only_share_;
  return out;
}

}  // namespace semfield::cuda
