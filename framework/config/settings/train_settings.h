// The sections `train`, `train.cameras` and `train.self_training`: each key is a member, with its default, and a line
// of describe().
#pragma once

#include <algorithm>
#include <cstdint>
#include <functional>
#include <vector>

#include "config/params.h"
#include "core/error.h"

namespace semfield {

/// automatic: the labels decide when a session opens (config/settings/choices.h).
enum class RaySourceKind : std::uint8_t { all_images, one_image, label_balanced, automatic };
SEMFIELD_CHOICES(RaySourceKind, "all_images", "one_image", "label_balanced", "auto");

struct TrainParams {
  std::int64_t steps = 20000;
  double time_s = 0;
  std::int64_t rays = 1024;
  RaySourceKind ray_source = RaySourceKind::all_images;
  double labelled_share = 0.5;
  bool label_rays_teach_color = true;
};

inline void describe(ParamVisitor& visit, TrainParams& p) {
  SEMFIELD_PARAM(
      visit, p, steps,
      "optimiser steps of the run; 0: as many as fit into time_s, or without it 3000 on a CPU and 20000 on a "
      "GPU, and run.yaml has the number",
      {0, 1e9});
  SEMFIELD_PARAM(visit, p, time_s,
                 "seconds of training that steps and schedule are settled for where steps is 0; 0: none", {0, 1e8});
  SEMFIELD_PARAM(visit, p, rays,
                 "rays per step; 0: 1024 on a CPU, on a GPU 8192 or, where far is open, 32768; run.yaml has the number",
                 {0, 1 << 20});
  SEMFIELD_PARAM(
      visit, p, ray_source,
      "where a step's rays come from: pixels of all images or of one, drawn evenly; label_balanced draws "
      "labelled_share of them from labelled pixels; auto is label_balanced where training pixels have labels or "
      "may get them, else all_images, and run.yaml has the choice");
  SEMFIELD_PARAM(visit, p, labelled_share, "share of rays from labelled pixels, for label_balanced", {0, 1});
  SEMFIELD_PARAM(
      visit, p, label_rays_teach_color,
      "false: rays that label_balanced draws for their labels do not enter the colour loss, which then "
      "comes from evenly drawn rays alone. A few labelled pixels that are drawn again and again spoil geometry");
}

inline void validate(const TrainParams& p, Diagnostics& diagnostics) {
  const bool balanced = p.ray_source == RaySourceKind::label_balanced || p.ray_source == RaySourceKind::automatic;
  if (!balanced || p.label_rays_teach_color || p.labelled_share < 1) return;
  diagnostics.error("config.value.conflict", "train.labelled_share",
                    "1 draws every ray for its label, and label_rays_teach_color is false: nothing would teach colour",
                    "lower labelled_share, or set train.label_rays_teach_color: true");
}

/// What is believed of training cameras: as given, or learned with the field (model/camera_corrections.h). `automatic`
/// is decided by the scene (choices.h).
enum class CameraTrust : std::uint8_t { given, learned, automatic };
SEMFIELD_CHOICES(CameraTrust, "given", "learned", "auto");
struct CameraParams {
  CameraTrust poses = CameraTrust::given, colors = CameraTrust::given;
  double pose_rate = 0.02;
  double color_rate = 0.02;
  double from_step = 0.1;
};

inline void describe(ParamVisitor& visit, CameraParams& p) {
  SEMFIELD_PARAM(
      visit, p, poses,
      "poses of training cameras: as given, or learned with the field where they are off by more than a pixel; "
      "right ones suffer from it. auto is learned where a phone's tracker gave them, and run.yaml has the choice");
  SEMFIELD_PARAM(visit, p, colors,
                 "colours of training cameras: as given, or learned, an affine map per camera, where exposure or white "
                 "balance changes between photographs; auto looks whether brightness of overlapping frames does");
  SEMFIELD_PARAM(
      visit, p, pose_rate,
      "factor to the learning rate of poses, in radians and shifts in halves of the scene's longest side; it "
      "falls with the third power of the schedule",
      {0, 1e6});
  SEMFIELD_PARAM(
      visit, p, from_step,
      "share of the run after which poses and colours move: before it the field is fog, which moves right ones",
      {0, 1});
  SEMFIELD_PARAM(visit, p, color_rate, "factor to the learning rate of colours; it falls with the third power too",
                 {0, 1e6});
}

/// Rounds of self-training (train/self_training.h).
struct SelfTrainingParams {
  std::vector<double> at;
  double confidence = 0.9;
  double min_opacity = 0.5;
};

inline void describe(ParamVisitor& visit, SelfTrainingParams& p) {
  SEMFIELD_PARAM(visit, p, at,
                 "shares of train.steps, ascending, at which the field labels the training pixels that it is sure of; "
                 "empty: never",
                 {1e-6, 0.999999});
  SEMFIELD_PARAM(visit, p, confidence, "least probability of a pixel's most probable class that becomes its label",
                 {0, 1});
  SEMFIELD_PARAM(visit, p, min_opacity, "opacity of a rendered pixel below which it gets no label", {0, 1});
}

inline void validate(const SelfTrainingParams& p, Diagnostics& diagnostics) {
  if (std::is_sorted(p.at.begin(), p.at.end(), std::less_equal<>())) return;
  diagnostics.error("config.value.order", "train.self_training.at", "the shares do not ascend",
                    "write the smallest first, each once");
}

}  // namespace semfield
