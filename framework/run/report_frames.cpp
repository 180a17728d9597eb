#include "run/report_frames.h"

#include <algorithm>

namespace semfield {

void ReportFrames::add(const FrameScore& score, const RenderedFrame& maps) {
  if (std::find(shown_.begin(), shown_.end(), score.frame) != shown_.end()) strips_.emplace_back(score, maps);
  const auto place =
      std::find_if(worst_.begin(), worst_.end(), [&](const auto& kept) { return score.worse_than(kept.first); });
  if (place == worst_.end() && worst_.size() == most_worst_) return;
  worst_.emplace(place, score, maps);
  if (worst_.size() > most_worst_) worst_.pop_back();
}

}  // namespace semfield
