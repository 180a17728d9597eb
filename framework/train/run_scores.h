// What a run scores while it trains and at its end, what `eval` adds, and the frames of an evaluation that reports
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
#include "train/metrics_log.h"
#include "train/opened_run.h"
#include "train/run_folder.h"
#include "train/trainer.h"

namespace semfield {

class RunListener;

/// Which part of a split an evaluation scored.
struct ScoredPart {
  std::int64_t frames = 0, of = 0;
  std::int32_t stride = 1;
  bool whole() const { return frames == of && stride == 1; }
  /// "4 of 30 frames", "all 30 frames at 1 pixel in 4".
  std::string text() const;
};

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

/// A sample of test frames now and then, test and training frames at the end. A stop signal ends a sample between its
/// frames.
class RunScores {
 public:
  /// Borrows all.
  RunScores(const Trainer& training, const RunFolder& folder, MetricsLog& log, RunListener& listener);

  /// A row of metrics.jsonl for `report.eval_frames` test frames; none when a stop came between them, or when
  /// evaluations took their part of the time already.
  void score_sample();
  /// The end of training: a sample where there are others, then test frames with final_eval.json and the report's
  /// frames, then training frames. Where time is short, every frame at fewer pixels. Values of the test frames; none
  /// without any.
  ScoreValues score_end();

  std::optional<double> last_miou_present;
  ScoredPart last_part;               ///< of the test frames scored last
  std::vector<double> frame_psnr_db;  ///< of each test frame at the end, ascending
  ReportFrames report_frames;

 private:
  const Session& session() const { return training_.session(); }
  void measure_cost(EvalJob job);
  SplitScore score(EvalJob job, Split split);
  void log_test(const ScoredPart& part, const SplitScore& score);
  ScoreValues score_test_frames(EvalJob job, double pictures_s);
  void draw_report_frames(double budget_s, std::int32_t scored_stride);

  const Trainer& training_;
  const RunFolder& folder_;
  MetricsLog& log_;
  RunListener& listener_;
  double start_s_;
  EvalBudget budget_;
  std::vector<int> test_;
  std::optional<std::int32_t> sample_stride_;
};

/// What the curve of a training still promises.
struct Outlook {
  double gain_db;  ///< what it would bring to train on
  double more_s;   ///< for so long
};
/// From the rows of a run that ended `train_s` seconds after its start with this PSNR: how much doubling its length
/// has brought twice, and so what doubling it again will. None where the colours are those of kShown_db already, or
/// where another doubling brings less than kWorthwhile_db.
std::optional<Outlook> outlook(const std::vector<MetricsRow>& rows, double train_s, double psnr_db);
inline constexpr double kShown_db = 25, kWorthwhile_db = 0.3;

/// Keeps the scores of every pixel of a split where reports look for them: a row of metrics.jsonl, and for test frames
/// final_eval.json. Scores that are there already stay. `refined`: the same frames once more with poses fitted to the
/// field, or null. `found`: what opening the run had to say. Returns why nothing was kept; "" otherwise.
std::string keep_scores(const OpenedRun& run, const std::string& split, const SplitScore& score,
                        const SplitScore* refined, const Diagnostics& found);

}  // namespace semfield
