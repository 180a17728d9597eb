#include "app/serve/page_requests.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <nlohmann/json.hpp>
#include <set>
#include <string>

#include "core/error.h"
#include "core/text.h"
#include "labels/clicks/click_log.h"

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
    refuse_request("unknown key " + shown(Json(item.key())),
                   near_name_remedy(item.key(), known, "known: " + join(known)));
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

const Json& request_value(const Json& map, const char* key) {
  const auto found = map.find(key);
  if (found == map.end()) refuse_request(std::string("key '") + key + "' is missing");
  return *found;
}

std::int32_t request_number(const Json& root, const char* key, std::int32_t low, std::int32_t high,
                            std::optional<std::int32_t> otherwise) {
  if (otherwise && !root.contains(key)) return *otherwise;
  const Json& found = request_value(root, key);
  const bool whole = found.is_number_unsigned() && found.get<std::uint64_t>() <= static_cast<std::uint64_t>(high);
  if (!whole || found.get<std::int32_t>() < low)
    refuse_request_value(key, "a whole number from " + std::to_string(low) + " to " + std::to_string(high), found);
  return found.get<std::int32_t>();
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

PictureRequest parse_picture_request(std::string_view json) {
  const Json root =
      parse_request(json, {"client", "view", "camera", "at", "most_px", "color", "labels", "entropy", "full"});
  PictureRequest request;
  const Json& client = request_value(root, "client");
  const std::string* name = client.get_ptr<const std::string*>();
  if (name == nullptr || !is_event_id(*name))
    refuse_request_value("client", "1 to 64 letters of a-z, A-Z, 0-9, '-' and '_'", client);
  request.client = *name;
  if (root.contains("camera")) request.camera = read_request_camera(root["camera"]);
  request.view = request_number(root, "view", 0, 1 << 24, -1);
  if ((request.view >= 0) == request.camera.has_value()) refuse_request("expected either 'view' or 'camera'");
  if (root.contains("at")) {
    if (!request.camera) refuse_request("'at' is a point of a camera's picture, and there is no 'camera'");
    const auto at = request_numbers<2>(root, "at", 1);
    if (!(at[0] >= 0 && at[1] >= 0)) refuse_request_value("at", "shares of width and height from 0 to 1", root["at"]);
    request.at = PixelPoint{at[0], at[1]};
    request.labels = false;
    for (const char* map : {"color", "labels", "entropy", "full"})
      if (root.contains(map))
        refuse_request(std::string("'") + map + "' and 'at': a question about a point gets no picture");
    return request;
  }
  request.most_px = request_number(root, "most_px", 16, kMostPictureSide, 0);
  read_request_flag(root, "color", request.color);
  read_request_flag(root, "labels", request.labels);
  read_request_flag(root, "entropy", request.entropy);
  read_request_flag(root, "full", request.full);
  if (!request.color && !request.labels && !request.entropy)
    refuse_request("no map is asked for", "set one of 'color', 'labels' and 'entropy' to true");
  return request;
}

ExportRequest parse_export_request(std::string_view json) {
  const Json root = parse_request(json, {"what", "cancel"});
  const auto what = root.find("what"), cancel = root.find("cancel");
  if ((what == root.end()) == (cancel == root.end())) refuse_request("expected either 'what' or 'cancel'");
  if (cancel != root.end()) {
    const std::string* id = cancel->get_ptr<const std::string*>();
    if (id == nullptr || !is_event_id(*id)) refuse_request_value("cancel", "the id of an export", *cancel);
    return {std::nullopt, *id};
  }
  for (const ExportKind kind : {ExportKind::labels, ExportKind::coco, ExportKind::mesh}) {
    if (*what == export_name(kind)) return {kind, ""};
  }
  refuse_request_value("what", "labels, coco or mesh", *what);
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
  std::uint64_t value = 0;
  const auto [end, cause] = std::from_chars(digits->data(), digits->data() + digits->size(), value);
  if (cause != std::errc() || end != digits->data() + digits->size() || value > most)
    refuse_request("'" + std::string(key) + "': expected a whole number from 0 to " + std::to_string(most));
  return value;
}

namespace {

int status_of(ErrorKind kind) {
  if (kind == ErrorKind::data || kind == ErrorKind::usage) return 400;
  return kind == ErrorKind::internal ? 500 : 503;
}

}  // namespace

std::string camera_json(const FreeCamera& camera) {
  const Pose& pose = camera.world_from_camera;
  Json rotation = Json::array();
  for (const auto& row : pose.r)
    for (const double value : row) rotation.push_back(value);
  return json_text({{"position", {pose.t.x, pose.t.y, pose.t.z}}, {"rotation", rotation}, {"fov_deg", camera.fov_deg}});
}

std::string error_json(Code code, const std::string& message, const std::string& remedy) {
  return json_text({{"error", message}, {"code", code.text()}, {"remedy", remedy}});
}

HttpResponse json_answer(const Json& json) { return {200, "application/json", json_text(json)}; }

HttpResponse safe_answer(const std::function<HttpResponse()>& answer) noexcept {
  try {
    try {
      return answer();
    } catch (const Error& e) {
      return {status_of(e.kind()), "application/json", error_json(e.code(), e.message(), e.remedy())};
    } catch (const std::exception& e) {
      return {500, "application/json",
              error_json("internal.exception", std::string("internal error: ") + e.what(), "")};
    }
  } catch (const std::exception&) {  // no memory
    return {500, "text/plain", ""};
  }
}

HttpResponse wrong_method(const char* allowed) {
  HttpResponse wrong{405, "application/json",
                     error_json("serve.request.method", "this address takes another method", "")};
  wrong.allow = allowed;
  return wrong;
}

}  // namespace semfield::app
