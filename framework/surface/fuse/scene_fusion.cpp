#include "surface/fuse/scene_fusion.h"

#include <algorithm>

#include "core/usual_metre.h"
#include "scene/scene_checks.h"

namespace semfield {

namespace {

// Poses of one frame in two readings of a scene: text files round, so not bit for bit.
bool same_pose(const Pose& a, const Pose& b, double metre) {
  constexpr double kRotation = 1e-4, kShift = 1e-4;
  for (int i = 0; i < 3; ++i) {
    if (length(a.axis(i) - b.axis(i)) > kRotation) return false;
  }
  return length(a.t - b.t) <= kShift * (metre + length(a.t));
}

void check_frame(const FrameInfo& frame, const TrainedField& run) {
  const std::vector<FrameInfo>& known = run.session.scene.info.frames;
  const auto found =
      std::find_if(known.begin(), known.end(), [&](const FrameInfo& other) { return other.name == frame.name; });
  if (found == known.end()) {
    throw Error(ErrorKind::data, "fuse.depth.foreign",
                frame_place(frame) + ": the scene of " + run.run_dir + " has no frame of this name",
                "take depth from a run of this scene");
  }
  const double metre = usual_metre(run.session.scene.info.metric, run.session.extent.bounds.size());
  if (!same_pose(found->world_from_camera, frame.world_from_camera, metre)) {
    throw Error(ErrorKind::data, "fuse.depth.foreign",
                frame_place(frame) + ": the camera stands elsewhere in the scene of " + run.run_dir,
                "take depth from a run of this scene");
  }
}

bool same_classes(const ClassTable& a, const ClassTable& b) {
  const auto same = [](const ClassEntry& x, const ClassEntry& y) { return x.id == y.id && x.ignore == y.ignore; };
  return std::equal(a.entries().begin(), a.entries().end(), b.entries().begin(), b.entries().end(), same);
}

}  // namespace

FrameMaps true_depth(const LoadedScene& scene) {
  FrameMaps maps;
  bool any = false;
  for (const int f : scene.frames_of(Split::train)) {
    const StoredFrame& frame = scene.frames[static_cast<std::size_t>(f)];
    any = any || !frame.depth_m.empty();
    maps.frames.push_back(f);
    maps.depth_m.push_back(frame.depth_m.empty() ? std::vector<float>(frame.rgb.size() / 3) : frame.depth_m.expand());
  }
  if (!any) {
    throw Error(ErrorKind::data, "fuse.depth.none", "no training frame of the scene has depth",
                "train on the scene and take the depth of the run: --depth-from RUN");
  }
  maps.label.resize(maps.frames.size());
  return maps;
}

FrameMaps learned_depth(const TrainedField& run, const LoadedScene& scene, double min_opacity,
                        const std::function<void(int done)>& done) {
  const Session& s = run.session;
  const bool labels = s.pipeline->has_semantics() && same_classes(s.scene.info.classes, scene.info.classes);
  FrameMaps maps;
  maps.frames = scene.frames_of(Split::train);
  for (const int f : maps.frames) check_frame(scene.info.frames[static_cast<std::size_t>(f)], run);
  for (const int f : maps.frames) {
    const FrameInfo& info = scene.info.frames[static_cast<std::size_t>(f)];
    const RayCamera camera{info.camera, info.world_from_camera, s.plan.undistortion};
    RenderedFrame frame = render_named_frame(*s.pipeline, info.name, camera, s.limits, s.plan.class_of_logit);
    for (std::size_t i = 0; i < frame.depth_m.size(); ++i) {
      const float opacity = frame.opacity[i];
      frame.depth_m[i] = opacity >= static_cast<float>(min_opacity) ? frame.depth_m[i] / opacity : 0.0F;
    }
    maps.depth_m.push_back(std::move(frame.depth_m));
    maps.label.push_back(labels ? std::move(frame.label) : std::vector<std::int16_t>());
    if (done) done(static_cast<int>(maps.depth_m.size()));
  }
  return maps;
}

FusionParams settled(const FusionParams& params, const LoadedScene& scene) {
  FusionParams out = params;
  const Vec3d size = scene.bounds.empty() ? Vec3d{} : scene.bounds.size();
  if (params.tolerance == 0) out.tolerance = 0.01 * usual_metre(scene.info.metric, size);
  return out;
}

SceneFusion fuse_scene(const LoadedScene& scene, const TrainingLabels& labels, const FrameMaps& maps,
                       const FusionParams& given, const OnFused& on_fused) {
  const FusionParams params = settled(given, scene);
  const int classes = scene.info.classes.valid_count();
  std::vector<FusionView> views;
  for (std::size_t k = 0; k < maps.frames.size(); ++k) {
    const auto f = static_cast<std::size_t>(maps.frames[k]);
    const FrameInfo& info = scene.info.frames[f];
    views.push_back({{info.camera, info.world_from_camera, maps.depth_m[k]}, &labels.frames[f]});
  }
  const LabelFusion fusion(views, classes, params);
  const std::vector<FusionMethod> methods = fusion_methods(params.methods);
  SceneFusion out;
  for (const FusionMethod method : methods)
    out.scores.push_back({std::string(fusion_method_name(method)), ConfusionMatrix(classes), {}});
  const bool field =
      std::any_of(maps.label.begin(), maps.label.end(), [](const auto& label) { return !label.empty(); });
  if (field) out.scores.push_back({"field", ConfusionMatrix(classes), {}});
  for (std::size_t k = 0; k < maps.frames.size(); ++k) {
    const FusedFrame fused = fusion.fuse(static_cast<int>(k));
    out.counts.merge(fused.counts);
    const std::vector<std::int16_t> truth = scene.frames[static_cast<std::size_t>(maps.frames[k])].label.expand();
    for (std::size_t m = 0; m < out.scores.size(); ++m) {
      const std::vector<std::int16_t>& label =
          m < methods.size() ? fused.label[static_cast<std::size_t>(methods[m])] : maps.label[k];
      if (label.empty()) continue;
      if (!truth.empty()) out.scores[m].confusion.add(truth, label);
      if (on_fused) on_fused(out.scores[m].method, maps.frames[k], label);
    }
  }
  for (std::size_t m = 0; m < methods.size(); ++m)
    out.scores[m].views_mean = methods[m] == FusionMethod::monocular ? 1 : out.counts.views_mean();
  return out;
}

}  // namespace semfield
