// What a run folder tells beside figures: confusion matrix, reliability bins and scores of every frame
// (final_eval.json), and how many labels trained (labels.json).
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "eval/evaluator.h"
#include "labels/training_labels.h"
#include "model/leave_out.h"
#include "scene/classes/class_table.h"

namespace semfield {

/// A whole evaluation in detail.
struct FinalEval {
  std::string split;
  std::int64_t step = 0;
  double train_s = 0;

  struct Class {
    std::int32_t id = 0;
    std::string name;
    std::array<std::uint8_t, 3> color{};
  };
  std::vector<Class> classes;           ///< those that occur in truth or prediction, by ascending id
  std::vector<std::int64_t> confusion;  ///< [classes, classes] pixels, row = truth
  std::int64_t void_truth_px = 0, void_predicted_px = 0;

  struct Bin {
    std::int64_t pixels = 0;
    double confidence = 0;  ///< mean of the bin; 0 without pixels
    double accuracy = 0;    ///< share of right pixels; 0 without pixels
  };
  std::vector<Bin> bins;               ///< equal widths over [0, 1]; empty without scored pixels
  std::optional<Auroc> entropy_auroc;  ///< entropy as a detector of wrong labels; none where all are right or all wrong
  std::int64_t nonfinite_px = 0;       ///< scored pixels whose probabilities were not finite, in no bin
  OpacityCounts resolution;            ///< all 0 in files of versions that did not count it
  std::vector<FrameScore> frames;      ///< in order of evaluation; FrameScore::frame is not kept

  std::int64_t count(std::size_t truth, std::size_t predicted) const {
    return confusion[truth * classes.size() + predicted];
  }
  /// Sum over bins of (pixels / all pixels) |accuracy - confidence| [Guo17, Eq. 3]; none without pixels, or when some
  /// were not finite.
  std::optional<double> ece() const;
};

FinalEval final_eval(const SplitScore& score, const ClassTable& classes, std::string split);

/// One JSON object, the content of final_eval.json.
std::string final_eval_json(const FinalEval& eval);
/// Throws Error(data) naming `name` for what final_eval_json does not write.
FinalEval parse_final_eval(std::string_view json, const std::string& name);

/// What a round of self-training did (train/self_training.h).
struct SelfTrainingRound {
  std::int64_t step = 0;
  std::int64_t unlabelled_px = 0;            ///< training pixels without a label of their own
  std::int64_t added_px = 0;                 ///< of those, labelled by the round
  std::int64_t scored_px = 0, right_px = 0;  ///< of those, with a true label, and with the same one
  std::optional<double> accuracy() const {
    if (scored_px == 0) return std::nullopt;
    return static_cast<double>(right_px) / static_cast<double>(scored_px);
  }
  /// "self-training at step 1500: 1200 pixels labelled, 40.0 % of those without a label; ..."
  std::string text() const;
  bool operator==(const SelfTrainingRound&) const = default;
};
/// A list of objects, as in labels.json.
std::string rounds_json(const std::vector<SelfTrainingRound>& rounds);
std::vector<SelfTrainingRound> parse_rounds(std::string_view json, const std::string& name);

/// Labels that trained a run.
struct LabelCounts {
  std::int64_t train_frames = 0, labelled_frames = 0;
  std::int64_t train_px = 0, labelled_px = 0;
  struct Class {
    std::int32_t id = 0;
    std::string name;
    std::int64_t pixels = 0;
  };
  std::vector<Class> classes;               ///< every class that is not ignored, by ascending id
  std::vector<TrainingLabels::Step> steps;  ///< what was done to the labels, in order; counts are of what came out
  std::vector<SelfTrainingRound> rounds{};  ///< of self-training; `labelled_px` and `classes` leave them out
};

LabelCounts label_counts(const SceneManifest& manifest, const ClassTable& classes,
                         std::vector<TrainingLabels::Step> steps = {});
std::string label_counts_json(const LabelCounts& counts);
LabelCounts parse_label_counts(std::string_view json, const std::string& name);

}  // namespace semfield
