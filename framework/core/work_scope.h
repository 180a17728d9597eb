// What work is done with - threads, limits of inputs: set by whoever asks for the work, seen by every
// thread that helps.
#pragma once

#include <cstddef>
#include <functional>
#include <string_view>

namespace semfield {

struct InputLimits;

/// How far the opening of a scene is. `doing` is "checking" (files, by their headers), "reading", "looking for the
/// bounds" (a probe), or "read" at the end.
using LoadProgress = std::function<void(std::string_view doing, std::size_t done, std::size_t total)>;

/// What it points to must outlive every scope that was given it.
struct WorkSettings {
  int threads = 0;                              ///< 0: the default of the process (compute/parallel.h)
  const InputLimits* limits = nullptr;          ///< null: the defaults (formats/input_limits.h)
  const LoadProgress* load_progress = nullptr;  ///< null: nobody is told
};

/// Those of the innermost scope of this thread, or the defaults.
const WorkSettings& work_settings();

/// While it lives, work of this thread is done with `settings`, which are borrowed: a change of them is seen at once.
/// Threads that parallel_for lends work under the same. Scopes nest.
class WorkScope {
 public:
  explicit WorkScope(const WorkSettings& settings);
  explicit WorkScope(WorkSettings&&) = delete;
  ~WorkScope();
  WorkScope(const WorkScope&) = delete;
  WorkScope& operator=(const WorkScope&) = delete;

 private:
  const WorkSettings* before_;
};

}  // namespace semfield
