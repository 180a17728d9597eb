#include "app/serve/request_json.h"

#include <algorithm>
#include <set>

#include "core/error.h"
#include "core/text.h"

namespace semfield::app {

namespace {

std::string shown(const Json& value) {
  constexpr std::size_t kMost = 60;
  if (value.is_array()) return "a list of " + std::to_string(value.size());
  if (value.is_object()) return "a map";
  const std::string text = value.dump(-1, ' ', true, Json::error_handler_t::replace);
  return text.size() > kMost ? text.substr(0, kMost) + "..." : text;
}

void check_keys(const Json& map, const std::vector<std::string>& known) {
  for (const auto& item : map.items()) {
    if (std::find(known.begin(), known.end(), item.key()) != known.end()) continue;
    const std::string near = did_you_mean(item.key(), known);
    refuse_request("unknown key " + shown(Json(item.key())),
                   near.empty() ? "known: " + join(known) : "did you mean '" + near + "'?");
  }
}

}  // namespace

void refuse_request(const std::string& message, const std::string& remedy) {
  throw Error(ErrorKind::data, "serve.request.invalid", "request: " + message, remedy);
}

void refuse_request_value(const std::string& key, const std::string& expected, const Json& found) {
  refuse_request("'" + key + "': expected " + expected + ", got " + shown(found));
}

Json parse_request(std::string_view text, const std::vector<std::string>& known) {
  std::vector<std::set<std::string>> keys;
  std::string twice;
  const Json::parser_callback_t watch = [&](int, Json::parse_event_t event, Json& parsed) {
    if (event == Json::parse_event_t::object_start) keys.emplace_back();
    if (event == Json::parse_event_t::object_end && !keys.empty()) keys.pop_back();
    if (event == Json::parse_event_t::key && !keys.empty() && !keys.back().insert(parsed.get<std::string>()).second &&
        twice.empty())
      twice = shown(parsed);
    return true;
  };
  Json root;
  try {
    root = Json::parse(text, watch);
  } catch (const Json::exception& e) {
    refuse_request("not valid JSON: " + json_cause(e.what()));
  }
  if (!root.is_object()) refuse_request("expected a map, got " + shown(root));
  if (!twice.empty()) refuse_request("key " + twice + " is given twice");
  check_keys(root, known);
  return root;
}

void read_request_flag(const Json& root, const char* key, bool& into) {
  const auto found = root.find(key);
  if (found == root.end()) return;
  if (!found->is_boolean()) refuse_request_value(key, "true or false", *found);
  into = found->get<bool>();
}

void read_request_number(const Json& root, const char* key, std::int32_t low, std::int32_t high, std::int32_t& into) {
  const auto found = root.find(key);
  if (found == root.end()) return;
  const bool whole = found->is_number_unsigned() && found->get<std::uint64_t>() <= static_cast<std::uint64_t>(high);
  if (!whole || found->get<std::int32_t>() < low)
    refuse_request_value(key, "a whole number from " + std::to_string(low) + " to " + std::to_string(high), *found);
  into = found->get<std::int32_t>();
}

FreeCamera read_request_camera(const Json& map) {
  if (!map.is_object()) refuse_request_value("camera", "a map", map);
  check_keys(map, {"position", "rotation", "fov_deg"});
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
    refuse_request("'rotation' is not a rotation",
                   "send the rows of world_from_camera: orthonormal columns, right-handed");
  if (const auto fov = map.find("fov_deg"); fov != map.end()) {
    if (fov->is_number()) camera.fov_deg = fov->get<double>();
    if (!fov->is_number() || !(camera.fov_deg >= 1 && camera.fov_deg <= 170))
      refuse_request_value("fov_deg", "degrees from 1 to 170", *fov);
  }
  return camera;
}

}  // namespace semfield::app
