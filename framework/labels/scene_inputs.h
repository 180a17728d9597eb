// What a network saw, as checksums: whether a scene and its labels are still those of training.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "core/error.h"
#include "labels/training_labels.h"
#include "loading/frame_source.h"

namespace semfield {

/// Checksums in hexadecimal digits.
struct SceneInputs {
  std::int64_t frames = 0;
  std::string names;    ///< of frames, with their splits, in order
  std::string cameras;  ///< poses, lenses and sizes as loaded, to six digits
  std::string colors;   ///< pixels; "" where none was read
  /// These two are not in checkpoints of earlier versions; "" where there are none, or none was read.
  std::optional<std::string> labels;           ///< the scene's own of all frames, by which test frames are scored
  std::optional<std::string> training_labels;  ///< that train, without clicks
  std::string hash() const;
};
SceneInputs scene_inputs(const LoadedScene& scene, const TrainingLabels& labels);
/// "other images", "other labels", ...: what differs. What one side does not know is not compared.
std::vector<std::string> other_inputs(const SceneInputs& a, const SceneInputs& b);

/// One warning where frames, cameras, images or labels are others; a note where the checkpoint does not tell labels.
void warn_of_other_inputs(const SceneInputs& trained, const SceneInputs& now, Diagnostics& diagnostics);

/// One JSON object. Reading throws Error(data) with the cause.
std::string inputs_text(const SceneInputs& inputs);
SceneInputs read_inputs_text(const std::string& text);

}  // namespace semfield
