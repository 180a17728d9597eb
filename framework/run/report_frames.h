// Frames of an evaluation that a report shows: evenly spaced ones, and the worst.
#pragma once

#include <utility>
#include <vector>

#include "eval/evaluator.h"

namespace semfield {

/// With their maps.
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

}  // namespace semfield
