#include "cuda/staging.h"

#include <algorithm>
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

}  // namespace

Staging::Staging(int slots, const RayBatch& like)
    : shape_(shape_of(like)), label_only_(like.label_only.data, like.label_only.data + shape_.tiles) {
  const auto place = [this](std::size_t bytes) {
    const std::size_t begin = total_;
    total_ += (bytes + kAlignBytes - 1) / kAlignBytes * kAlignBytes;
    return begin;
  };
  (void)place(sizeof(StepCell));
  each_array(like, [&]<class T>(const View<const T>& view) {
    if (!view.empty()) at_.push_back(place(static_cast<std::size_t>(view.size()) * sizeof(T)));
  });
  host_ = pinned<std::byte>(static_cast<std::size_t>(slots) * total_, "pinned memory of batches");
  host_sums_ = pinned<StepSums>(static_cast<std::size_t>(slots), "pinned memory of sums");
  device_ = Buffer<std::byte>(total_, "batch of rays");
  device_sums_ = Buffer<std::byte>(sizeof(StepSums), "sums of a step");
  check(cudaMemsetAsync(device_sums_.data(), 0xFF, sizeof(FaultKey), launch().stream), "resetting a fault");
}

Staging::~Staging() {
  (void)cudaFreeHost(host_);
  (void)cudaFreeHost(host_sums_);
}

bool Staging::fits(const RayBatch& batch) const {
  const View<const std::int64_t>& counts = batch.label_only;
  return shape_of(batch) == shape_ && std::equal(label_only_.begin(), label_only_.end(), counts.data);
}

void Staging::send(int slot, const StepCell& cell, const RayBatch& batch) {
  std::byte* const block = host_ + static_cast<std::size_t>(slot) * total_;
  std::memcpy(block, &cell, sizeof cell);
  std::size_t next = 0;
  each_array(batch, [&](const auto& view) {
    if (!view.empty()) put(block + at_[next++], view);
  });
  send_again(slot);
}

void Staging::send_again(int slot) {
  check(cudaMemcpyAsync(device_.data(), host_ + static_cast<std::size_t>(slot) * total_, total_,
                        cudaMemcpyHostToDevice, launch().stream),
        "sending a batch");
}

void Staging::fetch(int slot) {
  check(cudaMemcpyAsync(&host_sums_[slot], device_sums_.data(), sizeof(StepSums), cudaMemcpyDeviceToHost,
                        launch().stream),
        "fetching sums");
}

RayBatch Staging::batch() const {
  RayBatch out = shape_.batch();
  std::size_t next = 0;
  each_array(out, [&]<class T>(View<const T>& view) {
    if (view.cols == 0) return;
    view = {reinterpret_cast<const T*>(device_.data() + at_[next++]), view.rows, view.cols, view.cols, Device::cuda};
  });
  if (!label_only_.empty()) out.label_only = {label_only_.data(), std::ssize(label_only_), 1};
  return out;
}

}  // namespace semfield::cuda
