#include "app/serve/http_server.h"

#include <civetweb.h>
#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cctype>
#include <chrono>
#include <cstdio>
#include <mutex>
#include <thread>

#include "core/error.h"

namespace semfield::app {

namespace {

using Clock = std::chrono::steady_clock;

constexpr std::size_t kSentAtOnce = std::size_t{64} << 10;
constexpr auto kFarewell = std::chrono::seconds(1);
constexpr double kLeastBytesPerSecond = 20e3;  // a client that takes less is cut off

const char* reason(int status) {
  switch (status) {
    case 200:
      return "OK";
    case 308:
      return "Permanent Redirect";
    case 400:
      return "Bad Request";
    case 403:
      return "Forbidden";
    case 404:
      return "Not Found";
    case 405:
      return "Method Not Allowed";
    case 408:
      return "Request Timeout";
    case 413:
      return "Content Too Large";
    case 503:
      return "Service Unavailable";
    default:
      return "Internal Server Error";
  }
}

std::string small_letters(const char* text) {
  std::string out(text);
  std::transform(out.begin(), out.end(), out.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  return out;
}

HttpRequest head_of(const mg_request_info& info) {
  HttpRequest request;
  request.method = info.request_method != nullptr ? info.request_method : "";
  const std::string uri = info.request_uri != nullptr ? info.request_uri : "";
  request.path = uri.substr(0, uri.find('?'));
  request.query = info.query_string != nullptr ? info.query_string : "";
  for (int i = 0; i < info.num_headers; ++i)
    request.headers.emplace_back(small_letters(info.http_headers[i].name), info.http_headers[i].value);
  return request;
}

// Whether all of it was taken, at no less than the least rate.
class Sender {
 public:
  Sender(mg_connection* connection, double bytes)
      : connection_(connection),
        end_(Clock::now() + std::chrono::seconds(20) +
             std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(bytes / kLeastBytesPerSecond))) {
  }

  bool send(const char* bytes, std::size_t size) {
    for (std::size_t at = 0; at < size; at += kSentAtOnce) {
      const std::size_t now = std::min(kSentAtOnce, size - at);
      if (Clock::now() > end_ || mg_write(connection_, bytes + at, now) != static_cast<int>(now)) return false;
    }
    return true;
  }

 private:
  mg_connection* connection_;
  Clock::time_point end_;
};

using File = std::unique_ptr<std::FILE, int (*)(std::FILE*)>;

std::string head_text(const HttpResponse& response, std::size_t bytes, bool keep) {
  std::string head = fmt::format(
      "HTTP/1.1 {} {}\r\nContent-Type: {}\r\nContent-Length: {}\r\nCache-Control: {}\r\nConnection: {}\r\n"
      "Referrer-Policy: no-referrer\r\nX-Content-Type-Options: nosniff\r\nX-Frame-Options: DENY\r\n"
      "Cross-Origin-Resource-Policy: same-origin\r\n"
      "Content-Security-Policy: default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'; base-uri "
      "'none'; form-action 'none'\r\n",
      response.status, reason(response.status), response.type, bytes, response.cache, keep ? "keep-alive" : "close");
  if (!response.location.empty()) head += "Location: " + response.location + "\r\n";
  if (!response.allow.empty()) head += "Allow: " + response.allow + "\r\n";
  if (!response.download_name.empty())
    head += "Content-Disposition: attachment; filename=\"" + response.download_name + "\"\r\n";
  return head + "\r\n";
}

void send(mg_connection* connection, HttpResponse response, bool keep) {
  File file(nullptr, std::fclose);
  std::size_t bytes = response.body.size();
  if (!response.file.empty()) {
    file.reset(std::fopen(response.file.c_str(), "rbe"));
    if (file == nullptr || std::fseek(file.get(), 0, SEEK_END) != 0) {
      response = {404, "text/plain", "the file is gone\n"};
      file.reset();
      bytes = response.body.size();
    } else {
      bytes = static_cast<std::size_t>(std::ftell(file.get()));
      std::rewind(file.get());
    }
  }
  if (!keep) mg_disable_connection_keep_alive(connection);
  Sender sender(connection, static_cast<double>(bytes));
  const std::string head = head_text(response, bytes, keep);
  bool whole = sender.send(head.data(), head.size());
  if (file == nullptr) {
    whole = whole && sender.send(response.body.data(), response.body.size());
  } else {
    std::vector<char> piece(kSentAtOnce);
    while (whole && bytes > 0) {
      const std::size_t got = std::fread(piece.data(), 1, std::min(bytes, piece.size()), file.get());
      whole = got > 0 && sender.send(piece.data(), got);
      bytes -= got;
    }
  }
  if (!whole) mg_disable_connection_keep_alive(connection);
}

}  // namespace

std::optional<std::string> HttpRequest::header(const std::string& name) const {
  for (const auto& [key, value] : headers) {
    if (key == name) return value;
  }
  return std::nullopt;
}

int HttpRequest::header_count(const std::string& name) const {
  return static_cast<int>(
      std::count_if(headers.begin(), headers.end(), [&](const auto& h) { return h.first == name; }));
}

struct HttpServer::Impl {
  HttpOptions options;
  HttpHandler& handler;
  std::mutex log_mutex;
  std::string log;  // the last complaint of civetweb
  std::atomic<int> answering{0};
  mg_context* context = nullptr;

  Impl(const HttpOptions& o, HttpHandler& h) : options(o), handler(h) {}

  static int on_request(mg_connection* connection) {
    auto* impl = static_cast<Impl*>(mg_get_request_info(connection)->user_data);
    ++impl->answering;
    impl->serve(connection);
    --impl->answering;
    return 200;  // answered: civetweb does nothing more
  }
  // What civetweb itself refuses, such as a head that is none: its own pages have none of our headers.
  static int on_error(mg_connection* connection, int status, const char*) {
    send(connection, {status == 500 ? 500 : 400, "text/plain", "the request cannot be read\n"}, false);
    return 0;
  }
  static int on_log(const mg_connection* connection, const char* message) {
    auto* impl = static_cast<Impl*>(mg_get_user_data(mg_get_context(connection)));
    if (impl == nullptr) return 1;
    const std::scoped_lock lock(impl->log_mutex);
    impl->log = message;
    return 1;  // nothing is printed
  }

  void serve(mg_connection* connection) {
    const mg_request_info& info = *mg_get_request_info(connection);
    HttpRequest request = head_of(info);
    // What frames a body in two ways could be read in two ways.
    const bool lengths = request.header_count("content-length") + request.header_count("transfer-encoding") > 1;
    const bool body = info.content_length > 0 || request.header_count("transfer-encoding") > 0;
    if (std::optional<HttpResponse> refusal = handler.refuse(request)) return send(connection, *refusal, !body);
    if (lengths) return send(connection, {400, "text/plain", "the request has two lengths\n"}, false);
    if (body) {
      const int status = read_body(connection, info.content_length, request.body);
      if (status != 200) return send(connection, {status, "text/plain", std::string(reason(status)) + "\n"}, false);
    }
    send(connection, handler.answer(request), true);
  }

  // 200, or the status that says why not. civetweb waits for every byte that it is asked for, with a limit of its own
  // between two bytes, so few are asked for at a time and the deadline is looked at between.
  int read_body(mg_connection* connection, long long length, std::string& body) const {
    if (length > static_cast<long long>(options.most_body_bytes)) return 413;
    const auto end = Clock::now() + std::chrono::milliseconds(options.body_ms);
    std::array<char, 16> piece{};
    for (;;) {
      const std::size_t wanted =
          length < 0 ? piece.size() : std::min(piece.size(), static_cast<std::size_t>(length) - body.size());
      const int got = wanted > 0 ? mg_read(connection, piece.data(), wanted) : 0;
      if (got > 0) body.append(piece.data(), static_cast<std::size_t>(got));
      if (body.size() > options.most_body_bytes) return 413;
      if (Clock::now() > end) return 408;
      if (got > 0) continue;
      if (got < 0 || (length >= 0 && body.size() != static_cast<std::size_t>(length))) return 400;
      return 200;
    }
  }
};

HttpServer::HttpServer(const HttpOptions& options, HttpHandler& handler)
    : impl_(std::make_unique<Impl>(options, handler)) {
  static const unsigned started = mg_init_library(0);  // counted, and of no weight: nothing of it is ever given back
  (void)started;
  const std::string listening = options.address + ":" + std::to_string(options.port);
  const std::string threads = std::to_string(options.threads), waiting = std::to_string(options.connections_waiting),
                    head_ms = std::to_string(options.head_ms);
  // No document root: there is no file that civetweb could find by itself.
  const std::array<const char*, 23> settings{"listening_ports",
                                             listening.c_str(),
                                             "num_threads",
                                             threads.c_str(),
                                             "connection_queue",
                                             waiting.c_str(),
                                             "listen_backlog",
                                             waiting.c_str(),
                                             "request_timeout_ms",
                                             head_ms.c_str(),
                                             "keep_alive_timeout_ms",
                                             head_ms.c_str(),
                                             "enable_keep_alive",
                                             "yes",
                                             "tcp_nodelay",
                                             "1",
                                             "max_request_size",
                                             "16384",
                                             "decode_url",
                                             "no",
                                             "access_control_allow_origin",
                                             "",
                                             nullptr};
  mg_callbacks callbacks{};
  callbacks.begin_request = Impl::on_request;
  callbacks.http_error = Impl::on_error;
  callbacks.log_message = Impl::on_log;
  mg_context* context = mg_start(&callbacks, impl_.get(), const_cast<const char**>(settings.data()));
  if (context == nullptr)
    throw Error(ErrorKind::unavailable, "the HTTP server cannot start on " + listening + ": " + impl_->log,
                "name another --port, or see what limits this process: ulimit -n -u");
  impl_->context = context;
}

HttpServer::~HttpServer() {
  // civetweb sends nothing any more once it stops.
  for (const auto end = Clock::now() + kFarewell; impl_->answering > 0 && Clock::now() < end;)
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
  mg_stop(impl_->context);
}

}  // namespace semfield::app
