#include "execution/thread_arenas.h"

#include "system/memory_limit.h"

namespace semfield {

void ThreadArenas::even_out(std::int64_t workers) {
  std::size_t most = 0;
  for (const auto& arena : arenas_) most = std::max(most, arena->high_water_bytes());
  for (std::int64_t i = 0; i < workers; ++i) arenas_[static_cast<std::size_t>(i)]->reserve(most);
  if (const std::int64_t now = growths(); now != growths_) {  // blocks on the way to the last ones
    release_freed_memory();
    growths_ = now;
  }
}

std::size_t ThreadArenas::bytes() const {
  std::size_t sum = own_.high_water_bytes();
  for (const auto& arena : arenas_) sum += arena->high_water_bytes();
  return sum;
}

std::int64_t ThreadArenas::growths() const {
  std::int64_t sum = own_.growth_count();
  for (const auto& arena : arenas_) sum += arena->growth_count();
  return sum;
}

}  // namespace semfield
