#include "app/serve/page_server.h"

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <memory>
#include <thread>

#include "app/serve/page_pictures.h"
#include "app/serve/page_requests.h"
#include "app/serve/page_state.h"
#include "core/error.h"

namespace semfield::app {

std::int64_t now_ms() {
  return std::chrono::duration_cast<std::chrono::milliseconds>(std::chrono::system_clock::now().time_since_epoch())
      .count();
}

namespace {

using Clock = std::chrono::steady_clock;

constexpr auto kStateLook = std::chrono::milliseconds(100);  // at exports, and whether the server ends
constexpr std::uint64_t kMostNumber = std::uint64_t{1} << 53;
constexpr const char* kJpeg = "image/jpeg";
constexpr const char* kForEver = "private, max-age=31536000, immutable";

}  // namespace

PageServer::PageServer(LabelSource& source, PageOptions options)
    : source_(source),
      options_(std::move(options)),
      exports_([&source] { source.save(); }, options_.exports),
      host_(options_.token, options_.http, options_.next_port, "docs/reference/labelling_http.md", places()) {}

PageHost::Places PageServer::places() {
  constexpr std::string_view kExports = "/export/";
  PageHost::Places places{
      {"state", {"GET", [this](const HttpRequest& r) { return get_state(r); }}},
      {"photo", {"GET", [this](const HttpRequest& r) { return get_photo(r); }}},
      {"event", {"POST", [this](const HttpRequest& r) { return post_event(r); }}},
      {"picture", {"POST", [this](const HttpRequest& r) { return post_picture(r); }}},
      {"export", {"POST", [this](const HttpRequest& r) { return post_export(r); }}},
      {"export/", {"GET", [this, kExports](const HttpRequest& r) {
                     return exports_.download(r.path.substr(r.path.find(kExports) + kExports.size()));
                   }}}};
  for (const auto& [name, file] : options_.files)
    places[name] = {"GET", [&file](const HttpRequest&) { return HttpResponse{200, file.type, file.bytes}; }};
  return places;
}

// Exports change beside the session, so the page follows the sum of both counts.
HttpResponse PageServer::get_state(const HttpRequest& request) const {
  std::uint64_t after = query_number(request.query, "after", 0, kMostNumber);
  const auto end = Clock::now() + std::chrono::milliseconds(options_.longest_poll_ms);
  const std::uint64_t first = options_.first_revision;
  const bool ours = after >= first && after - first <= source_.state()->revision + exports_.changes();
  after = ours ? after - first : 0;  // else: of an earlier life of the server
  ++waiting_for_news_;
  const std::unique_ptr<std::atomic<int>, void (*)(std::atomic<int>*)> waits(
      &waiting_for_news_, [](std::atomic<int>* waiting) { --*waiting; });
  for (;;) {
    const std::uint64_t exported = exports_.changes();
    const std::uint64_t known = after > exported ? after - exported : 0;
    const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(end - Clock::now());
    // Those that wait leave half of the responses to the others.
    const bool at_once = stopping_ || 2 * waiting_for_news_ > options_.http.responses;
    if (at_once) std::this_thread::sleep_for(kStateLook);  // a page that asks again and again stays calm
    const bool last = left.count() <= 0 || at_once || after == 0 || request.abandoned();
    const auto state = last ? source_.state() : source_.wait_state(known, std::min(kStateLook, left));
    if (last || state->revision + exported > after)
      return json_answer(state_json(*state, source_, exports_.list(), options_.run_id, known, first,
                                    first + state->revision + exported));
  }
}

void PageServer::check_view(std::uint64_t view) const {
  const std::size_t views = source_.state()->views.size();
  if (view >= views)
    throw Error(ErrorKind::data, "serve.view.unknown",
                "view " + std::to_string(view) + ": the scene has " + std::to_string(views) + " views",
                "count from 0; the views are listed in the state");
}

HttpResponse PageServer::get_photo(const HttpRequest& request) const {
  const auto most = static_cast<std::int32_t>(query_number(request.query, "most_px", 0, kMostPhotoSide));
  const std::uint64_t number = query_number(request.query, "view", kMostNumber, kMostNumber);
  if (number == kMostNumber)
    throw Error(ErrorKind::data, "serve.request.invalid", "request: 'view' is missing", "ask for ?view=0");
  check_view(number);
  const auto view = static_cast<int>(number);
  const std::vector<std::uint8_t> jpeg = photo_jpeg(source_.photo(view, most), most);
  HttpResponse response{200, kJpeg, std::string(jpeg.begin(), jpeg.end())};
  // The run may be opened again with another image in the view's place, which then has another address.
  if (query_value(request.query, "photo") == source_.state()->views[static_cast<std::size_t>(view)].photo)
    response.cache = kForEver;
  return response;
}

HttpResponse PageServer::post_event(const HttpRequest& request) {
  LabelEvent event = parse_label_event(request.body);
  event.unix_ms = now_ms();
  const bool applied = source_.apply(event);
  const std::uint64_t revision = options_.first_revision + source_.state()->revision + exports_.changes();
  return json_answer({{"applied", applied}, {"revision", revision}});
}

HttpResponse PageServer::post_picture(const HttpRequest& request) {
  const PictureRequest wanted = parse_picture_request(request.body);
  check_view(static_cast<std::uint64_t>(wanted.view));
  Picture picture = source_.picture(wanted, [&] { return request.abandoned(); });
  picture.overlay_revision += options_.first_revision;
  return {200, "application/octet-stream", picture_bytes(picture, source_.state()->classes)};
}

HttpResponse PageServer::post_export(const HttpRequest& request) {
  const ExportRequest wanted = parse_export_request(request.body);
  if (!wanted.what) {
    if (!exports_.cancel(wanted.cancel))
      throw Error(ErrorKind::data, "serve.export.unknown", "no export '" + wanted.cancel + "'",
                  "the state lists those that exist");
    return json_answer({{"id", wanted.cancel}});
  }
  return json_answer({{"id", exports_.start(*wanted.what)}});
}

}  // namespace semfield::app
