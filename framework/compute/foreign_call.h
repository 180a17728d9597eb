// Calls of a library that makes short-lived objects with operator new: their memory is kept from call to call.
#pragma once

#include <array>
#include <cstddef>

namespace semfield {

/// Small blocks between their uses, by size in steps of kStep bytes. One thread at a time.
class KeptBlocks {
 public:
  static constexpr std::size_t kStep = 16;
  KeptBlocks() = default;
  ~KeptBlocks();
  KeptBlocks(const KeptBlocks&) = delete;
  KeptBlocks& operator=(const KeptBlocks&) = delete;

  /// A block of at least `bytes`, a multiple of kStep; null: there is none, or such sizes are not kept.
  void* take(std::size_t bytes);
  /// Keeps a block of malloc; false: it is not of a size that is kept.
  bool keep(void* memory);

 private:
  struct Block {
    Block* next;
  };
  std::array<Block*, 32> first_{};
};

/// Lives while a library computes on this thread. The program's operator new and delete (app/allocation_count.cpp) then
/// take small blocks from `blocks` and give them back to it; other programs are not affected.
class ForeignCall {
 public:
  explicit ForeignCall(KeptBlocks& blocks);
  ~ForeignCall();
  ForeignCall(const ForeignCall&) = delete;
  ForeignCall& operator=(const ForeignCall&) = delete;

  /// Null outside such a call.
  static KeptBlocks* blocks();
};

}  // namespace semfield
