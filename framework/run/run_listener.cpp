#include "run/run_listener.h"

#include <fmt/format.h>

#include <chrono>

namespace semfield {

std::string ScoredPart::text() const {
  const std::string count = frames == of ? fmt::format("{} frames", of) : fmt::format("{} of {} frames", frames, of);
  return stride == 1 ? count : fmt::format("{} at 1 pixel in {}", count, stride * stride);
}

double RunListener::now_s() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

}  // namespace semfield
