// What a run folder tells beside figures: confusion matrix, reliability bins and scores of every frame
// (final_eval.json), and how many labels trained (labels.json).
#pragma once

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

/// A whole evaluation in detail, one JSON object, the content of final_eval.json: the confusion matrix of the classes
/// that occur in truth or prediction, by ascending id, reliability bins, and a row per frame.
std::string final_eval_json(const SplitScore& score, const ClassTable& classes, const std::string& split,
                            std::int64_t step, double train_s);
/// The step of such an object. Throws Error(data) naming `name` for what final_eval_json does not write.
std::int64_t check_final_eval(std::string_view json, const std::string& name);

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

/// Labels that trained a run, one JSON object, the content of labels.json: pixels of every class that is not ignored,
/// what was done to the labels, in order, and the rounds of self-training, which counts leave out.
std::string label_counts_json(const SceneManifest& manifest, const ClassTable& classes,
                              const std::vector<TrainingLabels::Step>& steps,
                              const std::vector<SelfTrainingRound>& rounds = {});
/// The rounds of such an object. Throws Error(data) naming `name` for what label_counts_json does not write.
std::vector<SelfTrainingRound> check_label_counts(std::string_view json, const std::string& name);

}  // namespace semfield
