#include "compute/parallel.h"

#include <omp.h>
#include <sched.h>

#include <algorithm>
#include <atomic>
#include <latch>
#include <memory>
#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

#include "compute/float_mode.h"
#include "compute/thread_team.h"
#include "core/work_scope.h"
#include "system/cpu_quota.h"

namespace semfield {

namespace {

std::atomic<int> g_threads{0};

// OpenMP gives the threads; they are handed out by ThreadTeam and not by regions of OpenMP. At the end of a region the
// GNU runtime has every thread wait for every other in a busy loop of milliseconds, before which no call can come:
// beside another program on the same cores, threads then take the core from the one that they wait for, and a step
// takes many times longer.
void start_workers(int workers, const std::function<void()>& serve) {
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

}  // namespace

int hardware_threads() {
  static const int quota = cpu_quota();
  const int cores = cores_of_process();
  return quota > 0 ? std::min(quota, cores) : cores;
}
void keep_libraries_serial() { omp_set_num_threads(1); }
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
      team = std::make_unique<ThreadTeam>(workers, start_workers);
    } catch (const std::system_error&) {  // no memory or no right to another thread: the same values, only later
      return run_serially(count, body);
    }
  }
  team->run(count, body);
}

}  // namespace semfield
