#include "session/refined_poses.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "session/trainer.h"

namespace semfield {

namespace {

void copy_tensors(const ParamStore<float>& from, ParamStore<float>& to) {
  for (const Tensor<float>& t : from.all()) {
    const Tensor<float>* there = to.find(t.name);
    if (there != nullptr && is_stored(t.spec.role)) std::copy_n(t.value.data(), t.value.size(), there->value.data());
  }
}

// Degrees between the axes of two poses.
double angle_deg(const Pose& a, const Pose& b) {
  double trace = 0;
  for (int axis = 0; axis < 3; ++axis) trace += dot(a.axis(axis), b.axis(axis));
  return std::acos(std::clamp(0.5 * (trace - 1), -1.0, 1.0)) * 180 / M_PI;
}

}  // namespace

void use_learned_poses(Session& s, const TensorFile& checkpoint, Diagnostics& diagnostics) {
  const std::string name = std::string(CameraCorrections<float>::kPoseName) + "/learned";
  const TensorRef* learned = checkpoint.find(name);
  const std::vector<int> frames = s.scene.frames_of(Split::train);
  const std::int64_t rows = std::ssize(frames);
  if (learned == nullptr) return;
  if (learned->shape != std::vector<std::int64_t>{rows, kPoseNumbers}) {
    diagnostics.warning(
        "run.poses.other", "train.cameras",
        fmt::format("the poses that the run has learned are not those of the {} training frames of this scene: those "
                    "given are used",
                    frames.size()),
        "open the run with the scene that it was trained on");
    return;
  }
  const std::vector<float> numbers = checkpoint.floats(name, rows * kPoseNumbers);
  std::vector<float> used(numbers.size());
  cpu_camera_kernels<float>().centre({numbers.data(), rows, kPoseNumbers}, 1, {used.data(), rows, kPoseNumbers});
  const double distance_m = s.pipeline->options().cameras.distance_m;
  double turned_deg = 0, moved_m = 0;
  for (std::size_t i = 0; i < frames.size(); ++i) {
    Pose& pose = s.scene.info.frames[static_cast<std::size_t>(frames[i])].world_from_camera;
    const Pose given = pose;
    pose = corrected(given, &used[kPoseNumbers * i], distance_m);
    turned_deg += angle_deg(given, pose);
    moved_m += length(pose.t - given.t);
  }
  const double each = 1.0 / static_cast<double>(std::max<std::int64_t>(rows, 1));
  diagnostics.note(
      "run.poses.learned", "train.cameras",
      fmt::format("training frames have the poses that the run has learned, {:.2f} degrees and {:.3g} m from "
                  "those given in the mean",
                  turned_deg * each, moved_m * each));
}

std::vector<Pose> refine_poses(Session& s, Registry& registry, const std::vector<int>& frames,
                               const PoseRefinement& how) {
  NetworkParts<float> parts = make_parts<float>(s.config, registry, s.plan, s.extent);
  CameraRules& cameras = parts.options.cameras;
  cameras.count = std::ssize(frames);
  cameras.poses = cameras.alone = true;
  cameras.colors = false;
  cameras.pose_rate = 1;
  parts.options.losses = LossList();
  const std::unique_ptr<Pipeline<float>> pipeline = assemble(std::move(parts), {}, true);
  s.pipeline->executor().download(0);
  copy_tensors(s.pipeline->store(), pipeline->store());
  run_on({s.pipeline->executor().device(), true, nullptr, nullptr}, s.config, registry, s.plan, s.extent, *pipeline);
  pipeline->executor().upload(0);

  std::vector<TrainFrame> drawn;
  for (const int frame : frames) {
    const auto f = static_cast<std::size_t>(frame);
    if (s.scene.frames[f].is_unusable()) continue;
    const FrameInfo& info = s.scene.info.frames[f];
    drawn.push_back(
        {{info.camera, info.world_from_camera, s.plan.undistortion}, &s.scene.frames[f], nullptr, info.name});
  }
  RaySourceOptions options;
  options.train = s.config.train;
  options.train.rays = how.rays;
  options.train.ray_source = RaySourceKind::all_images;
  options.targets = {std::string(channel::camera)};
  options.seed = s.config.runtime.seed;
  options.tile_rays = pipeline->executor().tile_rays(how.rays);
  const RaySource rays(std::move(drawn), s.plan.semantics ? s.logit_of_class() : std::vector<std::int16_t>{}, s.limits,
                       options);
  const AdamParams adam{.learning_rate = how.learning_rate, .beta2 = 0.99, .epsilon = 1e-15};
  const ScheduleParams schedule{.kind = ScheduleKind::exponential, .factor = 0.1, .decay_steps = how.steps, .legs = {}};
  Trainer trainer(*pipeline, rays, adam, schedule, how.steps);
  while (trainer.step() < how.steps) trainer.advance_many(how.steps - trainer.step());
  trainer.collect();

  const Tensor<float>* learned = pipeline->store().find(std::string(CameraCorrections<float>::kPoseName) + "/learned");
  std::vector<Pose> poses;
  for (std::size_t i = 0; i < frames.size(); ++i)
    poses.push_back(corrected(s.scene.info.frames[static_cast<std::size_t>(frames[i])].world_from_camera,
                              learned->value.data() + kPoseNumbers * i, pipeline->options().cameras.distance_m));
  return poses;
}

}  // namespace semfield
