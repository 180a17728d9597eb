#include "cuda/steps/staging.h"

#include <algorithm>
#include <cstring>

#include "core/check.h"

namespace semfield::cuda {

namespace {

constexpr std::size_t kAlignBytes = 256;

// Rows of a contiguous view behind each other.
template <class T>
void put(std::byte* to, View<const T> from) {
  SEMFIELD_CHECK(!from.empty() && from.contiguous(), "rows of a batch lie behind each other");
  std::memcpy(to, from.data, static_cast<std::size_t>(from.size()) * sizeof(T));
}

}  // namespace

BatchLayout::BatchLayout(const RayBatch& like)
    : shape_(shape_of(like)), label_only_(like.label_only.data, like.label_only.data + shape_.tiles) {
  each_array(like, [this]<class T>(const View<const T>& view) {
    if (view.cols == 0) return;
    at_.push_back(bytes_);
    bytes_ += (static_cast<std::size_t>(view.size()) * sizeof(T) + kAlignBytes - 1) / kAlignBytes * kAlignBytes;
  });
}

bool BatchLayout::fits(const RayBatch& batch) const {
  const View<const std::int64_t>& counts = batch.label_only;
  return shape_of(batch) == shape_ && std::equal(label_only_.begin(), label_only_.end(), counts.data);
}

void BatchLayout::write(const RayBatch& batch, std::byte* block) const {
  std::size_t next = 0;
  each_array(batch, [&](const auto& view) {
    if (view.cols > 0) put(block + at_[next++], view);
  });
}

RayBatch BatchLayout::in(const std::byte* block) const {
  RayBatch out = shape_.batch();
  std::size_t next = 0;
  each_array(out, [&]<class T>(View<const T>& view) {
    if (view.cols == 0) return;
    view = {reinterpret_cast<const T*>(block + at_[next++]), view.rows, view.cols, view.cols, Device::cuda};
  });
  if (!label_only_.empty()) out.label_only = {label_only_.data(), std::ssize(label_only_), 1};
  return out;
}

Staging::Staging(int slots, const RayBatch& like) : layout_(like) {
  const std::size_t bytes = kCellBytes + layout_.bytes();
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
  std::memcpy(slot_at(slot), &cell, sizeof cell);
  layout_.write(batch, slot_at(slot) + kCellBytes);
  send_again(slot, nullptr);
}

void Staging::send(int slot, const StepCell& cell, const std::byte* drawn) {
  std::memcpy(slot_at(slot), &cell, sizeof cell);
  send_again(slot, drawn);
}

void Staging::send_again(int slot, const std::byte* drawn) {
  const std::size_t from_host = drawn == nullptr ? kCellBytes + layout_.bytes() : kCellBytes;
  check(cudaMemcpyAsync(device_.data(), slot_at(slot), from_host, cudaMemcpyHostToDevice, launch().stream),
        "sending a batch");
  if (drawn == nullptr) return;
  check(cudaMemcpyAsync(device_.data() + kCellBytes, drawn, layout_.bytes(), cudaMemcpyDeviceToDevice, launch().stream),
        "copying a batch");
}

void Staging::fetch(int slot) {
  check(cudaMemcpyAsync(&host_sums_[slot], device_sums_.data(), sizeof(StepSums), cudaMemcpyDeviceToHost,
                        launch().stream),
        "fetching sums");
}

}  // namespace semfield::cuda
