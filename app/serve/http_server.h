// HTTP on one address: bounded connections, threads, heads, bodies and times. Knows nothing of the page.
#pragma once

#include <cstddef>
#include <functional>
#include <memory>
#include <optional>
#include <string>

#include "app/serve/http_reader.h"
#include "core/non_copyable.h"

namespace semfield::app {

struct HttpResponse {
  int status = 200;
  std::string type = "application/json";
  std::string body;
  std::string file{};               ///< not empty: the body is this file, sent in pieces
  std::string cache = "no-store";   ///< Cache-Control
  std::string download_name{};      ///< not empty: the browser saves it under this name
  std::string location{}, allow{};  ///< headers of 308 and 405
  bool own_code = false;            ///< a page whose styles and scripts stand in it
};

/// What a server calls for every request. Neither function throws.
struct HttpHandler {
  /// Called with an empty body, before one is read: a response refuses the request. From several threads at once, as
  /// answer.
  std::function<std::optional<HttpResponse>(const HttpRequest& head)> refuse;
  /// Called from several threads at once.
  std::function<HttpResponse(const HttpRequest& request)> answer;
};

inline constexpr int kUsualPort = 8787;

struct HttpOptions {
  std::string address = "127.0.0.1";  ///< IPv4, numbers
  int port = kUsualPort;              ///< a free_port()
  int responses = 64;                 ///< made at a time; other requests wait
  std::size_t connections = 512;      ///< with more, the one that has been idle the longest is closed
  std::size_t most_body_bytes = std::size_t{256} << 10;
  int head_ms = 5000;   ///< for a head, for a connection without a request, and for a client that reads nothing
  int body_ms = 10000;  ///< for a body
};

/// Each connection has a thread, so that one that is idle, slow or gone holds up nobody.
class HttpServer : NonCopyable {
 public:
  /// Listens when it returns. Throws Error(unavailable).
  HttpServer(const HttpOptions& options, HttpHandler handler);
  /// Responses that are being made get a second to be sent; those that take longer are marked as awaited by nobody
  /// (HttpRequest::abandoned), waited for and not sent.
  ~HttpServer();

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace semfield::app
