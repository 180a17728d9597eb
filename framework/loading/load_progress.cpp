#include "loading/load_progress.h"

#include <mutex>

namespace semfield {

namespace {

// Of the process, since who is told may be the same for several sessions.
std::mutex g_telling;

}  // namespace

void tell_load_progress(std::string_view doing, std::size_t done, std::size_t total) {
  const std::lock_guard lock(g_telling);
  if (const LoadProgress* told = work_settings().load_progress; told != nullptr && *told) (*told)(doing, done, total);
}

}  // namespace semfield
