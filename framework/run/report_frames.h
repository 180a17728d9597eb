// Frames of an evaluation that a report shows: evenly spaced ones, and the worst.
#pragma once

#include <algorithm>
#include <utility>
#include <vector>

#include "eval/evaluator.h"

namespace semfield {

/// With their maps.
class ReportFrames {
 public:
  using Kept = std::vector<std::pair<FrameScore, RenderedFrame>>;

  ReportFrames() = default;
  /// `shown`: frames to keep in any case.
  ReportFrames(std::vector<int> shown, int most_worst)
      : shown_(std::move(shown)), most_worst_(static_cast<std::size_t>(most_worst)) {}
  void add(const FrameScore& score, const RenderedFrame& maps) {
    if (std::find(shown_.begin(), shown_.end(), score.frame) != shown_.end()) strips_.emplace_back(score, maps);
    const auto place =
        std::find_if(worst_.begin(), worst_.end(), [&](const auto& kept) { return score.worse_than(kept.first); });
    if (place == worst_.end() && worst_.size() == most_worst_) return;
    worst_.emplace(place, score, maps);
    if (worst_.size() > most_worst_) worst_.pop_back();
  }

  /// The frames kept, each once.
  std::vector<int> frames() const {
    std::vector<int> all;
    for (const Kept* kept : {&strips_, &worst_})
      for (const auto& [score, maps] : *kept)
        if (std::find(all.begin(), all.end(), score.frame) == all.end()) all.push_back(score.frame);
    return all;
  }
  /// Puts render(frame) in the place of the maps kept.
  template <class Render>
  void draw(const Render& render) {
    for (const int frame : frames()) {
      const RenderedFrame maps = render(frame);
      for (Kept* kept : {&strips_, &worst_})
        for (auto& [score, old] : *kept)
          if (score.frame == frame) old = maps;
    }
  }

  const Kept& strips() const { return strips_; }
  /// Worst first, at most `most_worst`.
  const Kept& worst() const { return worst_; }

 private:
  std::vector<int> shown_;
  std::size_t most_worst_ = 0;
  Kept strips_, worst_;
};

}  // namespace semfield
