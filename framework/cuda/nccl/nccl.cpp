// Gradients that meet by NCCL, from device to device; a library of its own.
#include <nccl.h>

#include <cstdlib>
#include <cstring>
#include <string>

#include "core/error.h"
#include "cuda/ranks/gradient_sums.h"

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

ncclComm_t comm(void* communicator) { return static_cast<ncclComm_t>(communicator); }

void* join(const std::byte* id, int rank, int ranks) {
  // Ranks may capture a step at different times: buffers of graphs must not be registered, which all would have to do
  // at once.
  (void)::setenv("NCCL_GRAPH_REGISTER", "0", 0);
  ncclUniqueId made;
  std::memcpy(&made, id, sizeof made);
  ncclComm_t all = nullptr;
  check_nccl(ncclCommInitRank(&all, ranks, made, rank), "joining the other devices");
  return all;
}

void leave(void* communicator) { (void)ncclCommAbort(comm(communicator)); }

// Both sums as one launch.
void sum(void* communicator, std::span<float> block, FaultKey* fault, cudaStream_t stream) {
  const ncclComm_t all = comm(communicator);
  const auto reduce = [&](auto* data, std::size_t count, ncclDataType_t type, ncclRedOp_t how) {
    return count == 0 ? ncclSuccess : ncclAllReduce(data, data, count, type, how, all, stream);
  };
  check_nccl(ncclGroupStart(), "exchanging gradients", all);
  const ncclResult_t first = reduce(block.data(), block.size(), ncclFloat32, ncclSum);
  const ncclResult_t second = reduce(fault, fault == nullptr ? 0 : 1, ncclUint64, ncclMin);
  const ncclResult_t end = ncclGroupEnd();
  for (const ncclResult_t status : {first, second, end}) check_nccl(status, "exchanging gradients", all);
}

void check_others(void* communicator) {
  ncclResult_t own = ncclSuccess;
  check_nccl(ncclCommGetAsyncError(comm(communicator), &own), "asking after the other devices", comm(communicator));
  if (own != ncclInProgress) check_nccl(own, "exchanging gradients", comm(communicator));
}

}  // namespace

}  // namespace semfield::cuda

extern "C" const semfield::cuda::NcclLibrary* semfield_nccl_library();
extern "C" const semfield::cuda::NcclLibrary* semfield_nccl_library() {
  using namespace semfield::cuda;
  static const NcclLibrary library{sizeof(ncclUniqueId), version, make_id, join, leave, sum, check_others};
  return &library;
}
