// Counts what operator new takes from the heap in this process, libraries included.
#pragma once

#include <cstdint>

namespace semfield::app {

/// Bytes and calls since the process began. The program replaces the global operator new (allocation_count.cpp).
struct Allocations {
  std::int64_t bytes = 0, calls = 0;
};
Allocations allocations_so_far();

}  // namespace semfield::app
