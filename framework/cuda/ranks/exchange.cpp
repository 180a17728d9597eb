#include "cuda/ranks/exchange.h"

#include <algorithm>
#include <array>
#include <cstring>
#include <vector>

#include "core/error.h"
#include "cuda/ranks/nccl_library.h"
#include "system/shared_library.h"

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

}  // namespace

std::unique_ptr<RankExchange> meet_ranks(Ranks& ranks, std::string& why_not) {
  const NcclLibrary* const library = nccl_library(why_not);
  Seat seat;
  agree(ranks, [&] { seat = own_seat(library); });
  const std::string hindered = hindrance(ranks, all_of(ranks, seat));
  if (!hindered.empty()) {
    if (why_not.empty()) why_not = hindered;
    return host_exchange(ranks);
  }
  std::unique_ptr<RankExchange> exchange;
  try {
    std::vector<std::byte> id(library->id_bytes);
    agree(ranks, [&] {
      if (ranks.rank() == 0) library->make_id(id.data());
    });
    ranks.broadcast(id);
    agree(ranks, [&] { exchange = library->join(id.data(), ranks); });
  } catch (const RankLost&) {
    throw;
  } catch (const Error& error) {  // all ranks have it
    why_not = error.message();
    return host_exchange(ranks);
  }
  return exchange;
}

}  // namespace semfield::cuda
