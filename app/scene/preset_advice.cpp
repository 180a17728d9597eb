#include "app/scene/preset_advice.h"

#include <fmt/format.h>

#include <algorithm>

namespace semfield {

namespace {

// The distance from the cameras' common focus beyond which one corner in twenty lies, in distances of the cameras from
// it; 0 where too few corners were found again to say.
double reach_of_surroundings(const LoadedScene& scene) {
  constexpr std::size_t kFewestCorners = 100;
  const SurveyPoints& c = scene.corners;
  if (c.x.size() < kFewestCorners || !(scene.rig.distance_m > 0)) return 0;
  std::vector<double> away;
  for (std::size_t i = 0; i < c.x.size(); ++i) away.push_back(length(Vec3d{c.x[i], c.y[i], c.z[i]} - scene.rig.focus));
  const auto far = away.begin() + static_cast<std::ptrdiff_t>(0.95 * static_cast<double>(away.size()));
  std::nth_element(away.begin(), far, away.end());
  return *far / scene.rig.distance_m;
}

}  // namespace

std::string PresetAdvice::text() const {
  const std::string set = background ? fmt::format(" with rendering.background: [{:.3g}, {:.3g}, {:.3g}]",
                                                   (*background)[0], (*background)[1], (*background)[2])
                                     : "";
  return preset + set + ": " + why;
}

std::optional<PresetAdvice> advised_preset(const LoadedScene& scene) {
  constexpr double kOpen = 5;  // a room around its subject ends nearer
  if (scene.bounds.empty()) return std::nullopt;
  PresetAdvice out{"presets/room.yaml", "", std::nullopt};
  if (scene.plain_background) {
    const auto& c = scene.plain_background->color;
    out.preset = "presets/object.yaml";
    out.why = fmt::format("the cameras stand around an object before one colour, ({}, {}, {})", c[0], c[1], c[2]);
    if (c[0] != 255 || c[1] != 255 || c[2] != 255) out.background = {c[0] / 255.0, c[1] / 255.0, c[2] / 255.0};
    return out;
  }
  const bool depth =
      std::any_of(scene.info.frames.begin(), scene.info.frames.end(), [](const FrameInfo& f) { return f.has_depth; });
  if (depth || !scene.rig.inward) {
    out.why = depth ? "depth images show where the scene ends" : "the cameras do not stand around one place";
    return out;
  }
  const double reach = reach_of_surroundings(scene);
  const std::string around = "the cameras stand around one place";
  if (reach > 0 && reach < kOpen) {
    out.why =
        fmt::format("{}, and what lies behind it ends within {:.2g} times their distance, as in a room", around, reach);
    return out;
  }
  out.preset = "presets/unbounded.yaml";
  out.why = around + (reach > 0 ? fmt::format(" and see what lies behind it, beyond {:.2g} times their distance", reach)
                                : " and see what lies behind it");
  return out;
}

}  // namespace semfield
