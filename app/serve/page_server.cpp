#include "app/serve/page_server.h"

#include <arpa/inet.h>
#include <fcntl.h>
#include <fmt/format.h>
#include <sys/random.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cmath>
#include <memory>
#include <thread>

#include "app/serve/page_pictures.h"
#include "app/serve/page_requests.h"
#include "core/error.h"
#include "core/files.h"
#include "core/text.h"

namespace semfield::app {

std::int64_t now_ms() {
  return std::chrono::duration_cast<std::chrono::milliseconds>(std::chrono::system_clock::now().time_since_epoch())
      .count();
}

namespace {

using Clock = std::chrono::steady_clock;

constexpr auto kStateLook = std::chrono::milliseconds(100);  // at exports, and whether the server ends
constexpr std::uint64_t kMostNumber = std::uint64_t{1} << 53;
constexpr const char* kForEver = "private, max-age=31536000, immutable";
constexpr const char* kEveryAddress = "0.0.0.0";

// Shares change a little all the time; what nobody sees of that is no news.
double rounded(double share) { return std::round(1e3 * share) / 1e3; }

Json run_json(const LabelState& s, const std::string& id) {
  return {{"id", id},
          {"name", s.name},
          {"folder", s.run_dir},
          {"device", s.device},
          {"step", s.step},
          {"train_s", s.train_s},
          {"loss", s.loss},
          {"psnr", s.psnr_db},
          {"rays_per_s", s.rays_per_s},
          {"phase", s.phase},
          {"geometry_ready", s.geometry_ready},
          {"unreached", rounded(s.unreached)},
          {"temperature", s.temperature}};
}

Json class_json(const ClassState& c) {
  return {{"index", c.index},
          {"id", c.id},
          {"name", c.name},
          {"own", c.own},
          {"color", c.color},
          {"clicks", c.clicks},
          {"area_share", rounded(c.area_share)},
          {"confidence", rounded(c.confidence)}};
}

Json view_json(const ViewState& v) {
  return {{"frame", v.frame},   {"width", v.width_px},           {"height", v.height_px},
          {"clicks", v.clicks}, {"entropy", rounded(v.entropy)}, {"ready", v.ready},
          {"photo", v.photo},   {"held_out", v.held_out}};
}

template <class Items, class ToJson>
Json list(const Items& items, ToJson&& to_json) {
  Json out = Json::array();
  for (const auto& item : items) out.push_back(to_json(item));
  return out;
}

Json mark_json(const Annotations::Mark& mark, const LabelSource& source) {
  return {{"id", mark.id},
          {"view", source.view_of(mark.frame)},
          {"points", points_json(mark.points)},
          {"radius", mark.radius_px},
          {"fill", mark.fill},
          {"object", mark.object},
          {"class", mark.class_index}};
}

Json proposal_json(const std::optional<ProposalState>& p) {
  if (!p) return nullptr;
  return {
      {"id", p->id}, {"view", p->view}, {"at", {p->at.x, p->at.y}}, {"why", p->why}, {"class_guess", p->class_guess}};
}

// All of it but the revision. `first`: PageOptions::first_revision.
Json state_json(const LabelState& s, const LabelSource& source, const std::vector<ExportState>& exports,
                const std::string& run_id, std::uint64_t first) {
  Json out;
  out["overlay"] = {{"revision", first + s.overlay_revision}, {"events", s.overlay_events}};
  out["events"] = s.events;
  out["run"] = run_json(s, run_id);
  out["room"] = {{"named", s.named}, {"most", s.room}};
  out["classes"] = list(s.classes, class_json);
  out["views"] = list(s.views, view_json);
  out["proposal"] = proposal_json(s.proposal);
  out["marks"] = list(s.marks, [&](const Annotations::Mark& mark) { return mark_json(mark, source); });
  out["exports"] = list(exports, [](const ExportState& e) {
    return Json{{"id", e.id}, {"what", e.what}, {"state", e.state}, {"text", e.text}, {"files", e.files}};
  });
  out["notes"] = s.notes;
  out["trouble"] = s.trouble;
  out["failure"] = s.failure;
  return out;
}

HttpResponse forbidden(const std::string& why) { return {403, "text/plain", why + "\n"}; }

bool is_ipv4(const std::string& text) {
  in_addr number{};
  return inet_pton(AF_INET, text.c_str(), &number) == 1;
}

int status_of(ErrorKind kind) {
  if (kind == ErrorKind::data || kind == ErrorKind::usage) return 400;
  return kind == ErrorKind::internal ? 500 : 503;
}

}  // namespace

void StateNews::take(Json all, std::uint64_t revision) {
  if (revision <= revision_) return;
  const auto stamp = [&](Stamps& stamps, const Json& before, const Json& now) {
    for (const auto& [key, value] : now.items())
      if (const auto old = before.find(key); old == before.end() || *old != value) stamps[key] = revision;
  };
  stamp(sections_, all_, all);
  const Json views = all_.value("views", Json::array()), marks = all_.value("marks", Json::array());
  const Json &new_views = all["views"], &new_marks = all["marks"];
  views_.resize(new_views.size());
  for (std::size_t v = 0; v < views_.size(); ++v)
    stamp(views_[v], v < views.size() ? views[v] : Json::object(), new_views[v]);
  const auto differ = std::mismatch(marks.begin(), marks.end(), new_marks.begin(), new_marks.end());
  if (const auto kept = static_cast<std::size_t>(differ.first - marks.begin()); sections_["marks"] == revision) {
    marks_.resize(kept);
    marks_.resize(new_marks.size() + 1, revision);
  }
  all_ = std::move(all);
  revision_ = revision;
}

Json StateNews::since(std::uint64_t after) const {
  Json out = Json::object();
  const auto add = [&](Json& to, const Stamps& stamps, const Json& from) {
    for (const auto& [key, at] : stamps)
      if (at > after) to[key] = from[key];
  };
  add(out, sections_, all_);
  if (out.contains("views")) {
    out["views"] = Json::array();
    for (std::size_t v = 0; v < views_.size(); ++v) {
      Json view = Json::object();
      add(view, views_[v], all_["views"][v]);
      if (view.empty()) continue;
      view["index"] = v;
      out["views"].push_back(std::move(view));
    }
  }
  if (out.contains("marks")) {
    const auto kept = std::find_if(marks_.begin(), marks_.end(), [&](std::uint64_t at) { return at > after; });
    const auto count = kept - marks_.begin();
    const Json& marks = all_["marks"];
    out["marks"] = Json::array();
    out["marks"].insert(out["marks"].end(), marks.begin() + count, marks.end());
    out["marks_kept"] = count;
  }
  return out;
}

PageServer::PageServer(LabelSource& source, PageOptions options)
    : source_(source),
      options_(std::move(options)),
      exports_([&source] { source.save(); }, options_.exports),
      news_(options_.longest_poll_ms, options_.http.responses),
      host_(options_, places()) {}

PageHost::Places PageServer::places() {
  constexpr std::string_view kExports = "/export/";
  return {{"state", {"GET", [this](const HttpRequest& r) { return get_state(r); }}},
          {"photo", {"GET", [this](const HttpRequest& r) { return get_photo(r); }}},
          {"event", {"POST", [this](const HttpRequest& r) { return post_event(r); }}},
          {"picture", {"POST", [this](const HttpRequest& r) { return post_picture(r); }}},
          {"thing", {"POST", [this](const HttpRequest& r) { return post_thing(r); }}},
          {"export", {"POST", [this](const HttpRequest& r) { return post_export(r); }}},
          {"export/", {"GET", [this, kExports](const HttpRequest& r) {
                         return exports_.download(r.path.substr(r.path.find(kExports) + kExports.size()));
                       }}}};
}

// Exports change beside the session, so the page follows the sum of both counts.
Json PageServer::news_since(std::uint64_t after) {
  const std::lock_guard lock(told_mutex_);
  const std::uint64_t exported = exports_.changes();
  const auto state = source_.state();
  const std::uint64_t first = options_.first_revision;
  told_.take(state_json(*state, source_, exports_.list(), options_.run_id, first), state->revision + exported);
  Json out = told_.since(after);
  out["revision"] = first + told_.revision();
  return out;
}

HttpResponse PageServer::get_state(const HttpRequest& request) {
  std::uint64_t after = query_number(request.query, "after", 0, kMostNumber);
  const std::uint64_t first = options_.first_revision;
  const bool ours = after >= first && after - first <= source_.state()->revision + exports_.changes();
  after = ours ? after - first : 0;  // else: of an earlier life of the server
  HttpResponse response;
  news_.wait(request, after == 0, [&](std::chrono::milliseconds left) {
    const std::uint64_t exported = exports_.changes();
    const std::uint64_t known = after > exported ? after - exported : 0;
    const bool last = left.count() == 0;
    const auto state = last ? source_.state() : source_.wait_state(known, std::min(kStateLook, left));
    if (!last && state->revision + exported <= after) return false;
    response = json_answer(news_since(after));
    return true;
  });
  return response;
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
  HttpResponse response = jpeg_answer(photo_jpeg(source_.photo(view, most), most));
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
  return bytes_answer(picture_bytes(picture, source_.state()->classes));
}

HttpResponse PageServer::post_thing(const HttpRequest& request) {
  const PictureRequest wanted = parse_thing_request(request.body);
  check_view(static_cast<std::uint64_t>(wanted.view));
  const Picture picture = source_.picture(wanted, [&] { return request.abandoned(); });
  if (picture.stale) return bytes_answer(thing_bytes(picture, {}, 1));
  return bytes_answer(thing_bytes(picture, source_.photo(wanted.view, 0),
                                  source_.state()->views[static_cast<std::size_t>(wanted.view)].width_px));
}

HttpResponse PageServer::post_export(const HttpRequest& request) {
  const Json root = parse_request(request.body, {"what", "cancel"});
  if (root.size() != 1) kRequest.refuse("expected either 'what' or 'cancel'");
  const auto wanted = root.begin();
  const std::string* word = wanted.value().get_ptr<const std::string*>();
  if (word == nullptr) kRequest.refuse_value(wanted.key(), "a word", wanted.value());
  return json_answer({{"id", wanted.key() == "what" ? exports_.start(*word) : exports_.cancel(*word)}});
}

std::string new_token() {
  std::array<std::uint8_t, 16> bits{};
  if (getrandom(bits.data(), bits.size(), 0) != static_cast<ssize_t>(bits.size()))
    throw Error(ErrorKind::unavailable, "system.random.missing",
                "the system gives no random bits for the page's secret address",
                "see `man 2 getrandom`; a kernel from 3.17 on has it");
  std::string token;
  for (const std::uint8_t b : bits) {
    token += "0123456789abcdef"[b >> 4];
    token += "0123456789abcdef"[b & 15];
  }
  return token;
}

std::string kept_token(const std::string& run_dir) {
  const std::string path = run_dir + "/serve_token";
  struct stat facts {};
  if (lstat(path.c_str(), &facts) == 0 && S_ISREG(facts.st_mode) && (facts.st_mode & 077) == 0 &&
      facts.st_uid == geteuid()) {
    const std::string kept = read_text_file(path);
    if (kept.size() == 32 && kept.find_first_not_of("0123456789abcdef") == std::string::npos) return kept;
  }
  unlink(path.c_str());
  const int file = open(path.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC | O_NOFOLLOW, 0600);
  if (file < 0) throw write_error("create", path, errno);
  const std::string token = new_token();
  try {
    append_all(file, path, token);
  } catch (...) {
    close(file);
    throw;
  }
  close(file);
  return token;
}

std::string error_json(Code code, const std::string& message, const std::string& remedy) {
  return json_text({{"error", message}, {"code", code.text()}, {"remedy", remedy}});
}

HttpResponse json_answer(const Json& json) { return {200, "application/json", json_text(json)}; }

HttpResponse bytes_answer(std::string bytes) { return {200, "application/octet-stream", std::move(bytes)}; }

std::string joined_parts(std::initializer_list<std::string_view> parts) {
  std::string out;
  for (const std::string_view part : parts) {
    for (int shift = 0; shift < 32; shift += 8) out += static_cast<char>((part.size() >> shift) & 0xFF);
    out += part;
  }
  return out;
}

HttpResponse jpeg_answer(const std::vector<std::uint8_t>& jpeg) {
  return {200, "image/jpeg", std::string(jpeg.begin(), jpeg.end())};
}

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

void News::wait(const HttpRequest& request, bool at_once,
                const std::function<bool(std::chrono::milliseconds left)>& look) {
  constexpr std::chrono::milliseconds kNone(0);
  const auto end = Clock::now() + longest_;
  ++waiting_;
  const std::unique_ptr<std::atomic<int>, void (*)(std::atomic<int>*)> waits(
      &waiting_, [](std::atomic<int>* waiting) { --*waiting; });
  for (bool found = false; !found;) {
    const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(end - Clock::now());
    const bool crowded = ended_ || 2 * waiting_ > responses_;
    if (crowded) std::this_thread::sleep_for(kStateLook);  // a page that asks again and again stays calm
    found = look(crowded || at_once || request.abandoned() ? kNone : std::max(left, kNone));
  }
}

std::string PageHost::url() const {
  return fmt::format("http://{}:{}/{}/", options_.http.address == kEveryAddress ? "127.0.0.1" : options_.http.address,
                     options_.http.port, options_.token);
}

// Takes the same time for every wrong token, so that none can be found byte by byte.
bool PageHost::is_token(const std::string& path) const {
  if (path.size() < options_.token.size() + 1 || path[0] != '/') return false;
  unsigned differs = 0;
  for (std::size_t i = 0; i < options_.token.size(); ++i)
    differs |= static_cast<unsigned char>(path[i + 1]) ^ static_cast<unsigned char>(options_.token[i]);
  return differs == 0 && (path.size() == options_.token.size() + 1 || path[options_.token.size() + 1] == '/');
}

// A name of somebody else that is made to point here (DNS rebinding) is no host of ours. A server of every address
// has many, but all are numbers.
bool PageHost::is_host(const std::string& host) const {
  const std::size_t colon = host.rfind(':');
  if (colon == std::string::npos || host.substr(colon + 1) != std::to_string(options_.http.port)) return false;
  const std::string name = lower_case(host.substr(0, colon));
  return name == "127.0.0.1" || name == "localhost" || name == options_.http.address ||
         (options_.http.address == kEveryAddress && is_ipv4(name));
}

std::optional<HttpResponse> PageHost::refuse(const HttpRequest& head) const {
  if (!is_token(head.path)) return HttpResponse{404, "text/plain", "not found\n"};
  const std::string host = head.header("host").value_or("");
  if (head.header_count("host") != 1 || !is_host(host))
    return forbidden(
        fmt::format("the page is at {}:{} alone; a tunnel has to lead there from the same port (ssh -L "
                    "{}:127.0.0.1:{} ...)",
                    options_.http.address, options_.http.port, options_.http.port, options_.http.port));
  if (const auto origin = head.header("origin"); head.method == "POST" && origin && *origin != "http://" + host)
    return forbidden("a page of another origin may not send");
  const std::string site = head.header("sec-fetch-site").value_or("none");
  // A link that leads here from another page opens the page; it can neither read nor send.
  const bool opens = head.method == "GET" && head.header("sec-fetch-mode") == "navigate" &&
                     head.header("sec-fetch-dest") == "document";
  if (site != "none" && site != "same-origin" && !opens) return forbidden("a page of another site may not ask");
  if (head.path.size() == options_.token.size() + 1) {  // without the folder's slash relative addresses would leave it
    HttpResponse onward{308, "text/plain", ""};
    onward.location = head.path + "/";
    return onward;
  }
  return std::nullopt;
}

PageFiles read_page_files(const std::string& index) {
  static const std::map<std::string, std::string> types{{".html", "text/html; charset=utf-8"},
                                                        {".js", "text/javascript; charset=utf-8"},
                                                        {".css", "text/css; charset=utf-8"},
                                                        {".svg", "image/svg+xml"}};
  PageFiles files;
  std::error_code failed;
  const std::string folder = shared_file("app/serve/page");
  for (const auto& entry : fs::directory_iterator(folder, failed)) {
    const auto type = types.find(entry.path().extension().string());
    if (type == types.end() || !entry.is_regular_file(failed)) continue;
    files[entry.path().filename().string()] = {type->second, read_text_file(entry.path().string())};
  }
  const auto first = files.find(index + ".html");
  if (first == files.end())
    throw Error(ErrorKind::no_input, "files.shared.missing",
                folder + ": the page's " + index + ".html is not there, which comes with the program",
                "install the component 'app' whole, or run the program from its build folder");
  files[""] = first->second;
  return files;
}

namespace {

struct Kept {
  std::string id, place;
};

// None: there is no such file, or it holds something else.
std::optional<Kept> kept_in(const fs::path& run_dir) {
  constexpr std::size_t kMostBytes = 8192;
  const fs::path file = run_dir / "run_id";
  if (!is_file(file)) return std::nullopt;
  const std::string text = read_file_start(file.string(), kMostBytes);
  const std::size_t end = text.find('\n');
  if (end != 32 || text.find_first_not_of("0123456789abcdef") != end || !text.ends_with('\n')) return std::nullopt;
  return Kept{text.substr(0, end), text.substr(end + 1, text.size() - end - 2)};
}

bool is_copy(const Kept& kept, const fs::path& place) {
  std::error_code unknown;
  if (kept.place == place || fs::equivalent(kept.place, place, unknown)) return false;
  const std::optional<Kept> original = kept_in(kept.place);
  return original && original->id == kept.id;
}

}  // namespace

std::string kept_run_id(const std::string& run_dir) {
  const fs::path place = fs::weakly_canonical(fs::absolute(run_dir));
  std::optional<Kept> kept = kept_in(place);
  if (kept && kept->place == place) return kept->id;
  if (kept && is_copy(*kept, place)) {
    fs::remove(place / "serve_token");
    kept.reset();
  }
  const std::string id = kept ? kept->id : new_token();
  write_file_atomic((place / "run_id").string(), id + "\n" + place.string() + "\n");
  return id;
}

HostOptions host_at(const std::string& address, std::optional<int> port, const std::string& index,
                    const std::string& guide) {
  HostOptions options;
  options.http.address = address;
  options.http.port = port.value_or(kUsualPort);
  options.http.next_port = !port;
  HttpOptions tried = options.http;
  close(listen_on(tried));
  options.files = read_page_files(index);
  options.guide = guide;
  return options;
}

PageHost::PageHost(HostOptions options, Places places) : options_(std::move(options)), places_(std::move(places)) {
  for (const auto& [name, file] : options_.files)
    places_[name] = {"GET", [&file](const HttpRequest&) { return HttpResponse{200, file.type, file.bytes}; }};
  HttpHandler handler;
  handler.refuse = [this](const HttpRequest& head) {
    std::optional<HttpResponse> refused;
    const HttpResponse failed = safe_answer([&] {
      refused = refuse(head);
      return HttpResponse{};
    });
    return failed.status == 200 ? refused : failed;
  };
  handler.answer = [this](const HttpRequest& request) { return safe_answer([&] { return route(request); }); };
  const int listener = listen_on(options_.http);
  http_.emplace(options_.http, listener, std::move(handler));
}

HttpResponse PageHost::route(const HttpRequest& request) {
  const std::string name = request.path.substr(options_.token.size() + 2);  // below the secret folder
  auto place = places_.find(name);
  if (const std::size_t slash = name.find('/'); place == places_.end() && slash != std::string::npos)
    place = places_.find(name.substr(0, slash + 1));
  if (place == places_.end())
    return {404, "application/json",
            error_json("serve.address.unknown", "nothing is at this address", "see " + options_.guide)};
  if (request.method == place->second.method) return place->second.answer(request);
  HttpResponse wrong{405, "application/json",
                     error_json("serve.request.method", "this address takes another method", "")};
  wrong.allow = place->second.method;
  return wrong;
}

}  // namespace semfield::app
