// The labels that train: selected, read from files, degraded - beside the scene's own, which stay the truth.
#pragma once

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "labels/clicks/annotations.h"
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
  std::string run_dir;        ///< absolute; where a relative selection.clicks starts, which is the run's own file
  /// The path of selection.clicks; "" where it names none.
  std::string click_file() const;
  /// What selection.clicks tells, once open_label_files has read it; none without the keys clicks and class_room.
  std::optional<Annotations> clicks;
  bool needs_instances() const;
  bool wants_depth() const;
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
  /// The same before clicks were painted over them; empty without LabelConfig::clicks.
  std::vector<Frame> unclicked;
  bool soft = false;  ///< some frame has soft labels
  struct Step {
    std::string type;
    StepFacts facts;
  };
  std::vector<Step> steps;                              ///< what was done, for the manifest
  std::vector<std::vector<std::int64_t>> class_pixels;  ///< [frames][C + 1] as in LoadedScene, of these labels
};

/// Opens `from` (nothing without one): a scene without a class table takes the files' one. Throws when there is none.
/// Then reads `clicks`, whose classes and those that wait for a name stand behind the others of the table.
void open_label_files(LoadedScene& scene, LabelConfig& config, Diagnostics& diagnostics);

/// Labels of test frames that the dataset does not have, from the files of `from`: they are the truth of these frames.
void read_test_labels(LoadedScene& scene, const LabelConfig& config, Diagnostics& diagnostics);

/// The scene's own labels of training frames, or those of `from`, scaled to the loaded size by the nearest pixel; then
/// the selection of frames; then every degradation in order, with the selection's seed; a type that is named again
/// draws anew; then the clicks, whatever the selection. The scene's own labels stay in `scene` as the truth. Call
/// open_label_files first.
TrainingLabels make_training_labels(const LoadedScene& scene, const LabelConfig& config, Diagnostics& diagnostics);

/// The labels of a training frame become those of `unclicked` with its clicks of now.
void paint_clicks(const Annotations& clicks, int frame, TrainingLabels& labels);

}  // namespace semfield
