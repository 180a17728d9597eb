#include "compute/thread_team.h"

#include <chrono>
#include <utility>

#include "compute/float_mode.h"

namespace semfield {

namespace {

// Longer than most waits within a step: to wake a thread costs the one who does it some microseconds for each.
constexpr std::chrono::microseconds kAwake{200};

thread_local bool t_inside = false;

void pause_briefly() {
#if defined(__x86_64__) || defined(__i386__)
  __builtin_ia32_pause();
#else
  std::this_thread::yield();
#endif
}

// Until `value` is no longer `old`: a short while awake, then asleep. Returns the new value.
std::uint32_t wait_for_change(const std::atomic<std::uint32_t>& value, std::uint32_t old) {
  const auto end = std::chrono::steady_clock::now() + kAwake;
  do {
    for (int i = 0; i < 16; ++i) {
      const std::uint32_t now = value.load(std::memory_order_acquire);
      if (now != old) return now;
      pause_briefly();
    }
  } while (std::chrono::steady_clock::now() < end);
  value.wait(old, std::memory_order_acquire);
  return value.load(std::memory_order_acquire);
}

}  // namespace

ThreadTeam::ThreadTeam(int workers, Start start)
    : workers_(workers), manager_([this, workers, start = std::move(start)] { start(workers, [this] { serve(); }); }) {}

ThreadTeam::~ThreadTeam() {
  stop_ = true;
  epoch_.fetch_add(1, std::memory_order_release);
  epoch_.notify_all();
  manager_.join();
}

bool ThreadTeam::inside_job() { return t_inside; }

void ThreadTeam::take_indices() {
  const ComputeFloatMode mode;
  const WorkScope scope(*settings_);
  t_inside = true;
  for (;;) {
    const std::int64_t i = next_.fetch_add(1, std::memory_order_relaxed);
    if (i >= count_) break;
    try {
      (*body_)(i);
    } catch (...) {
      const std::lock_guard<std::mutex> lock(failure_mutex_);
      if (!failure_) failure_ = std::current_exception();
    }
  }
  t_inside = false;
}

void ThreadTeam::serve() {
  std::uint32_t seen = 0;  // a worker that comes late finds the epoch moved on and looks for a job at once
  while (!stop_.load(std::memory_order_acquire)) {
    const bool open = (gate_.fetch_add(1, std::memory_order_acq_rel) & kClosed) == 0;
    if (open) take_indices();
    if (gate_.fetch_sub(1, std::memory_order_acq_rel) == (kClosed | 1u)) gate_.notify_all();
    seen = wait_for_change(epoch_, seen);
  }
}

void ThreadTeam::run(std::int64_t count, IndexBody body) {
  body_ = &body;
  settings_ = &work_settings();
  count_ = count;
  next_.store(0, std::memory_order_relaxed);
  gate_.fetch_and(~kClosed, std::memory_order_release);
  epoch_.fetch_add(1, std::memory_order_release);
  epoch_.notify_all();
  take_indices();
  std::uint32_t gate = gate_.fetch_or(kClosed, std::memory_order_acq_rel) | kClosed;
  while (gate != kClosed) gate = wait_for_change(gate_, gate);
  if (std::exception_ptr failure = std::exchange(failure_, nullptr)) std::rethrow_exception(failure);
}

}  // namespace semfield
