#include "app/serve/page_requests.h"

#include <charconv>

#include "app/serve/request_json.h"
#include "labels/clicks/click_log.h"

namespace semfield::app {

PictureRequest parse_picture_request(std::string_view json) {
  const Json root =
      parse_request(json, {"client", "view", "camera", "at", "most_px", "color", "labels", "entropy", "full"});
  PictureRequest request;
  const auto client = root.find("client");
  if (client == root.end()) refuse_request("key 'client' is missing");
  const std::string* name = client->get_ptr<const std::string*>();
  if (name == nullptr || !is_event_id(*name))
    refuse_request_value("client", "1 to 64 letters of a-z, A-Z, 0-9, '-' and '_'", *client);
  request.client = *name;
  const auto camera = root.find("camera");
  if (camera != root.end()) request.camera = read_request_camera(*camera);
  read_request_number(root, "view", 0, 1 << 24, request.view);
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
  read_request_number(root, "most_px", 16, kMostPictureSide, request.most_px);
  read_request_flag(root, "color", request.color);
  read_request_flag(root, "labels", request.labels);
  read_request_flag(root, "entropy", request.entropy);
  read_request_flag(root, "full", request.full);
  if (!request.color && !request.labels && !request.entropy)
    refuse_request("no map is asked for", "set one of 'color', 'labels' and 'entropy' to true");
  return request;
}

const char* export_name(ExportKind kind) {
  return kind == ExportKind::labels ? "labels"
         : kind == ExportKind::coco ? "coco"
         : kind == ExportKind::mesh ? "mesh"
                                    : "film";
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

}  // namespace semfield::app
