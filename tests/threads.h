// A number of compute threads for one scope.
#pragma once

#include "compute/parallel.h"
#include "core/non_copyable.h"
#include "core/view.h"

namespace semfield {

class ThreadScope : NonCopyable {
 public:
  explicit ThreadScope(int count) : before_(thread_count()) { set_thread_count(count); }
  ~ThreadScope() { set_thread_count(before_); }

 private:
  int before_;
};

/// work() on so many threads.
template <class Work>
auto on_threads(int count, const Work& work) {
  const ThreadScope scope(count);
  return work();
}

}  // namespace semfield
