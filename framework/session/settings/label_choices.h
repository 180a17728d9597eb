// What the labels that train decide: which of a pass's semantic branches is built, and where rays come from.
#pragma once

#include <string>
#include <vector>

#include "labels/training_labels.h"
#include "session/settings/run_config.h"

namespace semfield {

/// What can be seen of training labels without knowing whether they are right.
struct LabelStatistics {
  std::int64_t pixels = 0, labelled = 0;   ///< of all training frames
  std::int64_t neighbours = 0, equal = 0;  ///< labelled pixels beside or above one another; those with equal labels
  /// The same of labelled pixels that have no labelled pixel between them, in a row or column, and are 2 to kReach
  /// apart.
  std::int64_t apart = 0, apart_equal = 0;
  double share() const { return part(labelled, pixels, 0); }
  double agreement() const { return part(equal, neighbours, 1); }
  double agreement_apart() const { return part(apart_equal, apart, 1); }
  /// Whether enough of them lie side by side, or near one another, to say that they agree.
  bool side_by_side() const { return 2 * neighbours >= labelled && neighbours > 0; }
  bool near_one_another() const { return 2 * apart >= labelled && apart > 0; }

 private:
  static double part(std::int64_t of, std::int64_t all, double none) {
    return all > 0 ? static_cast<double>(of) / static_cast<double>(all) : none;
  }
};
inline constexpr std::int32_t kReach = 32;
LabelStatistics label_statistics(const LoadedScene& scene, const TrainingLabels& labels);

/// Neighbouring pixels lie on one surface more often than not: of right labels of rooms more than 19 in 20 pairs agree;
/// thin things in small frames leave fewer. Where fewer than kAgreement do, labels are noisy. On a grid of 8 to 32
/// pixels 0.86 to 0.44 of the pairs of right labels agree (Replica walk, 320 and 160 pixels wide), and 0.23 to 0.10
/// where half of the labels are wrong; the border there is kAgreementApart. Labels of under kFewShare of all pixels are
/// few, those of kDenseShare and more are dense; the others are many. Few labels that have hardly a neighbour, such as
/// clicks, cannot be seen to be noisy.
inline constexpr double kAgreement = 0.8, kAgreementApart = 0.3, kFewShare = 0.002, kDenseShare = 0.5;
LabelKind kind_of(const LabelStatistics& statistics);

/// Leaves each pass the first branch for these labels, or for any. A sentence for each pass that had a choice.
std::vector<std::string> choose_branches(RunConfig& config, const LabelStatistics& statistics);

/// How many training pixels have a label, and whether such may come later: clicks, or labels that a program sets.
struct LabelCount {
  std::int64_t labelled_px = 0, train_px = 0;
  bool may_come = false;
};
/// Puts what `auto` is in place of it: label_balanced where labels are or may come, else all_images. Returns a
/// sentence, or "".
std::string choose_ray_source(TrainParams& train, const LabelCount& labels);
/// Warns where rays are drawn evenly by hand although under kRareShare of the pixels have a label: steps then hardly
/// see one.
inline constexpr double kRareShare = 0.05;
void warn_of_rare_labels(const TrainParams& train, const LabelCount& labels, Diagnostics& diagnostics);

}  // namespace semfield
