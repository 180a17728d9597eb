#include "app/render/report_scene.h"

#include <algorithm>

#include "app/render/run_surface.h"
#include "app/render/scene_page.h"
#include "core/error.h"

namespace semfield::app {

namespace {

constexpr long long kCells = 64;  // along the longest side
constexpr std::int64_t kMostRays = 60'000, kLeastRays = 15'000;
constexpr std::int64_t kShare = 10;  // of the rays of training: one of so many

}  // namespace

std::string report_scene(const Session& session, const std::string& run_dir, std::int64_t step,
                         const AppContext& context) {
  const std::int64_t rays = std::min(kMostRays, step * session.config.train.rays / kShare);
  if (rays < kLeastRays) return {};
  SurfaceWishes wishes;
  wishes.resolution = kCells;
  wishes.depth_rays = rays;
  try {
    const RunSurface found = make_run_surface(session, run_dir, wishes, {}, {});
    return scene_page_text(found.surface, session.scene.info.classes,
                           scene_page_of(session, run_dir, step, upright_of(session).value_or(Vec3d{0, 1, 0})));
  } catch (const Error& e) {
    if (e.kind() != ErrorKind::data && e.kind() != ErrorKind::no_input) throw;
    print_note(context, "no view in 3D in the report: " + e.message());
    return {};
  }
}

}  // namespace semfield::app
