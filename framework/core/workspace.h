// Bump arena: memory inside a step comes from here and from nowhere else.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "core/view.h"

namespace semfield {

/// Where an arena's blocks come from when it is not the process's own heap. `allocate` throws Error when there is no
/// memory; its blocks start on a 256-byte boundary.
struct BlockSource {
  Device device = Device::cpu;
  std::byte* (*allocate)(std::size_t bytes) = nullptr;
  void (*release)(std::byte* block) = nullptr;
};

/// Adds up what a Workspace of the CPU's memory will be asked for.
class ScratchSum {
 public:
  template <class T>
  void take(std::int64_t rows, std::int64_t cols) {
    const std::size_t bytes = sizeof(T) * static_cast<std::size_t>(rows) * static_cast<std::size_t>(cols);
    bytes_ += (bytes > 0 ? bytes + 63 : 64) / 64 * 64;
  }
  std::size_t bytes() const noexcept { return bytes_; }

 private:
  std::size_t bytes_ = 0;
};

/// Bump allocator with a high-water mark. Grows by whole blocks when it must (only in the first step of a shape), and
/// merges them at the next full release, so a steady state allocates nothing. Not thread-safe: one per thread.
class Workspace {
 public:
  Workspace() = default;
  explicit Workspace(const BlockSource& source) : source_(source) {}
  ~Workspace();
  Workspace(const Workspace&) = delete;
  Workspace& operator=(const Workspace&) = delete;

  /// `bytes` of uninitialised memory of the source's device, 64-byte aligned (256 where blocks have a source), valid
  /// until the enclosing Scope ends.
  std::byte* take_bytes(std::size_t bytes);

  /// Uninitialised [rows, cols] matrix, rows contiguous.
  template <class T>
  View<T> take(std::int64_t rows, std::int32_t cols) {
    return View<T>(
        reinterpret_cast<T*>(take_bytes(sizeof(T) * static_cast<std::size_t>(rows) * static_cast<std::size_t>(cols))),
        rows, cols, cols, source_.device);
  }

  /// Room for `bytes` in one block, before they are taken; nothing may be in use. No part of the high-water mark.
  void reserve(std::size_t bytes);
  /// Gives every block back and forgets the high-water mark; nothing may be in use.
  void forget();
  std::size_t high_water_bytes() const noexcept { return high_water_; }
  std::size_t reserved_bytes() const noexcept;
  /// How often memory was requested from the system; constant in the steady state.
  std::int64_t growth_count() const noexcept { return growths_; }

  /// Everything taken while a Scope lives is given back when it ends.
  class Scope {
   public:
    explicit Scope(Workspace& arena) : arena_(arena), block_(arena.block_), used_(arena.used_), total_(arena.total_) {}
    ~Scope() { arena_.release(block_, used_, total_); }
    Scope(const Scope&) = delete;
    Scope& operator=(const Scope&) = delete;

   private:
    Workspace& arena_;
    std::size_t block_, used_, total_;
  };

 private:
  struct Block {
    std::unique_ptr<std::byte[]> memory;  // null where the source gave the block
    std::byte* begin = nullptr;           // first aligned byte
    std::size_t bytes = 0;
  };
  void add_block(std::size_t bytes);
  void grow(std::size_t need);
  void release(std::size_t block, std::size_t used, std::size_t total);
  void clear_blocks();
  static std::size_t merged_bytes(std::size_t high_water) noexcept;

  BlockSource source_;
  std::vector<Block> blocks_;
  std::size_t block_ = 0;  // block in use
  std::size_t used_ = 0;   // bytes used in it
  std::size_t total_ = 0;  // bytes in use over all blocks
  std::size_t high_water_ = 0;
  std::int64_t growths_ = 0;
};

}  // namespace semfield
