// The library that exchanges by NCCL: loaded when a run has several ranks, so that others do without NCCL.
#pragma once

#include <cstddef>
#include <memory>

#include "cuda/ranks/exchange.h"

namespace semfield::cuda {

/// What it offers; its symbol is kNcclLibrarySymbol. All throw Error with NCCL's words.
struct NcclLibrary {
  std::size_t id_bytes = 0;
  /// 22809 is 2.28.9.
  int (*version)() = nullptr;
  /// What rank 0 makes for all: id_bytes bytes.
  void (*make_id)(std::byte* id) = nullptr;
  /// To be called by all ranks, each for the device of launch(). Borrows `ranks`.
  std::unique_ptr<RankExchange> (*join)(const std::byte* id, Ranks& ranks) = nullptr;
};
inline constexpr const char* kNcclLibrarySymbol = "semfield_nccl_library";

}  // namespace semfield::cuda
