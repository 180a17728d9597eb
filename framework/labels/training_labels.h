// The labels that train: selected, read from files, degraded - beside the scene's own, which stay the truth.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "labels/label_selection.h"
#include "labels/label_steps.h"

namespace semfield {

/// `scene.labels` as read.
struct LabelConfig {
  LabelParams selection;
  struct From {
    std::string type;
    std::unique_ptr<LabelReader> reader;  ///< null: the dataset's own labels
  } from;
  struct Step {
    std::string type;
    std::unique_ptr<Degradation> degradation;
  };
  std::vector<Step> degrade;  ///< applied in order
  bool needs_instances() const;
};

/// Labels of the training frames, packed.
struct TrainingLabels {
  struct Frame {
    LabelMap hard;
    SoftMap soft;
    bool empty() const { return hard.empty() && soft.empty(); }
    /// Class that counts for sampling and scores: the label, or the most probable class; kVoid = unlabelled.
    std::int16_t operator[](std::size_t pixel) const { return soft.empty() ? hard[pixel] : soft.argmax(pixel); }
    std::size_t size() const { return soft.empty() ? hard.size() : soft.pixels(); }
    std::size_t bytes() const { return hard.bytes() + soft.bytes(); }
  };
  std::vector<Frame> frames;  ///< as scene.info.frames
  bool soft = false;          ///< some frame has soft labels
  struct Step {
    std::string type;
    StepFacts facts;
  };
  std::vector<Step> steps;                               ///< what was done, for the manifest
  std::vector<std::vector<std::int64_t>> class_pixels;  ///< [frames][C + 1] as in LoadedScene, of these labels
};

/// Reads `from` into a loaded scene: frames get `has_labels`, a scene without a class table gets the files' one, and
/// test frames without labels of their own get theirs as truth. Returns the training labels of all frames that have
/// any (from the files, or the scene's own), before selection. Soft labels are scaled with hard ones by the nearest
/// pixel.
LabelSet read_training_labels(LoadedScene& scene, const LabelConfig& config, Diagnostics& diagnostics);

/// Selection, then every degradation in order.
TrainingLabels make_training_labels(LoadedScene& scene, const LabelConfig& config, Diagnostics& diagnostics);

}  // namespace semfield
