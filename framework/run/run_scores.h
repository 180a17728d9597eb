// What a training run scores: a sample of test frames now and then, test and training frames at its end.
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

class RunListener;

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

/// The run's files that scores go into.
struct ScoreFiles {
  const RunFolder& folder;
  MetricsLog& log;
  EventWriter& events;
};

using ScoreValues = std::vector<std::pair<std::string, std::optional<double>>>;

class RunScores {
 public:
  /// The state of training that is scored.
  struct Moment {
    std::int64_t step = 0;
    double train_s = 0;
  };

  /// `session`, `listener` and what `files` names must outlive the object. The listener is called as in a
  /// training; a stop signal ends a sample between its frames.
  RunScores(const Session& session, const ScoreFiles& files, RunListener& listener, const Moment& start);

  /// A row of metrics.jsonl for `report.eval_frames` test frames; none when a stop came between them, or when
  /// evaluations took their part of the time already.
  void score_sample(const Moment& at);
  /// The end of training: a sample where there are others, then test frames with final_eval.json and the report's
  /// frames, then training frames. Where time is short, every frame at fewer pixels. Values of the test frames; none
  /// without any.
  ScoreValues score_end(const Moment& at);

  std::optional<double> last_miou_present() const { return last_miou_present_; }
  /// Of the test frames scored last.
  const ScoredPart& last_part() const { return last_part_; }
  const ReportFrames& report_frames() const { return report_frames_; }

 private:
  // What a pixel costs, from a few of the job's, unless an evaluation showed it already.
  void measure_cost(EvalJob job);
  SplitScore score(EvalJob job, Split split);
  void log_test(const Moment& at, const ScoredPart& part, const SplitScore& score);
  // `pictures_s`: what the report's pictures may take where the scores do not make them.
  ScoreValues score_test_frames(const Moment& at, EvalJob job, double pictures_s);
  // Finer than the scores, where the time allows it.
  void draw_report_frames(double budget_s, std::int32_t scored_stride);

  const Session& session_;
  ScoreFiles files_;
  RunListener& listener_;
  Moment start_;
  EvalBudget budget_;
  std::vector<int> test_;
  std::optional<std::int32_t> sample_stride_;
  std::optional<double> last_miou_present_;
  ScoredPart last_part_;
  ReportFrames report_frames_;
};

/// A row of metrics.jsonl for a scored part of `split`, "test" or "train".
MetricsRow score_row(std::int64_t step, double train_s, const std::string& split, const ScoredPart& part,
                     const SplitScore& score, const ClassTable& classes);

/// Adds what the labels that trained are worth against the scene's own, on these frames.
void add_given_scores(MetricsRow& row, const Session& session, const std::vector<int>& frames);

/// Keeps the scores of every pixel of a split where reports look for them: a row of metrics.jsonl, and for test frames
/// final_eval.json. Scores that are there already stay. `refined`: the same frames once more with poses fitted to the
/// field, or null. `found`: what opening the run had to say. Returns why nothing was kept; "" otherwise.
std::string keep_scores(const OpenedRun& run, const std::string& split, const SplitScore& score,
                        const SplitScore* refined, const Diagnostics& found);

/// Seconds since 1970, for events.
double unix_seconds();

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
