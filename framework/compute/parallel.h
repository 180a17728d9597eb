// Threads: OpenMP lives behind this header alone.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <type_traits>
#include <vector>

#include "core/process.h"
#include "core/workspace.h"

namespace semfield {

/// A borrowed callable void(std::int64_t): refers to the one it was made from and owns nothing, so passing a lambda
/// allocates nothing, whatever it captures. Valid while that callable lives.
class IndexBody {
 public:
  template <class Body, std::enable_if_t<!std::is_same_v<std::remove_cvref_t<Body>, IndexBody>, int> = 0>
  IndexBody(Body&& body)  // NOLINT(google-explicit-constructor): lambdas are passed as they stand
      : object_(const_cast<void*>(static_cast<const void*>(std::addressof(body)))),
        call_([](void* object, std::int64_t i) { (*static_cast<std::remove_reference_t<Body>*>(object))(i); }) {}
  void operator()(std::int64_t i) const { call_(object_, i); }

 private:
  void* object_;
  void (*call_)(void*, std::int64_t);
};

/// Threads that parallel_for uses here: those of the thread's WorkSettings, or else the default. Results never depend
/// on it.
int thread_count();
/// The default of this process; 0 means every core. Sessions do not touch it: it is for work under no session's
/// settings, such as that of tests and benchmarks.
void set_thread_count(int threads);
/// Cores this process may run on: its affinity, and the quota of its control groups.
int hardware_threads();

/// Calls body(i) for every i in [0, count), each exactly once, in any order, on thread_count() threads. The first
/// exception thrown by a body is rethrown here after all bodies have ended. Bodies run under this thread's
/// work_settings(). Nested calls run serially, and so does a call while another thread's call has the workers.
void parallel_for(std::int64_t count, IndexBody body);

/// Whether this is a body of parallel_for, where another parallel_for runs serially.
bool inside_parallel();

/// An arena for each thread that takes units of work, and one for the caller's own. For one caller at a time.
class ThreadArenas {
 public:
  /// body(arena, i) once for every i in [0, count). Threads take the next i when they are done with one, so the dearest
  /// should come first; each keeps its arena, which so stays in its cache. As parallel_for when a body throws.
  template <class Body>
  void for_units(std::int64_t count, const Body& body) {
    const std::int64_t workers = std::clamp<std::int64_t>(count, 1, thread_count());
    while (std::ssize(arenas_) < workers) arenas_.push_back(std::make_unique<Arena>());
    std::atomic<std::int64_t> next{0};
    parallel_for(workers, [&](std::int64_t worker) {
      Workspace& arena = *arenas_[static_cast<std::size_t>(worker)];
      for (std::int64_t i = next++; i < count; i = next++) body(arena, i);
    });
    even_out(workers);
  }

  /// For work in the caller's thread.
  Workspace& own() { return own_; }
  /// What all have room for, whichever threads met the work, and how often one grew.
  std::size_t bytes() const { return own_.high_water_bytes() + arenas_.size() * dearest_unit(); }
  std::int64_t growths() const {
    std::int64_t sum = own_.growth_count();
    for (const auto& arena : arenas_) sum += arena->growth_count();
    return sum;
  }

 private:
  /// Which thread met the unit that takes most is chance. All get room for it, so that a steady state allocates
  /// nothing.
  void even_out(std::int64_t workers) {
    const std::size_t most = dearest_unit();
    for (std::int64_t i = 0; i < workers; ++i) arenas_[static_cast<std::size_t>(i)]->reserve(most);
    if (const std::int64_t now = growths(); now != growths_) {  // blocks on the way to the last ones
      release_freed_memory();
      growths_ = now;
    }
  }
  /// Bytes of the unit of work that took most.
  std::size_t dearest_unit() const {
    std::size_t most = 0;
    for (const auto& arena : arenas_) most = std::max(most, arena->high_water_bytes());
    return most;
  }

  struct alignas(128) Arena : Workspace {};  // no two in a cache line: every take writes its marks

  Workspace own_;
  std::vector<std::unique_ptr<Arena>> arenas_;
  std::int64_t growths_ = 0;  // that were answered by giving freed memory back
};

}  // namespace semfield
