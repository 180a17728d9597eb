#include "cuda/ranks/gradient_sums.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstring>
#include <thread>
#include <vector>

#include "core/error.h"
#include "core/process.h"
#include "cuda/steps/batch_drawer.h"

namespace semfield::cuda {

namespace {

// What a rank brings along.
struct Seat {
  std::array<char, sizeof(cudaUUID_t::bytes)> device{};
  int nccl = 0;  // its version; 0: none
};

// null: none.
const NcclLibrary* nccl_library([[maybe_unused]] std::string& why_not) {
#ifdef SEMFIELD_NCCL_LIBRARY
  try {
    static const NcclLibrary* const loaded = reinterpret_cast<const NcclLibrary* (*)()>(library_symbol(
        SEMFIELD_NCCL_LIBRARY, kNcclLibrarySymbol, "NCCL cannot be loaded", "install NCCL, or run on one device"))();
    return loaded;
  } catch (const Error& error) {
    why_not = error.message();
    return nullptr;
  }
#else
  why_not = "this build has no NCCL";
  return nullptr;
#endif
}

Seat own_seat(const NcclLibrary* library) {
  Seat seat;
  cudaDeviceProp found{};
  check(cudaGetDeviceProperties(&found, launch().ordinal), "asking for the device's properties");
  std::memcpy(seat.device.data(), found.uuid.bytes, seat.device.size());
  if (library != nullptr) seat.nccl = library->version();
  return seat;
}

// "" where NCCL can be used.
std::string hindrance(Ranks& ranks, const std::vector<Seat>& seats) {
  for (int r = 0; r < ranks.size(); ++r) {
    const Seat& seat = seats[static_cast<std::size_t>(r)];
    if (seat.nccl == 0) return ranks.name_of(r) + " has no NCCL";
    if (seat.nccl != seats.front().nccl) return ranks.name_of(r) + " has another version of NCCL than the first";
    for (int other = 0; other < r; ++other) {
      if (seats[static_cast<std::size_t>(other)].device == seat.device)
        return ranks.name_of(other) + " and " + ranks.name_of(r) + " share a device, which NCCL does not allow";
    }
  }
  return {};
}

constexpr std::size_t kPiece = std::size_t{1} << 20;  // numbers of a rank that the others get at once

// A device that waits for one whose process has ended waits for ever. So when this one fails, its process must end.
[[noreturn]] void end_with(cudaError_t state) {
  try {
    check(state, "waiting for the device");
  } catch (const Error& error) {
    throw RankLost(error.kind(), error.code(), error.message(), error.remedy());
  }
  throw RankLost(ErrorKind::internal, "internal.cuda.fault", "a device reported a failure without an error", "");
}

}  // namespace

RayRange rays_of(std::int64_t rays, int number, int parts) {
  const std::int64_t each = (rays + parts - 1) / parts;
  const std::int64_t begin = std::min(rays, number * each), end = std::min(rays, begin + each);
  return {begin, end - begin};
}

GradientSums::GradientSums(const DeviceOptions& options, std::span<float> gradients, std::vector<std::size_t> ends)
    : ranks_(options.trainable ? options.ranks : nullptr),
      deterministic_(options.deterministic),
      gradients_(gradients),
      ends_(std::move(ends)) {
  if (ranks_ == nullptr) return;
  check(cudaStreamCreateWithFlags(&between_, cudaStreamNonBlocking), "making a stream");
  check(cudaEventCreateWithFlags(&walked_, cudaEventDisableTiming), "making an event");
  check(cudaEventCreateWithFlags(&summed_, cudaEventDisableTiming), "making an event");
}

// The communicator goes first: a sum that waits for a rank that has ended is given up with it.
GradientSums::~GradientSums() {
  if (communicator_ != nullptr) nccl_->leave(communicator_);
  if (ranks_ == nullptr) return;
  (void)cudaStreamSynchronize(between_);
  (void)cudaEventDestroy(summed_);
  (void)cudaEventDestroy(walked_);
  (void)cudaStreamDestroy(between_);
}

void GradientSums::join() {
  if (ranks_ == nullptr || joined_) return;
  if (deterministic_ && ranks() > 1) {
    throw Error(ErrorKind::config, "ranks.deterministic.several",
                fmt::format("runtime.deterministic gives the bits of one GPU, and this run has {} processes", ranks()),
                "start one process, or set runtime.deterministic: false");
  }
  std::string why_not;
  nccl_ = nccl_library(why_not);
  Seat seat;
  semfield::agree(*ranks_, [&] { seat = own_seat(nccl_); });
  const std::string hindered = hindrance(*ranks_, all_of(*ranks_, seat));
  if (hindered.empty()) {
    try {
      join_nccl();
    } catch (const RankLost&) {
      throw;
    } catch (const Error& error) {  // all ranks have it
      why_not = error.message();
    }
  } else if (why_not.empty()) {
    why_not = hindered;
  }
  joined_ = true;
  if (!why_not.empty())
    notes_.push_back("gradients meet in the host's memory, which takes longer than NCCL: " + why_not);
}

void GradientSums::join_nccl() {
  std::vector<std::byte> id(nccl_->id_bytes);
  semfield::agree(*ranks_, [&] {
    if (rank() == 0) nccl_->make_id(id.data());
  });
  ranks_->broadcast(id);
  void* joined = nullptr;
  try {
    semfield::agree(*ranks_, [&] { joined = nccl_->join(id.data(), rank(), ranks()); });
  } catch (...) {
    if (joined != nullptr) nccl_->leave(joined);
    throw;
  }
  communicator_ = joined;
}

void GradientSums::reserve() {
  if (!waits() || all_) return;
  std::size_t most = 1, begin = 0;
  for (const std::size_t end : ends_) {
    most = std::max(most, end - begin);
    begin = end;
  }
  own_ = pinned<float>(most, "pinned memory of gradients");
  all_ = pinned<float>(std::min(most, kPiece) * static_cast<std::size_t>(ranks()), "pinned memory of gradients");
}

void GradientSums::agree(const std::function<void()>& work) {
  if (ranks_ == nullptr) return work();
  semfield::agree(*ranks_, [&] {
    if (pending_) throw Error(*std::exchange(pending_, std::nullopt));
    work();
  });
}

void GradientSums::afterwards(const std::function<void()>& work) {
  if (ranks_ == nullptr) return work();
  try {
    work();
  } catch (const RankLost&) {
    throw;
  } catch (const Error& error) {
    if (!waits()) throw RankLost(error.kind(), error.code(), error.message(), error.remedy());
    pending_ = error;
  }
}

void GradientSums::begin(bool overlapped) {
  overlapped_ = overlapped && communicator_ != nullptr;
  next_pass_ = 0;
}

// The last pass is meet's: with it goes the fault, which a later stage may still note.
void GradientSums::pass_done(std::size_t pass) {
  if (!overlapped_ || pass + 1 >= ends_.size()) return;
  sum_pass(pass, nullptr);
  next_pass_ = pass + 1;
}

// All sums are queued on one stream, in the same order on every rank, whether they overlap or not.
void GradientSums::sum_pass(std::size_t pass, FaultKey* fault) {
  const std::size_t begin = pass == 0 ? 0 : ends_[pass - 1];
  const std::span<float> block = gradients_.subspan(begin, ends_[pass] - begin);
  if (block.empty() && fault == nullptr) return;
  check(cudaEventRecord(walked_, launch().stream), "marking a pass");
  check(cudaStreamWaitEvent(between_, walked_, 0), "waiting for a pass");
  if (communicator_ != nullptr) return nccl_->sum(communicator_, block, fault, between_);
  sum_on_host(block, fault);
}

void GradientSums::sum_on_host(std::span<float> block, FaultKey* fault) {
  FaultKey own = kNoFault;
  semfield::agree(*ranks_, [&] {  // an error of one rank ends the wait of all
    if (!block.empty()) {
      check(cudaMemcpyAsync(own_.get(), block.data(), block.size_bytes(), cudaMemcpyDeviceToHost, between_),
            "fetching gradients");
    }
    if (fault != nullptr)
      check(cudaMemcpyAsync(&own, fault, sizeof own, cudaMemcpyDeviceToHost, between_), "fetching a fault");
    check(cudaStreamSynchronize(between_), "waiting for gradients");
  });
  const auto size = static_cast<std::size_t>(ranks());
  for (std::size_t begin = 0; begin < block.size(); begin += kPiece) {
    const std::size_t count = std::min(kPiece, block.size() - begin);
    const std::vector<std::size_t> bytes(size, count * sizeof(float));
    ranks_->all_gather(std::as_bytes(std::span(own_.get() + begin, count)),
                       std::as_writable_bytes(std::span(all_.get(), size * count)), bytes);
    for (std::size_t i = 0; i < count; ++i) {  // in the order of ranks, so that all get the same
      float total = all_.get()[i];
      for (std::size_t r = 1; r < size; ++r) total += all_.get()[r * count + i];
      own_.get()[begin + i] = total;
    }
  }
  if (fault != nullptr) {
    const std::vector<FaultKey> all = all_of(*ranks_, own);
    least_ = *std::min_element(all.begin(), all.end());
  }
  // The ranks need each other no more: what is left may fail on one alone.
  if (!block.empty()) {
    check(cudaMemcpyAsync(block.data(), own_.get(), block.size_bytes(), cudaMemcpyHostToDevice, between_),
          "sending gradients");
  }
  if (fault != nullptr)
    check(cudaMemcpyAsync(fault, &least_, sizeof least_, cudaMemcpyHostToDevice, between_), "sending a fault");
}

void GradientSums::meet(FaultKey* fault) {
  if (!joined_) return;
  for (std::size_t p = next_pass_; p < ends_.size(); ++p) sum_pass(p, p + 1 == ends_.size() ? fault : nullptr);
  check(cudaEventRecord(summed_, between_), "marking a sum");
  check(cudaStreamWaitEvent(launch().stream, summed_, 0), "waiting for a sum");
}

void GradientSums::wait() {
  if (communicator_ == nullptr) return synchronize();
  using Clock = std::chrono::steady_clock;
  constexpr std::chrono::milliseconds kSpin{1}, kWatch{50};
  constexpr std::chrono::microseconds kNap{20};
  const Clock::time_point begin = Clock::now();
  Clock::time_point next_watch = begin + kWatch;
  for (;;) {
    const cudaError_t state = cudaStreamQuery(launch().stream);
    if (state == cudaSuccess) return;
    if (state != cudaErrorNotReady) end_with(state);
    const Clock::time_point now = Clock::now();
    if (now >= next_watch) {
      nccl_->check(communicator_);
      ranks_->watch();
      next_watch = now + kWatch;
    }
    if (now - begin > kSpin) std::this_thread::sleep_for(kNap);
  }
}

std::vector<StepSums> GradientSums::of_all_ranks(std::span<const StepSums> mine) const {
  std::vector<StepSums> all(mine.size() * static_cast<std::size_t>(ranks()));
  if (ranks_ == nullptr) {
    std::copy(mine.begin(), mine.end(), all.begin());
    return all;
  }
  const std::vector<std::size_t> bytes(static_cast<std::size_t>(ranks()), mine.size_bytes());
  ranks_->all_gather(std::as_bytes(mine), std::as_writable_bytes(std::span(all)), bytes);
  return all;
}

}  // namespace semfield::cuda
