// Runs that are opened again: evaluated, their scores kept, compared; and the frames of an evaluation that reports
// show.
#pragma once

#include <algorithm>
#include <cstdint>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/error.h"
#include "eval/evaluator.h"
#include "plugin/registry.h"
#include "run/metrics_log.h"
#include "run/run_folder.h"
#include "session/session.h"

namespace semfield {

/// Which part of a split an evaluation scored.
struct ScoredPart {
  std::int64_t frames = 0, of = 0;
  std::int32_t stride = 1;
  bool whole() const { return frames == of && stride == 1; }
  /// "4 of 30 frames", "all 30 frames at 1 pixel in 4".
  std::string text() const;
};

/// Opens a finished or interrupted run for evaluation and rendering: run.yaml, scene, newest checkpoint.
struct OpenedRun {
  Session session;
  std::int64_t step = 0;
  double train_s = 0;
  std::string run_dir;
};
enum class OpenFor { evaluation, evaluation_of_training_frames, rendering, objects };
/// `ranks`: SessionOptions::ranks. For rendering alone no pixel is read, unless the checkpoint does not state what
/// training knew of the scene.
OpenedRun open_run(const std::string& run_dir, const std::vector<std::string>& overrides, Registry& registry,
                   Diagnostics& diagnostics, OpenFor purpose = OpenFor::evaluation, Ranks* ranks = nullptr);

// Frames of an evaluation that a report shows: evenly spaced ones, and the worst.

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

using ScoreValues = std::vector<std::pair<std::string, std::optional<double>>>;

/// Keeps the scores of every pixel of a split where reports look for them: a row of metrics.jsonl, and for test frames
/// final_eval.json. Scores that are there already stay. `refined`: the same frames once more with poses fitted to the
/// field, or null. `found`: what opening the run had to say. Returns why nothing was kept; "" otherwise.
std::string keep_scores(const OpenedRun& run, const std::string& split, const SplitScore& score,
                        const SplitScore* refined, const Diagnostics& found);

// Whether two runs are the same training: settings, scene and every bit of their newest checkpoints.

struct RunComparison {
  std::string difference;  ///< the first one in a sentence; "" = equal
  std::int64_t step = 0;   ///< of the first run's newest checkpoint
  std::size_t tensors = 0;
};

/// Compares, in this order: settings that are part of a run's identity, class tables, inputs, steps, tensors. Times,
/// threads, places of files and what reports show do not count. Settings are those of the checkpoints; a run.yaml that
/// says other ones is a warning. Throws Error(no_input) for a folder without a
/// checkpoint.
RunComparison compare_runs(const std::string& folder_a, const std::string& folder_b, Registry& registry,
                           Diagnostics& diagnostics);

}  // namespace semfield
