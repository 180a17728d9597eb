#include "scene/load_progress.h"

#include <mutex>
#include <utility>

namespace semfield {

namespace {

std::mutex g_telling;
LoadProgress g_progress;

}  // namespace

void set_load_progress(LoadProgress progress) {
  const std::lock_guard lock(g_telling);
  g_progress = std::move(progress);
}

void tell_load_progress(std::string_view doing, std::size_t done, std::size_t total) {
  const std::lock_guard lock(g_telling);
  if (g_progress) g_progress(doing, done, total);
}

}  // namespace semfield
