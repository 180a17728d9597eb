#include "execution/thread_arenas.h"

#include "system/process.h"

namespace semfield {

std::size_t ThreadArenas::dearest_unit() const {
  std::size_t most = 0;
  for (const auto& arena : arenas_) most = std::max(most, arena->high_water_bytes());
  return most;
}

void ThreadArenas::even_out(std::int64_t workers) {
  const std::size_t most = dearest_unit();
  for (std::int64_t i = 0; i < workers; ++i) arenas_[static_cast<std::size_t>(i)]->reserve(most);
  if (const std::int64_t now = growths(); now != growths_) {  // blocks on the way to the last ones
    release_freed_memory();
    growths_ = now;
  }
}

std::size_t ThreadArenas::bytes() const { return own_.high_water_bytes() + arenas_.size() * dearest_unit(); }

std::int64_t ThreadArenas::growths() const {
  std::int64_t sum = own_.growth_count();
  for (const auto& arena : arenas_) sum += arena->growth_count();
  return sum;
}

}  // namespace semfield
