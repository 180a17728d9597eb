// Gradients that meet by NCCL, from device to device; a library of its own.
#include <nccl.h>

#include <chrono>
#include <cstdlib>
#include <cstring>
#include <string>
#include <thread>

#include "core/error.h"
#include "cuda/ranks/exchange.h"

namespace semfield::cuda {

namespace {

static_assert(sizeof(FaultKey) == 8);

void check_nccl(ncclResult_t status, const char* what, ncclComm_t of = nullptr) {
  if (status == ncclSuccess) return;
  const char* const more = ncclGetLastError(of);
  std::string message = std::string("NCCL: ") + what + ": " + ncclGetErrorString(status);
  if (more != nullptr && *more != '\0') message += std::string(" (") + more + ")";
  throw Error(ErrorKind::failure, "device.nccl.failed", message,
              "set NCCL_DEBUG=INFO to see why, or train on one device");
}

class NcclExchange final : public RankExchange {
 public:
  NcclExchange(const ncclUniqueId& id, Ranks& ranks) : ranks_(ranks) {
    check_nccl(ncclCommInitRank(&all_, ranks.size(), id, ranks.rank()), "joining the other devices");
  }
  // Nothing is under way, or a rank has ended for which the others must not wait.
  ~NcclExchange() override { (void)ncclCommAbort(all_); }

  bool queues() const override { return true; }
  void reserve(std::size_t) override {}

  void sum(std::span<float> block, FaultKey* fault, cudaStream_t stream) override {
    together(fault, stream, [&] {
      if (block.empty()) return ncclSuccess;
      return ncclAllReduce(block.data(), block.data(), block.size(), ncclFloat32, ncclSum, all_, stream);
    });
  }

  // A device that waits for one whose process has ended waits for ever. So when this one fails, its process must end.
  void wait(cudaStream_t stream) override {
    using Clock = std::chrono::steady_clock;
    constexpr std::chrono::milliseconds kSpin{1}, kWatch{50};
    constexpr std::chrono::microseconds kNap{20};
    const Clock::time_point begin = Clock::now();
    Clock::time_point next_watch = begin + kWatch;
    for (;;) {
      const cudaError_t state = cudaStreamQuery(stream);
      if (state == cudaSuccess) return;
      if (state != cudaErrorNotReady) end_with(state);
      const Clock::time_point now = Clock::now();
      if (now >= next_watch) {
        ncclResult_t own = ncclSuccess;
        check_nccl(ncclCommGetAsyncError(all_, &own), "asking after the other devices", all_);
        if (own != ncclInProgress) check_nccl(own, "exchanging gradients", all_);
        ranks_.watch();
        next_watch = now + kWatch;
      }
      if (now - begin > kSpin) std::this_thread::sleep_for(kNap);
    }
  }

 private:
  [[noreturn]] static void end_with(cudaError_t state) {
    try {
      check(state, "waiting for the device");
    } catch (const Error& error) {
      throw RankLost(error.kind(), error.code(), error.message(), error.remedy());
    }
    throw RankLost(ErrorKind::internal, "internal.cuda.fault", "a device reported a failure without an error", "");
  }
  // `call`, and the fault's least, as one launch.
  template <class Call>
  void together(FaultKey* fault, cudaStream_t stream, const Call& call) {
    check_nccl(ncclGroupStart(), "exchanging gradients", all_);
    const ncclResult_t first = call();
    ncclResult_t second = ncclSuccess;
    if (fault != nullptr) second = ncclAllReduce(fault, fault, 1, ncclUint64, ncclMin, all_, stream);
    const ncclResult_t end = ncclGroupEnd();
    for (const ncclResult_t status : {first, second, end}) check_nccl(status, "exchanging gradients", all_);
  }

  Ranks& ranks_;
  ncclComm_t all_ = nullptr;
};

int version() {
  int number = 0;
  check_nccl(ncclGetVersion(&number), "asking for its version");
  return number;
}

void make_id(std::byte* id) {
  ncclUniqueId made;
  check_nccl(ncclGetUniqueId(&made), "making an address");
  std::memcpy(id, &made, sizeof made);
}

std::unique_ptr<RankExchange> join(const std::byte* id, Ranks& ranks) {
  // Ranks may capture a step at different times: buffers of graphs must not be registered, which all would have to do
  // at once.
  (void)::setenv("NCCL_GRAPH_REGISTER", "0", 0);
  ncclUniqueId made;
  std::memcpy(&made, id, sizeof made);
  return std::make_unique<NcclExchange>(made, ranks);
}

}  // namespace

}  // namespace semfield::cuda

extern "C" const semfield::cuda::NcclLibrary* semfield_nccl_library();
extern "C" const semfield::cuda::NcclLibrary* semfield_nccl_library() {
  using namespace semfield::cuda;
  static const NcclLibrary library{sizeof(ncclUniqueId), version, make_id, join};
  return &library;
}
