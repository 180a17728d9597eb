#include "app/serve/page_requests.h"

#include <algorithm>
#include <numbers>

#include "labels/clicks.h"

namespace semfield::app {

Error request_error(const std::string& message, const std::string& remedy) {
  return {ErrorKind::data, "serve.request.invalid", "request: " + message, remedy};
}

Json parse_request(std::string_view text, const std::vector<std::string>& known) {
  Json root = kRequest.map(text);
  kRequest.check_keys(root, known);
  return root;
}

std::int32_t request_number(const Json& root, const char* key, std::int32_t low, std::int32_t high,
                            std::optional<std::int32_t> otherwise) {
  if (otherwise && !root.contains(key)) return *otherwise;
  const std::string expected = "a whole number from " + std::to_string(low) + " to " + std::to_string(high);
  return static_cast<std::int32_t>(kRequest.whole(kRequest.at(root, key), key, low, high, expected));
}

RayCamera FreeCamera::rays(std::int32_t width_px, std::int32_t height_px) const {
  RayCamera rays;
  rays.undistort = false;
  rays.world_from_camera = world_from_camera;
  Camera& camera = rays.camera;
  camera.width_px = width_px;
  camera.height_px = height_px;
  camera.fx = camera.fy = width_px / (2 * std::tan(fov_deg / 360 * std::numbers::pi));
  camera.cx = width_px / 2.0;
  camera.cy = height_px / 2.0;
  return rays;
}

FreeCamera read_request_camera(const Json& map) {
  if (!map.is_object()) kRequest.refuse_value("camera", "a map", map);
  kRequest.check_keys(map, {"position", "rotation", "fov_deg"});
  FreeCamera camera;
  const auto position = request_numbers<3>(map, "position", 1e6);
  const auto rotation = request_numbers<9>(map, "rotation", 1.01);
  camera.world_from_camera.t = {position[0], position[1], position[2]};
  auto& r = camera.world_from_camera.r;
  for (std::size_t i = 0; i < 9; ++i) r[i / 3][i % 3] = rotation[i];
  double off = 0;
  for (int a = 0; a < 3; ++a)
    for (int b = 0; b < 3; ++b)
      off = std::max(off, std::abs(dot(camera.world_from_camera.axis(a), camera.world_from_camera.axis(b)) - (a == b)));
  const Pose& pose = camera.world_from_camera;
  if (!(off <= 1e-3) || !(dot(cross(pose.axis(0), pose.axis(1)), pose.axis(2)) > 0))
    kRequest.refuse("'rotation' is not a rotation",
                    "send the rows of world_from_camera: orthonormal columns, right-handed");
  if (const auto fov = map.find("fov_deg"); fov != map.end()) {
    if (fov->is_number()) camera.fov_deg = fov->get<double>();
    if (!fov->is_number() || !(camera.fov_deg >= 1 && camera.fov_deg <= 170))
      kRequest.refuse_value("fov_deg", "degrees from 1 to 170", *fov);
  }
  return camera;
}

namespace {

constexpr std::size_t kMostPlaces = 4096;  // of each kind
constexpr std::int32_t kMostLevel = 1000;

PictureRequest of_a_client(const Json& root) {
  PictureRequest request;
  const Json& client = kRequest.at(root, "client");
  const std::string* name = client.get_ptr<const std::string*>();
  if (name == nullptr || !is_event_id(*name))
    kRequest.refuse_value("client", "1 to 64 letters of a-z, A-Z, 0-9, '-' and '_'", client);
  request.client = *name;
  request.view = request_number(root, "view", 0, 1 << 24);
  return request;
}

std::vector<PixelPoint> request_places(const Json& root, const char* key) {
  const std::string expected = "at most " + std::to_string(kMostPlaces) + " points [x, y] in pixels of the view";
  const Json& list = kRequest.at(root, key);
  if (!list.is_array() || list.size() > kMostPlaces) kRequest.refuse_value(key, expected, list);
  std::vector<PixelPoint> points;
  for (const Json& point : list) {
    const bool is_point = point.is_array() && point.size() == 2 && point[0].is_number() && point[1].is_number();
    if (is_point) points.push_back({point[0].get<double>(), point[1].get<double>()});
    if (!is_point || !(std::abs(points.back().x) <= kMaxCoordinate) || !(std::abs(points.back().y) <= kMaxCoordinate))
      kRequest.refuse_value(key, expected, point);
  }
  return points;
}

}  // namespace

PictureRequest parse_thing_request(std::string_view json) {
  const Json root = parse_request(json, {"client", "view", "also", "not", "level"});
  PictureRequest request = of_a_client(root);
  ThingRequest thing;
  thing.also = request_places(root, "also");
  if (root.contains("not")) thing.without = request_places(root, "not");
  thing.level = request_number(root, "level", -kMostLevel, kMostLevel, 0);
  if (thing.also.empty())
    kRequest.refuse("'also' names no place", "send the place of the thing: \"also\": [[12.5, 33]]");
  request.thing = std::move(thing);
  return request;
}

PictureRequest parse_picture_request(std::string_view json) {
  const Json root = parse_request(json, {"client", "view", "color", "labels", "entropy", "full"});
  PictureRequest request = of_a_client(root);
  kRequest.flag(root, "color", request.color);
  kRequest.flag(root, "labels", request.labels);
  kRequest.flag(root, "entropy", request.entropy);
  kRequest.flag(root, "full", request.full);
  if (!request.color && !request.labels && !request.entropy)
    kRequest.refuse("no map is asked for", "set one of 'color', 'labels' and 'entropy' to true");
  return request;
}

std::optional<std::string_view> query_value(std::string_view query, std::string_view key) {
  while (!query.empty()) {
    const std::string_view part = query.substr(0, query.find('&'));
    query.remove_prefix(std::min(query.size(), part.size() + 1));
    const std::size_t equals = part.find('=');
    if (part.substr(0, equals) == key) return equals == std::string_view::npos ? "" : part.substr(equals + 1);
  }
  return std::nullopt;
}

std::uint64_t query_number(std::string_view query, std::string_view key, std::uint64_t otherwise, std::uint64_t most) {
  const std::optional<std::string_view> digits = query_value(query, key);
  if (!digits) return otherwise;
  const auto value = to_number<std::uint64_t>(*digits);
  if (!value || *value > most)
    kRequest.refuse("'" + std::string(key) + "': expected a whole number from 0 to " + std::to_string(most));
  return *value;
}

}  // namespace semfield::app
