// What the labelling page's server is sent: requests for pictures and exports, and queries.
#include <algorithm>
#include <cmath>
#include <string>

#include "app/serve/http_reader.h"
#include "app/serve/page_requests.h"
#include "tests/fuzz/inputs.h"
#include "tests/fuzz/targets.h"

namespace semfield::fuzz {

// As the body of every kind of request, and as a query.
void fuzz_page(std::string_view bytes) {
  accepted([&] {
    const PictureRequest r = app::parse_picture_request(bytes);
    promise((r.view >= 0) != r.camera.has_value(), "a picture of a view and of a camera");
    promise(r.at.has_value() != (r.color || r.labels || r.entropy), "neither a map nor a point, or both");
    promise(!r.at || (r.camera && r.at->x >= 0 && r.at->x <= 1 && r.at->y >= 0 && r.at->y <= 1), "a point outside");
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

// As what a connection brings: the same requests come out, however the bytes are cut.
void fuzz_http(std::string_view bytes) {
  constexpr std::size_t kMostBody = 64;
  const auto requests = [&](std::size_t piece) {
    app::HttpReader reader(kMostBody);
    std::string told;
    for (std::size_t at = 0; at < bytes.size(); at += piece) {
      reader.take(bytes.substr(at, piece));
      for (; reader.state() == app::HttpReader::State::whole; reader.next()) {
        const app::HttpRequest& r = reader.request();
        promise(r.body.size() <= kMostBody, "a body above its bound");
        promise(r.header_count("content-length") + r.header_count("transfer-encoding") <= 1, "a body of two lengths");
        told += r.method + ' ' + r.path + '?' + r.query + ' ' + (reader.keeps() ? "keeps" : "ends");
        for (const auto& [name, value] : r.headers) told += '\n' + name + ": " + value;
        told += "\n\n" + r.body + '\n';
      }
      if (reader.state() != app::HttpReader::State::refused) continue;
      promise(reader.status() == 400 || reader.status() == 413, "a refusal without a status");
      return told + "refused: " + reader.complaint();
    }
    return told;
  };
  const std::string whole = requests(std::max<std::size_t>(bytes.size(), 1));
  for (const std::size_t piece : {1, 3, 17})
    promise(requests(piece) == whole, "a request that depends on how it is cut");
}

}  // namespace semfield::fuzz
