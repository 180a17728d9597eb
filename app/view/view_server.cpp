#include "app/view/view_server.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <numbers>
#include <sstream>

#include "app/serve/page_requests.h"
#include "core/error.h"
#include "scene/camera.h"

namespace semfield::app {

namespace {

constexpr std::size_t kMostFilmFrames = 20'000;
constexpr std::int32_t kMostFilmSide = 4096;

HttpResponse json_text_answer(std::string text) { return {200, "application/json", std::move(text)}; }
HttpResponse bytes(std::string data) { return {200, "application/octet-stream", std::move(data)}; }

std::int32_t number_in(const Json& root, const char* key, std::int32_t low, std::int32_t high) {
  if (!root.contains(key)) refuse_request(std::string("key '") + key + "' is missing");
  std::int32_t value = 0;
  read_request_number(root, key, low, high, value);
  return value;
}

double real_in(const Json& root, const char* key, double low, double high) {
  const auto found = root.find(key);
  if (found == root.end() || !found->is_number() || !(found->get<double>() >= low && found->get<double>() <= high))
    refuse_request(fmt::format("'{}': expected a number from {:g} to {:g}", key, low, high));
  return found->get<double>();
}

std::string word_in(const Json& root, const char* key) {
  const auto found = root.find(key);
  if (found == root.end() || !found->is_string()) refuse_request(std::string("'") + key + "': expected a word");
  return found->get<std::string>();
}

// Lines of 12 numbers, rows of world_from_camera.
CameraSet film_cameras(const std::string& lines, std::int32_t width, std::int32_t height, double fov_deg) {
  CameraSet set;
  std::istringstream in(lines);
  for (std::string line; std::getline(in, line);) {
    std::istringstream words(line);
    PlacedCamera placed{fmt::format("{:05}", set.cameras.size()), {}, {}};
    placed.camera.width_px = width;
    placed.camera.height_px = height;
    placed.camera.fx = placed.camera.fy = width / (2 * std::tan(fov_deg / 360 * std::numbers::pi));
    placed.camera.cx = width / 2.0;
    placed.camera.cy = height / 2.0;
    for (int k = 0; k < 12; ++k) {
      double value = 0;
      if (!(words >> value) || !std::isfinite(value))
        refuse_request(fmt::format("'path': line {} has not 12 numbers", set.cameras.size() + 1));
      const int row = k / 4, column = k % 4;
      if (column == 3) {
        placed.world_from_camera.t[row] = value;
      } else {
        placed.world_from_camera.r[static_cast<std::size_t>(row)][static_cast<std::size_t>(column)] = value;
      }
    }
    if (set.cameras.size() >= kMostFilmFrames)
      refuse_request(fmt::format("'path': more than {} lines", kMostFilmFrames));
    set.cameras.push_back(std::move(placed));
  }
  if (set.cameras.size() < 2) refuse_request("'path': fewer than two lines");
  return set;
}

}  // namespace

ViewServer::ViewServer(std::vector<ViewedRun*> runs, ViewOptions options)
    : PageHost(nullptr, options.films, "film/", "docs/guide/viewing.md"), runs_(std::move(runs)) {
  options.http.most_body_bytes = std::size_t{8} << 20;  // a path of the camera
  HttpResponse page{200, "text/html; charset=utf-8", std::move(options.page)};
  page.own_code = true;
  open(new_token(), options.http, options.next_port,
       {{"", {"GET", [page](const HttpRequest&) { return page; }}},
        {"surface", {"GET", [this](const HttpRequest& r) { return get_surface(r); }}},
        {"probability", {"GET", [this](const HttpRequest& r) { return get_probability(r); }}},
        {"state", {"GET", [this](const HttpRequest&) { return get_state(); }}},
        {"picture", {"POST", [this](const HttpRequest& r) { return post_picture(r); }}},
        {"point", {"POST", [this](const HttpRequest& r) { return post_point(r); }}},
        {"edit", {"POST", [this](const HttpRequest& r) { return post_edit(r); }}},
        {"film", {"POST", [this](const HttpRequest& r) { return post_film(r); }}}});
}

ViewedRun& ViewServer::run(std::uint64_t number) const {
  if (number >= runs_.size()) refuse_request(fmt::format("run {} is not there", number), "count from 0");
  return *runs_[number];
}

HttpResponse ViewServer::get_surface(const HttpRequest& request) const {
  return bytes(run(query_number(request.query, "run", 0, 1)).scene(query_number(request.query, "fine", 0, 1) == 1));
}

HttpResponse ViewServer::get_probability(const HttpRequest& request) const {
  return bytes(run(query_number(request.query, "run", 0, 1))
                   .probability(static_cast<int>(query_number(request.query, "class", 0, 65535)),
                                query_number(request.query, "fine", 0, 1) == 1));
}

HttpResponse ViewServer::get_state() const {
  Json runs = Json::array(), films = Json::array();
  for (const ViewedRun* one : runs_)
    runs.push_back({{"name", one->name()}, {"step", one->step()}, {"newest", one->newest_step()}});
  for (const ExportState& film : exports_.list())
    films.push_back({{"id", film.id}, {"state", film.state}, {"text", film.text}, {"files", film.files}});
  return json_answer({{"runs", runs}, {"films", films}});
}

HttpResponse ViewServer::post_picture(const HttpRequest& request) const {
  const Json root = parse_request(request.body, {"run", "camera", "width", "height", "map", "class", "near", "far"});
  ViewPicture wanted;
  if (!root.contains("camera")) refuse_request("key 'camera' is missing");
  wanted.camera = read_request_camera(root["camera"]);
  wanted.width_px = number_in(root, "width", 1, kMostPictureSide);
  wanted.height_px = number_in(root, "height", 1, kMostPictureSide);
  wanted.map = word_in(root, "map");
  const std::vector<std::string> maps{"photo", "class", "object", "entropy", "depth", "probability"};
  if (std::find(maps.begin(), maps.end(), wanted.map) == maps.end())
    refuse_request_value("map", "photo, class, object, entropy, depth or probability", root["map"]);
  read_request_number(root, "class", 0, 65535, wanted.class_index);
  if (wanted.map == "depth") {
    wanted.near_m = real_in(root, "near", 0, 1e9);
    wanted.far_m = real_in(root, "far", 0, 1e9);
  }
  const std::vector<std::uint8_t> jpeg =
      run(static_cast<std::uint64_t>(number_in(root, "run", 0, 1))).picture(wanted, [&] {
        return request.abandoned();
      });
  return {200, "image/jpeg", std::string(jpeg.begin(), jpeg.end())};
}

HttpResponse ViewServer::post_point(const HttpRequest& request) const {
  const Json root = parse_request(request.body, {"run", "at"});
  const std::array<double, 3> at = request_numbers<3>(root, "at", 1e9);
  return json_text_answer(run(static_cast<std::uint64_t>(number_in(root, "run", 0, 1))).point({at[0], at[1], at[2]}));
}

HttpResponse ViewServer::post_edit(const HttpRequest& request) const {
  Json root = parse_request(request.body, {"do", "object", "objects", "name", "at", "plane", "fine", "made_on"});
  bool fine = false;
  read_request_flag(root, "fine", fine);
  const std::string made_on = word_in(root, "made_on");
  root.erase("fine");
  root.erase("made_on");
  if (word_in(root, "do") == "undo") return json_text_answer(run(0).edit(std::nullopt, made_on, fine));
  return json_text_answer(run(0).edit(parse_object_edit(root.dump(), "request"), made_on, fine));
}

HttpResponse ViewServer::post_film(const HttpRequest& request) {
  const Json root = parse_request(request.body, {"path", "width", "height", "fov_deg"});
  const CameraSet cameras =
      film_cameras(word_in(root, "path"), number_in(root, "width", 16, kMostFilmSide),
                   number_in(root, "height", 16, kMostFilmSide), real_in(root, "fov_deg", 1, 170));
  const auto write = [&](const std::string& folder) { write_cameras(folder + "/path.json", cameras); };
  return json_answer({{"id", exports_.start(ExportKind::film, write)}});
}

}  // namespace semfield::app
