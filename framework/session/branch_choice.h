// Which of a pass's semantic branches is built: the labels that train decide.
#pragma once

#include <string>
#include <vector>

#include "labels/training_labels.h"
#include "settings/run_config.h"

namespace semfield {

/// What can be seen of training labels without knowing whether they are right.
struct LabelStatistics {
  std::int64_t pixels = 0, labelled = 0;   ///< of all training frames
  std::int64_t neighbours = 0, equal = 0;  ///< labelled pixels beside or above one another; those with equal labels
  double share() const { return pixels > 0 ? static_cast<double>(labelled) / static_cast<double>(pixels) : 0; }
  double agreement() const { return neighbours > 0 ? static_cast<double>(equal) / static_cast<double>(neighbours) : 1; }
};
LabelStatistics label_statistics(const LoadedScene& scene, const TrainingLabels& labels);

/// Neighbouring pixels lie on one surface more often than not: of right labels of rooms more than 19 in 20 pairs agree;
/// thin things in small frames leave fewer. Where fewer than kAgreement do, labels are noisy; labels of under kFewShare
/// of all pixels are few; the others are many. Labels that have hardly a neighbour, such as clicks, cannot be seen to
/// be noisy.
inline constexpr double kAgreement = 0.8, kFewShare = 0.002;
LabelKind kind_of(const LabelStatistics& statistics);

/// Leaves each pass the first branch for these labels, or for any. A sentence for each pass that had a choice.
std::vector<std::string> choose_branches(RunConfig& config, const LabelStatistics& statistics);

}  // namespace semfield
