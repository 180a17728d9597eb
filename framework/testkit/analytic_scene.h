// A small room rendered by formulas: a dataset without files whose truth is exact, for tests of everything downstream.
#pragma once

#include <cstdint>
#include <memory>

#include "plugin/dataset.h"

namespace semfield::testkit {

struct AnalyticSceneOptions {
  int frames = 12;  ///< on a circle, looking across the room; every fourth is a test frame
  std::int32_t width_px = 48;
  std::int32_t height_px = 36;
  bool with_depth = true;
  bool with_labels = true;
};

/// What a ray meets in the analytic room. Colour is 0..1 display-referred and does not depend on the viewing direction.
struct AnalyticHit {
  double t_m = 0;
  Vec3d point, normal, color;
  int label = 0;  ///< internal class index: 0 wall, 1 floor, 2 ceiling, 3 ball, 4 crate
};

/// First surface along a ray that starts inside the room (4 m x 3 m x 2 m around the origin, z up).
AnalyticHit intersect_analytic_room(Vec3d origin, Vec3d unit_direction);

/// Frames 48 x 36 by default with colour, z-depth in metres and labels; ids 1..5 are the classes above and id 0 is
/// void. read() renders.
std::unique_ptr<Dataset> make_analytic_scene(const AnalyticSceneOptions& options = {});

}  // namespace semfield::testkit
