// Arenas for calls that may run beside each other: scratch alone, nothing in one outlives its call.
#pragma once

#include <memory>
#include <mutex>
#include <vector>

#include "core/workspace.h"

namespace semfield {

/// As many arenas as calls ran at a time.
class WorkspacePool {
 public:
  /// An arena of the pool while it lives.
  class Loan {
   public:
    explicit Loan(WorkspacePool& pool) : pool_(pool), arena_(pool.take()) {}
    ~Loan() { pool_.give_back(std::move(arena_)); }
    Loan(const Loan&) = delete;
    Loan& operator=(const Loan&) = delete;
    Workspace* get() const { return arena_.get(); }

   private:
    WorkspacePool& pool_;
    std::unique_ptr<Workspace> arena_;
  };

 private:
  std::unique_ptr<Workspace> take() {
    const std::lock_guard lock(mutex_);
    if (free_.empty()) return std::make_unique<Workspace>();
    std::unique_ptr<Workspace> arena = std::move(free_.back());
    free_.pop_back();
    return arena;
  }
  void give_back(std::unique_ptr<Workspace> arena) {
    const std::lock_guard lock(mutex_);
    free_.push_back(std::move(arena));
  }

  std::mutex mutex_;
  std::vector<std::unique_ptr<Workspace>> free_;
};

}  // namespace semfield
