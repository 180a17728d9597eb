// Threads that sleep between jobs: what parallel_for runs on.
#pragma once

#include <atomic>
#include <cstdint>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>

#include "compute/index_body.h"
#include "core/work_scope.h"

namespace semfield {

/// Workers beside the thread that asks. A job is over when its indices are used up and every worker that took part has
/// left it; a worker that never woke - other programs keep the cores busy - is not waited for. Those who wait stay
/// awake for 0.2 milliseconds, so that jobs close together lose no time, and then sleep, so that they do not take
/// the core from the one they wait for.
class ThreadTeam {
 public:
  /// `start` is called in a thread of its own and must call its argument on `workers` threads, in parallel; it returns
  /// when they have returned. Fewer threads are as good, only slower.
  using Start = std::function<void(int workers, const std::function<void()>& serve)>;
  ThreadTeam(int workers, Start start);
  ~ThreadTeam();
  ThreadTeam(const ThreadTeam&) = delete;
  ThreadTeam& operator=(const ThreadTeam&) = delete;

  int workers() const { return workers_; }
  /// body(i) for every i in [0, count), each once; one job at a time. The first exception is rethrown at the end.
  void run(std::int64_t count, IndexBody body);

  /// Inside a body, on any thread of any team.
  static bool inside_job();

 private:
  void serve();
  void take_indices();

  const int workers_;
  // The job; written while the gate is closed and nobody is inside.
  const IndexBody* body_ = nullptr;
  const WorkSettings* settings_ = nullptr;  // of the thread that asks
  std::int64_t count_ = 0;
  std::exception_ptr failure_;
  std::mutex failure_mutex_;
  alignas(64) std::atomic<std::int64_t> next_{0};
  // Workers inside the job, and the flag kClosed: who enters and sees the flag leaves at once.
  static constexpr std::uint32_t kClosed = 0x80000000u;
  alignas(64) std::atomic<std::uint32_t> gate_{kClosed};
  alignas(64) std::atomic<std::uint32_t> epoch_{0};  // moves with every job
  std::atomic<bool> stop_{false};
  std::thread manager_;
};

}  // namespace semfield
