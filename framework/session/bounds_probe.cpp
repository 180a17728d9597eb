#include "session/bounds_probe.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "loading/load_progress.h"
#include "session/settings/run_length.h"
#include "session/trainer.h"

namespace semfield {

namespace {

constexpr std::int64_t kShortestRun = 4;  // in probes
constexpr double kMostPoints = 1 << 16;   // rays that look for depth
constexpr float kLeastOpacity = 0.5F;

// The rendered depth of one training frame, where its rays meet something.
SurveyPoints look(const Session& s, const FrameInfo& info, double downscale) {
  const auto smaller = [&](std::int32_t size) { return std::max(1, static_cast<std::int32_t>(size / downscale)); };
  const RayCamera camera{info.camera.resized(smaller(info.camera.width_px), smaller(info.camera.height_px)),
                         info.world_from_camera, s.plan.undistortion};
  const RenderedFrame seen = render_frame(*s.pipeline, camera, s.limits, s.plan.class_of_logit);
  FrameBuffer depth;
  depth.width_px = seen.width_px;
  depth.height_px = seen.height_px;
  for (std::size_t i = 0; i < seen.depth_m.size(); ++i)
    depth.depth_m.push_back(seen.opacity[i] > kLeastOpacity ? seen.depth_m[i] / seen.opacity[i] : 0);
  return survey_frame(camera.camera, camera.world_from_camera, depth, 1);
}

}  // namespace

bool probe_is_due(const Session& s) {
  const std::int64_t steps = s.config.load.probe_steps;
  const std::int64_t end = last_step(s.config);  // 0: a time is given, and the probe is no part of it
  return s.scene.extent_is_guessed && steps > 0 && (end == 0 || end >= kShortestRun * steps);
}

std::optional<SurveyedExtent> probe_extent(Session& s) {
  const std::unique_ptr<RaySource> rays = s.make_ray_source();
  Trainer trainer(*s.pipeline, *rays, s.config.adam, s.config.schedule, s.config.train.steps);
  const std::int64_t steps = s.config.load.probe_steps;
  while (trainer.step() < steps) {
    trainer.advance_many(steps - trainer.step());
    tell_load_progress("looking for the bounds", static_cast<std::size_t>(trainer.step()),
                       static_cast<std::size_t>(steps));
  }
  tell_load_progress("read", 1, 1);
  trainer.collect();
  const double downscale = std::sqrt(std::max(1.0, static_cast<double>(rays->pixel_count()) / kMostPoints));
  std::vector<SurveyPoints> parts;
  for (const int f : s.scene.frames_of(Split::train))
    parts.push_back(look(s, s.scene.info.frames[static_cast<std::size_t>(f)], downscale));
  return extent_of_points(std::move(parts));
}

void use_probed_extent(const SurveyedExtent& seen, LoadedScene& scene, SceneLoadOptions& load,
                       Diagnostics& diagnostics) {
  const Vec3d before = scene.bounds.size();
  const double far_before = scene.far_m;
  Box box;
  for (int a = 0; a < 3; ++a) {
    box.lo[a] = std::max(scene.bounds.lo[a], seen.bounds.lo[a]);
    box.hi[a] = std::min(scene.bounds.hi[a], seen.bounds.hi[a]);
  }
  load.bounds = {box.lo.x, box.lo.y, box.lo.z, box.hi.x, box.hi.y, box.hi.z};
  if (load.far_m <= 0) load.far_m = std::min(scene.far_m, seen.far_m);
  if (load.near_m <= 0) load.near_m = std::min(seen.near_m, 0.5 * load.far_m);
  Diagnostics repeated;
  derive_extent(scene, {}, load, repeated);
  scene.bounds_from = scene.near_far_from = fmt::format("a probe of {} steps", load.probe_steps);
  const Vec3d size = box.size();
  diagnostics.note(
      "scene.bounds.probed", "scene.load.bounds",
      fmt::format("{:.3g} x {:.3g} x {:.3g} and far {:.3g}: where a probe of {} steps shows surfaces; the "
                  "cameras alone gave {:.3g} x {:.3g} x {:.3g} and far {:.3g}, which probe_steps: 0 keeps",
                  size.x, size.y, size.z, load.far_m, load.probe_steps, before.x, before.y, before.z, far_before));
}

}  // namespace semfield
