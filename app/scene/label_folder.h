// Training labels written out as images with a manifest.
#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "labels/training_labels.h"

namespace semfield {

/// Throws Error(cannot_create) when `folder` exists and is no empty folder.
void refuse_used_folder(const std::string& folder);

/// What is said of the labels beside the images.
struct DegradeSource {
  std::string config;       ///< the resolved configuration, YAML
  std::string labels_from;  ///< "" = the scene's own
  std::int64_t seed = 0;
};

/// Figures of the written labels; scores are against the scene's own labels, as ConfusionMatrix defines them, and none
/// where the scene has none.
struct DegradeReport {
  int frames = 0;
  std::int64_t labelled_px = 0;
  std::optional<double> accuracy, miou_present;
};

/// Writes the labels of every frame that has any, of its image as viewers show it, into a new folder:
///   semantic_class/semantic_class_N.png (frames named rgb_N) or semantic_class/FRAME_label.png: ids as on disk
///   preview/FRAME_label_vis.png: the same in colours
///   probability/FRAME.npy: float32 [height, width, classes] in the order of internal indices, frames with soft labels
///     only; their label image holds the most probable class. classes.json beside them: the names in that order
///   classes.yaml (with an entry for void), manifest.json
/// The folder appears under its name when all of it is written: until then it is called `folder`.unfinished-PID, and an
/// error removes it. Throws Error(cannot_create) as refuse_used_folder does, Error(data) for labels of no frame and for
/// two frames whose names give one file.
DegradeReport write_degraded(const LoadedScene& scene, const TrainingLabels& labels, const DegradeSource& source,
                             const std::string& folder);

}  // namespace semfield
