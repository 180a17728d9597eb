// The labels that train: selected, read from files, degraded - beside the scene's own, which stay the truth.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "core/error.h"
#include "labels/clicks.h"
#include "labels/label_files.h"
#include "scene/loading/frame_source.h"

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

// What a network saw, as checksums: whether a scene and its labels are still those of training.

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

// The file of a run's clicks: which one it is, whether it is still the one that training knew, and who may append to
// it.

/// For a run in `run_dir`: its own file is written down as "clicks.jsonl", so a folder that is moved or copied has its
/// own; any other file as an absolute path.
void settle_click_file(LabelConfig& labels, const std::string& run_dir);

/// What the checkpoint of a run says of its clicks.
struct ClicksTrained {
  bool any_checkpoint = false;
  std::optional<EventsKnown> known;  ///< none: there were none, or an earlier version wrote it
};
/// Throws Error(no_input) where training knew clicks and their file is missing or empty, and where a run without room
/// for classes lacks the file; warns where the file does not begin with the events that training knew. Further events
/// are no change.
void require_clicks(const ClicksTrained& trained, const LabelConfig& labels, const std::string& run_dir,
                    Diagnostics& diagnostics);

/// Opens the file to append to it. Throws as ClickLog::open, Error(cannot_create) for a file in the folder of another
/// run, and for one that has grown since `labels` read it.
ClickLog open_click_log(const LabelConfig& labels, const std::string& run_dir, Diagnostics& diagnostics);

// What the degradations share: the walk over frames with hard labels, and the classes that a scene has.

/// Frames that have labels, ascending. `type` names the degradation in messages. Throws Error(data) naming a frame
/// whose labels are soft.
std::vector<std::size_t> hard_frames(const LoadedScene& scene, const LabelSet& labels, std::string_view type);

/// Internal indices, ascending, of the classes that occur in the scene's own labels, of whatever split and frame: what
/// is drawn at random is drawn from these, since a table may know many classes that the scene does not have. All
/// classes of the table where the scene has no labels of its own. Throws Error(data) for an empty table.
std::vector<std::int16_t> scene_classes(const LoadedScene& scene, std::string_view type);

/// Calls change(frame, labels [H * W]) for every frame of hard_frames(), in parallel; a frame's result may depend on
/// the frame alone. Returns the facts that every degradation tells: frames, labelled pixels before and after, pixels
/// whose label is another one.
StepFacts change_hard_labels(const LoadedScene& scene, std::string_view type, LabelSet& labels,
                             const std::function<void(std::size_t frame, std::vector<std::int16_t>& hard)>& change);

/// Whole number nearest to share * count; halves go up. At most `count` for shares up to 1.
std::int64_t rounded_share(double share, std::int64_t count);

}  // namespace semfield
