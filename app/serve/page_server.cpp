#include "app/serve/page_server.h"

#include <arpa/inet.h>
#include <fcntl.h>
#include <sys/random.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cctype>
#include <cerrno>
#include <chrono>
#include <cstdint>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <thread>

#include "app/serve/page_pictures.h"
#include "app/serve/page_requests.h"
#include "app/serve/page_state.h"
#include "core/error.h"
#include "system/files.h"

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

namespace {

constexpr const char* kEveryAddress = "0.0.0.0";

HttpResponse forbidden(const std::string& why) { return {403, "text/plain", why + "\n"}; }

bool is_ipv4(const std::string& text) {
  in_addr number{};
  return inet_pton(AF_INET, text.c_str(), &number) == 1;
}

}  // namespace

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

PageAccess::PageAccess(std::string token, std::string address, int port)
    : token_(std::move(token)), address_(std::move(address)), port_(port) {}

std::string PageAccess::url() const {
  return "http://" + (address_ == kEveryAddress ? "127.0.0.1" : address_) + ":" + std::to_string(port_) + "/" + token_ +
         "/";
}

// Takes the same time for every wrong token, so that none can be found byte by byte.
bool PageAccess::is_token(const std::string& path) const {
  if (path.size() < token_.size() + 1 || path[0] != '/') return false;
  unsigned differs = 0;
  for (std::size_t i = 0; i < token_.size(); ++i)
    differs |= static_cast<unsigned char>(path[i + 1]) ^ static_cast<unsigned char>(token_[i]);
  return differs == 0 && (path.size() == token_.size() + 1 || path[token_.size() + 1] == '/');
}

// A name of somebody else that is made to point here (DNS rebinding) is no host of ours. A server of every address
// has many, but all are numbers.
bool PageAccess::is_host(const std::string& host) const {
  const std::size_t colon = host.rfind(':');
  if (colon == std::string::npos || host.substr(colon + 1) != std::to_string(port_)) return false;
  std::string name = host.substr(0, colon);
  std::transform(name.begin(), name.end(), name.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  return name == "127.0.0.1" || name == "localhost" || name == address_ || (address_ == kEveryAddress && is_ipv4(name));
}

std::optional<HttpResponse> PageAccess::refuse(const HttpRequest& head) const {
  if (!is_token(head.path)) return HttpResponse{404, "text/plain", "not found\n"};
  const std::string host = head.header("host").value_or("");
  if (head.header_count("host") != 1 || !is_host(host))
    return forbidden("the page is at " + address_ + ":" + std::to_string(port_) +
                     " alone; a tunnel has to lead there from the same port (ssh -L " + std::to_string(port_) +
                     ":127.0.0.1:" + std::to_string(port_) + " ...)");
  if (const auto origin = head.header("origin"); head.method == "POST" && origin && *origin != "http://" + host)
    return forbidden("a page of another origin may not send");
  const std::string site = head.header("sec-fetch-site").value_or("none");
  // A link that leads here from another page opens the page; it can neither read nor send.
  const bool opens = head.method == "GET" && head.header("sec-fetch-mode") == "navigate" &&
                     head.header("sec-fetch-dest") == "document";
  if (site != "none" && site != "same-origin" && !opens) return forbidden("a page of another site may not ask");
  if (head.path.size() == token_.size() + 1) {  // without the folder's slash relative addresses would leave it
    HttpResponse onward{308, "text/plain", ""};
    onward.location = head.path + "/";
    return onward;
  }
  return std::nullopt;
}

std::map<std::string, PageFile> read_page_files(const std::string& folder) {
  static const std::map<std::string, std::string> types{{".html", "text/html; charset=utf-8"},
                                                        {".js", "text/javascript; charset=utf-8"},
                                                        {".css", "text/css; charset=utf-8"},
                                                        {".svg", "image/svg+xml"},
                                                        {".png", "image/png"},
                                                        {".ico", "image/x-icon"}};
  std::map<std::string, PageFile> files;
  std::error_code failed;
  for (const auto& entry : std::filesystem::directory_iterator(folder, failed)) {
    const auto type = types.find(entry.path().extension().string());
    if (type == types.end() || !entry.is_regular_file(failed)) continue;
    files[entry.path().filename().string()] = {type->second, read_text_file(entry.path().string())};
  }
  const auto index = files.find("index.html");
  if (index == files.end())
    throw Error(ErrorKind::no_input, "files.shared.missing",
                folder + ": the page's index.html is not there, which comes with the program",
                "install the component 'app' whole, or run the program from its build folder");
  files[""] = index->second;
  return files;
}

}  // namespace semfield::app
