// What the labelling page's server is sent: requests for pictures and exports, and queries.
#include <cmath>

#include "app/serve/page_requests.h"
#include "tests/fuzz/inputs.h"
#include "tests/fuzz/targets.h"

namespace semfield::fuzz {

// As the body of every kind of request, and as a query.
void fuzz_page(std::string_view bytes) {
  accepted([&] {
    const PictureRequest r = app::parse_picture_request(bytes);
    promise((r.view >= 0) != r.camera.has_value(), "a picture of a view and of a camera");
    promise(r.color || r.labels || r.entropy, "a picture without a map");
    promise(r.most_px == 0 || (r.most_px >= 16 && r.most_px <= app::kMostPictureSide), "a picture of a wrong size");
    if (!r.camera) return;
    const Pose& pose = r.camera->world_from_camera;
    for (int a = 0; a < 3; ++a) {
      promise(std::abs(dot(pose.axis(a), pose.axis(a)) - 1) <= 1e-3, "a rotation that is none");
      promise(std::abs(pose.t[a]) <= 1e6, "a camera that is nowhere");
    }
    promise(r.camera->fov_deg >= 1 && r.camera->fov_deg <= 170, "a field of view that is none");
  });
  accepted([&] { (void)app::parse_export_request(bytes); });
  accepted([&] { promise(app::query_number(bytes, "view", 3, 100) <= 100, "a number above its bound"); });
}

}  // namespace semfield::fuzz
