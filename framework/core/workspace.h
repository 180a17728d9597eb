// Bump arena: memory inside a step comes from here and from nowhere else.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <string_view>
#include <vector>

#include "core/non_copyable.h"
#include "core/view.h"

namespace semfield {

/// Where an arena's blocks come from when it is not the process's own heap. `allocate` throws Error when there is no
/// memory; its blocks start on a 256-byte boundary.
struct BlockSource {
  Device device = Device::cpu;
  std::byte* (*allocate)(std::size_t bytes) = nullptr;
  void (*release)(std::byte* block) = nullptr;
};

/// Bump allocator with a high-water mark. Grows by whole blocks when it must (only in the first step of a shape), and
/// merges them at the next full release, so a steady state allocates nothing. Not thread-safe: one per thread.
class Workspace : NonCopyable {
 public:
  Workspace() = default;
  explicit Workspace(const BlockSource& source) : source_(source) {}
  ~Workspace();

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
  class Scope : NonCopyable {
   public:
    explicit Scope(Workspace& arena) : arena_(arena), block_(arena.block_), used_(arena.used_), total_(arena.total_) {}
    ~Scope() { arena_.release(block_, used_, total_); }

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

// What work is done with - threads, limits of inputs: set by whoever asks for the work, seen by every
// thread that helps.

struct InputLimits;

/// How far the opening of a scene is. `doing` is "checking" (files, by their headers), "reading", "looking for the
/// bounds" (a probe), or "read" at the end.
using LoadProgress = std::function<void(std::string_view doing, std::size_t done, std::size_t total)>;

/// What it points to must outlive every scope that was given it.
struct WorkSettings {
  int threads = 0;                              ///< 0: the default of the process (compute/parallel.h)
  const InputLimits* limits = nullptr;          ///< null: the defaults (formats/text_rows.h)
  const LoadProgress* load_progress = nullptr;  ///< null: nothing is reported
};

/// Those of the innermost scope of this thread, or the defaults.
const WorkSettings& work_settings();

/// While it lives, work of this thread is done with `settings`, which are borrowed: a change of them is seen at once.
/// Threads that parallel_for lends work under the same. Scopes nest.
class WorkScope : NonCopyable {
 public:
  explicit WorkScope(const WorkSettings& settings);
  explicit WorkScope(WorkSettings&&) = delete;
  ~WorkScope();

 private:
  const WorkSettings* before_;
};

}  // namespace semfield
