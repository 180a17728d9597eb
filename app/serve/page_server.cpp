#include "app/serve/page_server.h"

#include <algorithm>
#include <chrono>
#include <nlohmann/json.hpp>
#include <thread>

#include "app/serve/page_pictures.h"
#include "app/serve/page_requests.h"
#include "app/serve/page_state.h"
#include "core/error.h"

namespace semfield::app {

namespace {

using Clock = std::chrono::steady_clock;

constexpr auto kStateLook = std::chrono::milliseconds(100);  // at exports, and whether the server ends
constexpr std::uint64_t kMostNumber = std::uint64_t{1} << 53;
constexpr const char* kJpeg = "image/jpeg";
constexpr const char* kForEver = "private, max-age=31536000, immutable";

std::int64_t now_ms() {
  return std::chrono::duration_cast<std::chrono::milliseconds>(std::chrono::system_clock::now().time_since_epoch())
      .count();
}

class Counted {
 public:
  explicit Counted(std::atomic<int>& count) : count_(count) { ++count_; }
  ~Counted() { --count_; }
  Counted(const Counted&) = delete;
  Counted& operator=(const Counted&) = delete;

 private:
  std::atomic<int>& count_;
};

HttpResponse json(std::string text) { return {200, "application/json", std::move(text)}; }

}  // namespace

PageServer::PageServer(PageSource& source, PageOptions options)
    : source_(source), options_(std::move(options)), exports_([&source] { source.save(); }, options_.exports) {
  HttpOptions& http = options_.http;
  http.port = free_port(http.address, http.port, options_.next_port);
  access_ = std::make_unique<PageAccess>(options_.token, http.address, http.port);
  HttpHandler& self = *this;
  http_ = std::make_unique<HttpServer>(http, self);
}

PageServer::~PageServer() {
  stopping_ = true;
  http_.reset();
}

std::optional<HttpResponse> PageServer::refuse(const HttpRequest& head) noexcept {
  try {
    return access_->refuse(head);
  } catch (const std::exception&) {  // no memory
    return HttpResponse{500, "text/plain", ""};
  }
}

HttpResponse PageServer::answer(const HttpRequest& request) noexcept {
  return safe_answer([&] { return route(access_->name_of(request.path), request); });
}

HttpResponse PageServer::route(const std::string& name, const HttpRequest& request) {
  using Get = HttpResponse (PageServer::*)(const HttpRequest&) const;
  static const std::map<std::string, Get> gets{
      {"state", &PageServer::get_state}, {"photo", &PageServer::get_photo}, {"camera", &PageServer::get_camera}};
  using Post = HttpResponse (PageServer::*)(const HttpRequest&);
  static const std::map<std::string, Post> posts{
      {"event", &PageServer::post_event}, {"picture", &PageServer::post_picture}, {"export", &PageServer::post_export}};
  if (const auto post = posts.find(name); post != posts.end())
    return request.method == "POST" ? (this->*(post->second))(request) : wrong_method("POST");
  if (const auto get = gets.find(name); get != gets.end())
    return request.method == "GET" ? (this->*(get->second))(request) : wrong_method("GET");
  const std::string exported = "export/";
  const auto file = options_.files.find(name);
  if (file == options_.files.end() && !name.starts_with(exported))
    return {404, "application/json",
            error_json("serve.address.unknown", "nothing is at this address", "see docs/reference/labelling_http.md")};
  if (request.method != "GET") return wrong_method("GET");
  if (file == options_.files.end()) return exports_.download(name.substr(exported.size()));
  return {200, file->second.type, file->second.bytes};
}

// Exports change beside the session, so the page follows the sum of both counts.
HttpResponse PageServer::get_state(const HttpRequest& request) const {
  std::uint64_t after = query_number(request.query, "after", 0, kMostNumber);
  const auto end = Clock::now() + std::chrono::milliseconds(options_.longest_poll_ms);
  const std::uint64_t first = options_.first_revision;
  const bool ours = after >= first && after - first <= source_.state()->revision + exports_.changes();
  after = ours ? after - first : 0;  // else: of an earlier life of the server
  const Counted waits(waiting_for_news_);
  for (;;) {
    const std::uint64_t exported = exports_.changes();
    const std::uint64_t known = after > exported ? after - exported : 0;
    const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(end - Clock::now());
    // Those that wait leave half of the threads to the others.
    const bool at_once = stopping_ || 2 * waiting_for_news_ > options_.http.threads;
    if (at_once) std::this_thread::sleep_for(kStateLook);  // a page that asks again and again stays calm
    const bool last = left.count() <= 0 || at_once || after == 0 || request.abandoned();
    const auto state = last ? source_.state() : source_.wait_state(known, std::min(kStateLook, left));
    if (last || state->revision + exported > after)
      return json(state_json(*state, source_, exports_.list(), options_.run_id, known,
                             {first, first + state->revision + exported}));
  }
}

void PageServer::check_view(std::uint64_t view) const {
  const std::size_t views = source_.state()->views.size();
  if (view >= views)
    throw Error(ErrorKind::data, "serve.view.unknown",
                "view " + std::to_string(view) + ": the scene has " + std::to_string(views) + " views",
                "count from 0; the views are listed in the state");
}

int PageServer::view_of(const HttpRequest& request) const {
  const std::uint64_t view = query_number(request.query, "view", kMostNumber, kMostNumber);
  if (view == kMostNumber)
    throw Error(ErrorKind::data, "serve.request.invalid", "request: 'view' is missing", "ask for ?view=0");
  check_view(view);
  return static_cast<int>(view);
}

HttpResponse PageServer::get_photo(const HttpRequest& request) const {
  const auto most = static_cast<std::int32_t>(query_number(request.query, "most_px", 0, kMostPhotoSide));
  const int view = view_of(request);
  const std::vector<std::uint8_t> jpeg = photo_jpeg(source_.photo(view, most), most);
  HttpResponse response{200, kJpeg, std::string(jpeg.begin(), jpeg.end())};
  // The run may be opened again with another image in the view's place, which then has another address.
  if (query_value(request.query, "photo") == source_.state()->views[static_cast<std::size_t>(view)].photo)
    response.cache = kForEver;
  return response;
}

HttpResponse PageServer::get_camera(const HttpRequest& request) const {
  return json(camera_json(source_.camera_of(view_of(request))));
}

HttpResponse PageServer::post_event(const HttpRequest& request) {
  LabelEvent event = parse_label_event(request.body);
  event.unix_ms = now_ms();
  const bool applied = source_.apply(event);
  const std::uint64_t revision = options_.first_revision + source_.state()->revision + exports_.changes();
  return json(nlohmann::ordered_json{{"applied", applied}, {"revision", revision}}.dump());
}

HttpResponse PageServer::post_picture(const HttpRequest& request) {
  const PictureRequest wanted = parse_picture_request(request.body);
  if (!wanted.camera) check_view(static_cast<std::uint64_t>(wanted.view));
  Picture picture = source_.picture(wanted, [&] { return request.abandoned(); });
  picture.overlay_revision += options_.first_revision;
  return {200, "application/octet-stream", picture_bytes(picture, source_.state()->classes, wanted.at.has_value())};
}

HttpResponse PageServer::post_export(const HttpRequest& request) {
  const ExportRequest wanted = parse_export_request(request.body);
  if (!wanted.what) {
    if (!exports_.cancel(wanted.cancel))
      throw Error(ErrorKind::data, "serve.export.unknown", "no export '" + wanted.cancel + "'",
                  "the state lists those that exist");
    return json(nlohmann::ordered_json{{"id", wanted.cancel}}.dump());
  }
  return json(nlohmann::ordered_json{{"id", exports_.start(*wanted.what)}}.dump());
}

}  // namespace semfield::app
