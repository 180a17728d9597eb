// The frames of a dataset in Replica layout.
#pragma once

#include <functional>
#include <string>

#include "plugin/dataset.h"
#include "scene/camera_rig.h"

namespace semfield {

/// What capture_replica wrote, for the message at its end.
struct CaptureReport {
  int frames = 0;
  std::int64_t depth_clipped = 0;  ///< pixels beyond 65.534 m, written as invalid
  std::int64_t bytes = 0;
};

/// Writes every frame of an opened dataset: traj_w_c.txt (4x4 OpenCV camera-to-world, one line per frame),
/// rgb/rgb_N.png, depth/depth_N.png (uint16 mm z-depth), semantic_class/semantic_class_N.png (ids as on disk),
/// semantic_instance/ semantic_instance_N.png, classes.yaml (with an entry for void), intrinsics.txt (width height fx
/// fy cx cy hfov_deg, +0.5 pixel centres). Channels that the dataset lacks are left out. Frames are numbered 0.. in
/// dataset order. `progress` gets the number of frames done. `info` is converted already; `convention` brings the depth
/// right. Throws Error(cannot_create) when `out_dir` already holds a trajectory, Error(data) when frames differ in
/// camera or have lens distortion (the layout has one pinhole camera).
CaptureReport capture_replica(const Dataset& dataset, const SceneInfo& info, const std::string& out_dir,
                              const std::function<void(int done, int total)>& progress = {},
                              const PoseConvention& convention = {});

}  // namespace semfield
