// The report of a run: everything it shows comes from the run folder and the frames rendered last.
#pragma once

#include <string>
#include <utility>
#include <vector>

#include "train/run_folder.h"
#include "train/session.h"

namespace semfield {

/// Frames of an evaluation that a report shows, with their maps.
class ReportFrames {
 public:
  ReportFrames() = default;
  /// `shown`: frames to keep in any case.
  ReportFrames(std::vector<int> shown, int most_worst)
      : shown_(std::move(shown)), most_worst_(static_cast<std::size_t>(most_worst)) {}
  void add(const FrameScore& score, const RenderedFrame& maps);

  using Kept = std::vector<std::pair<FrameScore, RenderedFrame>>;
  const Kept& strips() const { return strips_; }
  /// Worst first, at most `most_worst`.
  const Kept& worst() const { return worst_; }

 private:
  std::vector<int> shown_;
  std::size_t most_worst_ = 0;
  Kept strips_, worst_;
};

/// Writes report.html with its pictures and worst_frames.json into the folder; returns its path.
std::string write_run_report(const RunFolder& folder, const Session& session, const ReportFrames& frames);

}  // namespace semfield
