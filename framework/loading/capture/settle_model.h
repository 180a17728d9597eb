// The last of the steps to poses: what does not fit a model is taken out of it, and the rest is adjusted.
#pragma once

#include <string>
#include <vector>

#include "loading/capture/colmap_steps.h"

namespace semfield {

struct SettleTask {
  std::string model;                      ///< folder of the model
  FeatureSettings features;               ///< that it was found with
  const std::vector<std::string>& names;  ///< of all images, in the order in which they were taken
  std::string work;                       ///< folder of the models on the way, in which "refined" is the last
};

/// A mapper ends with observations that are wrong among those that are right, and least squares [Schonberger16] weighs
/// the wrong ones most. So torn_images() are placed anew among the points of the others, misplaced_images() are left
/// out, lenses become OPENCV ones or fisheyes, and three times what misses its point by more than 3, 2 and 2 times the
/// mean error is left out and all else adjusted. Returns the names of the misplaced images.
std::vector<std::string> settle_model(const SettleTask& task, const ColmapSteps& colmap);

}  // namespace semfield
