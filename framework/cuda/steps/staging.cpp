#include "cuda/steps/staging.h"

#include <cstring>

#include "core/check.h"

namespace semfield::cuda {

namespace {

constexpr std::size_t kAlignBytes = 256;

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

BatchLayout::BatchLayout(const RayBatch& like)
    : rays(like.origin.rows),
      has_labels(!like.label.empty()),
      has_depth(!like.depth.empty()),
      soft_classes(soft_classes_of(like)),
      label_only_share(like.label_only_share) {
  const auto place = [this](std::size_t bytes) {
    const std::size_t begin = total;
    total += (bytes + kAlignBytes - 1) / kAlignBytes * kAlignBytes;
    return begin;
  };
  const auto n = static_cast<std::size_t>(rays);
  origin = place(3 * n * sizeof(double));
  direction = place(3 * n * sizeof(double));
  near_far = place(2 * n * sizeof(double));
  target = place(3 * n * sizeof(float));
  label = place(has_labels ? n * sizeof(std::int16_t) : 0);
  soft = place(n * static_cast<std::size_t>(soft_classes) * sizeof(float));
  depth = place(has_depth ? n * sizeof(float) : 0);
}

bool BatchLayout::fits(const RayBatch& batch) const {
  return batch.origin.rows == rays && batch.label.empty() != has_labels && batch.depth.empty() != has_depth &&
         soft_classes_of(batch) == soft_classes && batch.label_only_share == label_only_share;
}

RayBatch BatchLayout::in(const std::byte* block) const {
  const auto view = [&]<class T>(std::size_t at, std::int32_t cols, T*) {
    return View<const T>(reinterpret_cast<const T*>(block + at), rays, cols, cols, Device::cuda);
  };
  RayBatch out;
  out.origin = view(origin, 3, static_cast<double*>(nullptr));
  out.direction = view(direction, 3, static_cast<double*>(nullptr));
  out.near_far = view(near_far, 2, static_cast<double*>(nullptr));
  out.target = view(target, 3, static_cast<float*>(nullptr));
  if (has_labels) out.label = view(label, 1, static_cast<std::int16_t*>(nullptr));
  if (soft_classes > 0) out.soft = view(soft, soft_classes, static_cast<float*>(nullptr));
  if (has_depth) out.depth = view(depth, 1, static_cast<float*>(nullptr));
  out.label_only_share = label_only_share;
  return out;
}

Staging::Staging(int slots, const RayBatch& like) : at_(like) {
  const std::size_t bytes = kCellBytes + at_.total;
  host_ = pinned<std::byte>(static_cast<std::size_t>(slots) * bytes, "pinned memory of batches");
  host_sums_ = pinned<StepSums>(static_cast<std::size_t>(slots), "pinned memory of sums");
  device_ = Buffer<std::byte>(bytes, "batch of rays");
  device_sums_ = Buffer<std::byte>(sizeof(StepSums), "sums of a step");
  check(cudaMemsetAsync(device_sums_.data(), 0xFF, sizeof(FaultKey), launch().stream), "resetting a fault");
}

Staging::~Staging() {
  (void)cudaFreeHost(host_);
  (void)cudaFreeHost(host_sums_);
}

void Staging::send(int slot, const StepCell& cell, const RayBatch& batch) {
  std::byte* const block = slot_at(slot);
  std::memcpy(block, &cell, sizeof cell);
  put(block + kCellBytes + at_.origin, batch.origin);
  put(block + kCellBytes + at_.direction, batch.direction);
  put(block + kCellBytes + at_.near_far, batch.near_far);
  put(block + kCellBytes + at_.target, batch.target);
  put(block + kCellBytes + at_.label, batch.label);
  put(block + kCellBytes + at_.soft, batch.soft);
  put(block + kCellBytes + at_.depth, batch.depth);
  send_again(slot, nullptr);
}

void Staging::send(int slot, const StepCell& cell, const std::byte* drawn) {
  std::memcpy(slot_at(slot), &cell, sizeof cell);
  send_again(slot, drawn);
}

void Staging::send_again(int slot, const std::byte* drawn) {
  const std::size_t from_host = drawn == nullptr ? kCellBytes + at_.total : kCellBytes;
  check(cudaMemcpyAsync(device_.data(), slot_at(slot), from_host, cudaMemcpyHostToDevice, launch().stream),
        "sending a batch");
  if (drawn == nullptr) return;
  check(cudaMemcpyAsync(device_.data() + kCellBytes, drawn, at_.total, cudaMemcpyDeviceToDevice, launch().stream),
        "copying a batch");
}

void Staging::fetch(int slot) {
  check(cudaMemcpyAsync(&host_sums_[slot], device_sums_.data(), sizeof(StepSums), cudaMemcpyDeviceToHost,
                        launch().stream),
        "fetching sums");
}

}  // namespace semfield::cuda
