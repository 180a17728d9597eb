// Threads: OpenMP lives behind this header alone.
#pragma once

#include <cstdint>
#include <memory>
#include <type_traits>

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

}  // namespace semfield
