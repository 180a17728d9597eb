#include "compute/parallel.h"

#include <sched.h>

#include <chrono>
#include <exception>
#include <latch>
#include <mutex>
#include <system_error>
#include <thread>
#include <utility>

#include "compute/isa.h"

namespace semfield {

namespace {

// OpenMP gives the threads; they are handed out by ThreadTeam and not by regions of OpenMP. At the end of a region the
// GNU runtime has every thread wait for every other in a busy loop of milliseconds, before which no call can come:
// beside another program on the same cores, threads then take the core from the one that they wait for, and a step
// takes many times longer.
template <class Serve>
void start_workers(int workers, const Serve& serve) {
#if defined(__SANITIZE_THREAD__)
  // The OpenMP runtime is not built for ThreadSanitizer, which then sees no order between a region's end and what comes
  // after it. The team is the same; only where its threads come from differs.
  std::vector<std::thread> threads;
  for (int i = 0; i < workers; ++i) threads.emplace_back(serve);
  for (std::thread& thread : threads) thread.join();
#else
#pragma omp parallel num_threads(workers)
  serve();
#endif
}

/// Workers beside the thread that asks. A job is over when its indices are used up and every worker that took part has
/// left it; a worker that never woke - other programs keep the cores busy - is not waited for. Those who wait stay
/// awake for 0.2 milliseconds, so that jobs close together lose no time, and then sleep, so that they do not take
/// the core from the one they wait for.
class ThreadTeam {
 public:
  explicit ThreadTeam(int workers)
      : workers_(workers), manager_([this, workers] { start_workers(workers, [this] { serve(); }); }) {}
  ~ThreadTeam();

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
  std::thread manager_;  // it starts the workers; fewer are as good, only slower
};

std::atomic<int> g_threads{0};

// Throws std::system_error when so many threads cannot live side by side: the OpenMP runtime would end the process.
void ask_for_threads(int count) {
  std::latch end(1);
  std::vector<std::thread> threads;
  threads.reserve(static_cast<std::size_t>(count));
  const auto join = [&] {
    end.count_down();
    for (std::thread& thread : threads) thread.join();
  };
  try {
    while (std::ssize(threads) < count) threads.emplace_back([&end] { end.wait(); });
  } catch (const std::system_error&) {
    join();
    throw;
  }
  join();
}

// The cores are the machine's, so the workers are the process's: two sessions that train at once would only take them
// from each other. Results do not depend on who has them.
struct Teams {
  std::mutex one_job;  // held while a job runs
  std::unique_ptr<ThreadTeam> team;
};

// Never destroyed: workers may sleep in it until the process ends.
Teams& teams() {
  static Teams& all = *new Teams;
  return all;
}

// By the system's own call: OpenMP's answer goes through memory that its callers share.
int cores_of_process() {
  cpu_set_t set;
  if (sched_getaffinity(0, sizeof set, &set) == 0) return std::max(1, CPU_COUNT(&set));
  return std::max(1, static_cast<int>(std::thread::hardware_concurrency()));  // more cores than a set holds
}

void run_serially(std::int64_t count, IndexBody body) {
  const ComputeFloatMode mode;
  for (std::int64_t i = 0; i < count; ++i) body(i);
}

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

int hardware_threads() {
  static const int quota = cpu_quota();
  const int cores = cores_of_process();
  return quota > 0 ? std::min(quota, cores) : cores;
}
void set_thread_count(int threads) { g_threads = threads; }
int thread_count() {
  if (const int own = work_settings().threads; own > 0) return own;
  const int all = g_threads;
  return all > 0 ? all : hardware_threads();
}

bool inside_parallel() { return ThreadTeam::inside_job(); }

void parallel_for(std::int64_t count, IndexBody body) {
  if (count <= 1 || ThreadTeam::inside_job()) return run_serially(count, body);
  const int workers = thread_count() - 1;
  if (workers <= 0) return run_serially(count, body);
  const std::unique_lock<std::mutex> job(teams().one_job, std::try_to_lock);
  if (!job.owns_lock()) return run_serially(count, body);  // another thread of the caller's has the workers
  std::unique_ptr<ThreadTeam>& team = teams().team;
  if (!team || team->workers() != workers) {
    team.reset();
    try {
      ask_for_threads(workers + 1);  // with the one that starts them
      team = std::make_unique<ThreadTeam>(workers);
    } catch (const std::system_error&) {  // no memory or no right to another thread: the same values, only later
      return run_serially(count, body);
    }
  }
  team->run(count, body);
}

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
