// Gradients that meet in the host's memory: where NCCL is missing, or where ranks share a device.
#include <algorithm>
#include <optional>
#include <vector>

#include "core/error.h"
#include "cuda/ranks/exchange.h"

namespace semfield::cuda {

namespace {

constexpr std::size_t kPiece = std::size_t{1} << 20;  // numbers of a rank that the others get at once

// Page-locked memory of the host.
class Pinned {
 public:
  Pinned() = default;
  Pinned(const Pinned&) = delete;
  Pinned& operator=(const Pinned&) = delete;
  ~Pinned() { (void)cudaFreeHost(data_); }
  /// Nothing may be on its way to or from it.
  void reserve(std::size_t count) {
    if (count <= size_) return;
    (void)cudaFreeHost(data_);
    data_ = nullptr;
    size_ = 0;
    void* memory = nullptr;
    check(cudaMallocHost(&memory, count * sizeof(float)), "pinned memory of gradients");
    data_ = static_cast<float*>(memory);
    size_ = count;
  }
  float* data() const { return data_; }

 private:
  float* data_ = nullptr;
  std::size_t size_ = 0;
};

class HostExchange final : public RankExchange {
 public:
  explicit HostExchange(Ranks& ranks) : ranks_(ranks) {}

  bool queues() const override { return false; }
  void reserve(std::size_t most) override {
    most = std::max<std::size_t>(most, 1);
    own_.reserve(most);
    all_.reserve(std::min(most, kPiece) * size());
  }

  // What is left of a call when the ranks need each other no more may fail on one rank alone.
  void sum(std::span<float> block, FaultKey* fault, cudaStream_t stream) override {
    const FaultKey own = fetch(block.data(), block.size(), fault, stream);
    for (std::size_t begin = 0; begin < block.size(); begin += kPiece) {
      const std::size_t count = std::min(kPiece, block.size() - begin);
      gather_piece(begin, count);
      for (std::size_t i = 0; i < count; ++i) {  // in the order of ranks, so that all get the same
        float total = all_.data()[i];
        for (std::size_t r = 1; r < size(); ++r) total += all_.data()[r * count + i];
        own_.data()[begin + i] = total;
      }
    }
    find_least(own, fault);
    put(own_.data(), block.data(), block.size(), stream);
    put_fault(fault, stream);
  }

  void gather(float* blocks, std::size_t each, FaultKey* fault, cudaStream_t stream) override {
    const auto own = static_cast<std::size_t>(ranks_.rank());
    const FaultKey key = fetch(blocks + own * each, each, fault, stream);
    std::optional<Error> failed;
    for (std::size_t begin = 0; begin < each; begin += kPiece) {
      const std::size_t count = std::min(kPiece, each - begin);
      gather_piece(begin, count);
      if (failed) continue;
      try {
        for (std::size_t r = 0; r < size(); ++r) {
          if (r != own) put(all_.data() + r * count, blocks + r * each + begin, count, stream);
        }
        check(cudaStreamSynchronize(stream), "waiting for gradients");  // the next piece takes their place
      } catch (const Error& error) {
        failed = error;  // the others still wait for this rank's pieces
      }
    }
    find_least(key, fault);
    if (failed) throw Error(*failed);
    put_fault(fault, stream);
  }

  void wait(cudaStream_t stream) override { check(cudaStreamSynchronize(stream), "waiting for the device"); }

 private:
  std::size_t size() const { return static_cast<std::size_t>(ranks_.size()); }

  // This rank's numbers into own_, and its fault. An error of one rank ends the wait of all.
  FaultKey fetch(const float* from, std::size_t count, const FaultKey* fault, cudaStream_t stream) {
    FaultKey key = kNoFault;
    agree(ranks_, [&] {
      if (count > 0) {
        check(cudaMemcpyAsync(own_.data(), from, count * sizeof(float), cudaMemcpyDeviceToHost, stream),
              "fetching gradients");
      }
      if (fault != nullptr)
        check(cudaMemcpyAsync(&key, fault, sizeof key, cudaMemcpyDeviceToHost, stream), "fetching a fault");
      check(cudaStreamSynchronize(stream), "waiting for gradients");
    });
    return key;
  }
  // all_ [size, count] = the piece of every rank's numbers.
  void gather_piece(std::size_t begin, std::size_t count) {
    const std::vector<std::size_t> bytes(size(), count * sizeof(float));
    ranks_.all_gather(std::as_bytes(std::span(own_.data() + begin, count)),
                      std::as_writable_bytes(std::span(all_.data(), size() * count)), bytes);
  }
  static void put(const float* from, float* to, std::size_t count, cudaStream_t stream) {
    if (count == 0) return;
    check(cudaMemcpyAsync(to, from, count * sizeof(float), cudaMemcpyHostToDevice, stream), "sending gradients");
  }
  void find_least(FaultKey own, const FaultKey* fault) {
    if (fault == nullptr) return;
    const std::vector<FaultKey> all = all_of(ranks_, own);
    least_ = *std::min_element(all.begin(), all.end());
  }
  void put_fault(FaultKey* fault, cudaStream_t stream) const {
    if (fault == nullptr) return;
    check(cudaMemcpyAsync(fault, &least_, sizeof least_, cudaMemcpyHostToDevice, stream), "sending a fault");
  }

  Ranks& ranks_;
  Pinned own_, all_;
  FaultKey least_ = kNoFault;
};

}  // namespace

std::unique_ptr<RankExchange> host_exchange(Ranks& ranks) { return std::make_unique<HostExchange>(ranks); }

}  // namespace semfield::cuda
