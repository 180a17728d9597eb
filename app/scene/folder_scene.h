// A scene that no configuration names yet: what lies in a folder, which dataset reads it, and the configuration for it.
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "app/app_context.h"
#include "config/config_tree.h"
#include "labels/training_labels.h"
#include "scene/camera_rig.h"
#include "scene/dataset.h"
#include "scene/loading/capture/fix_cameras.h"
#include "scene/loading/frame_source.h"
#include "scene/loading/packed_scene.h"

namespace semfield::app {

/// Loads any scene, so that it can be looked at before one is advised.
inline constexpr const char* kUsualPreset = "presets/room.yaml";

struct FolderScene {
  std::string path;                 ///< as given
  std::string name;                 ///< of its folder: what the configuration and its runs are called
  std::string what;                 ///< in a few words: "a COLMAP model in sparse/0"
  std::string type;                 ///< name of the dataset that reads it
  std::vector<std::string> others;  ///< of those that could, too
  ConfigNode section;               ///< `scene` with absolute paths: the dataset, and what is not its default
  std::int32_t train_frames = 0, test_frames = 0;
  bool labels = false;                       ///< of any frame
  std::int32_t width_px = 0, height_px = 0;  ///< of its largest frame, as stored
};

/// Whether a word names a folder that is no run, or a file that a dataset knows, and no configuration.
bool names_a_scene(const std::string& word, const AppContext& context);

/// Asks every dataset for what it knows in `path`; of several, that takes the scene which brings most: labels, then
/// depth, then bounds. `type` names one that is to read it, "" = any. Throws Error(no_input) where none knows anything:
/// with what a dataset says of how it could be one.
FolderScene find_scene(const std::string& path, const std::string& type, AppContext& context);

/// The tree of a configuration: `preset` by include, the scene, and images of a size that trains well.
ConfigNode config_of(const FolderScene& scene, const std::string& preset);

/// What divides the sides of the scene's images in config_of.
int downscale_of(const FolderScene& scene);

// A scene whose cameras were fixed, written as a transforms.json of its own.

/// Writes images/, depth/, label/, instance/, mask/, classes.yaml and, last, transforms.json into `folder`. Photographs
/// are copied as they are where they are files; depth keeps its own camera where that is another ("depth_camera").
/// Frames keep names and splits.
void write_fixed_scene(const PosedScene& scene, const FixedCameras& cameras, const std::string& folder,
                       const CaptureProgress& progress);

// Training labels written out as images with a manifest.

/// Throws Error(cannot_create) when `folder` exists and is no empty folder.
void refuse_used_folder(const std::string& folder);

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
///   classes.yaml (with an entry for void), manifest.json, which says where the labels are from by `config`
/// The folder appears under its name when all of it is written: until then it is called `folder`.unfinished-PID, and an
/// error removes it. Throws Error(cannot_create) as refuse_used_folder does, Error(data) for labels of no frame and for
/// two frames whose names give one file.
DegradeReport write_degraded(const LoadedScene& scene, const TrainingLabels& labels, const RunConfig& config,
                             const std::string& folder);

// A dataset written as one packed scene.

/// What was written.
struct PackSummary {
  int frames = 0;
  std::uint64_t bytes = 0;
};

/// Opens `dataset`, checks it (throws Error listing every problem), and writes its frames at the size that `size`
/// states for, one at a time. Bounds, near and far of `size` and of the dataset go into the manifest as they are;
/// nothing is derived.
PackSummary pack_scene(Dataset& dataset, const std::string& path, const SceneLoadOptions& size,
                       Diagnostics& diagnostics);

// The frames of a dataset in Replica layout.

/// Names of the classes in the order of internal indices, which is that of the last axis of probabilities; labels of
/// type npz read them.
std::string class_order_json(const ClassTable& classes);

/// Writes every frame of an opened dataset: traj_w_c.txt (4x4 OpenCV camera-to-world, one line per frame),
/// rgb/rgb_N.png, depth/depth_N.png (uint16 mm z-depth, 0 beyond 65.534 m), semantic_class/semantic_class_N.png (ids as
/// on disk), semantic_instance/ semantic_instance_N.png, classes.yaml (with an entry for void), intrinsics.txt (width
/// height fx fy cx cy hfov_deg, +0.5 pixel centres). Channels that the dataset lacks are left out. Frames are numbered
/// 0.. in dataset order. `progress` gets the number of frames done. `info` is converted already; `convention` brings
/// the depth right. Throws Error(cannot_create) when `out_dir` already holds a trajectory, Error(data) when frames
/// differ in camera or have lens distortion (the layout has one pinhole camera).
PackSummary capture_replica(const Dataset& dataset, const SceneInfo& info, const std::string& out_dir,
                            const std::function<void(int done, int total)>& progress = {},
                            const PoseConvention& convention = {});

}  // namespace semfield::app
