// What `semfield-study scale` measures: steps of the presets on 1, 2, ... ranks, whether their bits agree, and a sweep
// by two.
#pragma once

#include <functional>
#include <string>
#include <vector>

#include "studies/scale_results.h"
#include "studies/study_tools.h"

namespace semfield {

inline const std::vector<std::string> kScaleParts{"cpu", "gpu", "bits", "sweep"};

struct ScaleBenchOptions {
  std::vector<std::string> only;  ///< of kScaleParts; empty: all
  int most_ranks = 0;             ///< 0: as many as there are cores or GPUs
  int repeats = 2;                ///< rounds, each of which starts every training once
  bool quick = false;             ///< narrow networks and few rays, for tests
};

/// How this program is started as `ranks` processes that work together; 1: as one, without a launcher.
struct ScaleStart {
  int ranks = 1;
  bool pinned = false;             ///< each on a core of its own
  std::vector<std::string> words;  ///< behind the program's name
};

struct ScaleEnd {
  int code = 0;
  std::string failure;  ///< what it said where the code is not 0
  double seconds = 0;   ///< from start to end
};

struct ScaleTools {
  const StudyTools& study;
  std::string folder;  ///< exists; for files of the study
  int cores = 1;       ///< that ranks can be pinned to
  /// Throws Error(unavailable) where several ranks cannot be started here.
  std::function<void()> need_ranks;
  /// Starts it, waits for its end.
  std::function<ScaleEnd(const ScaleStart&)> start;
};

/// What this machine cannot measure is in ScaleResults::missing, with the reason. Throws Error(unavailable) where
/// several ranks are asked for and nothing starts them, Error(failure) with what a training said that failed.
ScaleResults measure_scale(const ScaleBenchOptions& options, const ScaleTools& tools);

}  // namespace semfield
