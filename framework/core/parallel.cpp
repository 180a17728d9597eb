#include "core/parallel.h"

#include <omp.h>

#include <atomic>
#include <exception>
#include <mutex>

namespace semfield {

namespace {
std::atomic<int> g_threads{0};
}

int hardware_threads() { return omp_get_num_procs(); }
void set_thread_count(int threads) { g_threads = threads; }
int thread_count() { return g_threads > 0 ? g_threads.load() : hardware_threads(); }

void parallel_for(std::int64_t count, const std::function<void(std::int64_t)>& body) {
  const int threads = thread_count();
  if (count <= 1 || threads == 1 || omp_in_parallel()) {
    for (std::int64_t i = 0; i < count; ++i) body(i);
    return;
  }
  std::exception_ptr failure;
  std::mutex failure_mutex;
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
  for (std::int64_t i = 0; i < count; ++i) {
    try {
      body(i);
    } catch (...) {
      const std::lock_guard<std::mutex> lock(failure_mutex);
      if (!failure) failure = std::current_exception();
    }
  }
  if (failure) std::rethrow_exception(failure);
}

}  // namespace semfield
