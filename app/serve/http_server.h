// HTTP on one address: bounded connections, threads, heads, bodies and times. Knows nothing of the page.
#pragma once

#include <cstddef>
#include <memory>
#include <optional>
#include <string>

#include "app/serve/http_reader.h"

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
class HttpHandler {
 public:
  virtual ~HttpHandler() = default;
  /// Called with an empty body, before one is read: a response refuses the request. Quick, for every connection waits.
  virtual std::optional<HttpResponse> refuse(const HttpRequest& head) noexcept = 0;
  /// Called from several threads at once.
  virtual HttpResponse answer(const HttpRequest& request) noexcept = 0;
};

inline constexpr int kUsualPort = 8787;

struct HttpOptions {
  std::string address = "127.0.0.1";  ///< IPv4, numbers
  int port = kUsualPort;              ///< a free_port()
  int threads = 64;                   ///< requests handled at a time; the others wait
  std::size_t connections = 512;      ///< with more, the one that has been idle the longest is closed
  std::size_t most_body_bytes = std::size_t{256} << 10;
  int head_ms =
      5000;  ///< for a request's head, for a connection without a request, and for a client that reads nothing
  int body_ms = 10000;  ///< for a body
};

/// One thread watches all connections, so that one that is idle, slow or gone costs no more than its place; the others
/// make responses.
class HttpServer {
 public:
  /// Listens when it returns. The handler must outlive the server. Throws Error(unavailable).
  HttpServer(const HttpOptions& options, HttpHandler& handler);
  /// Responses that are being made get a second to be sent; those that take longer are marked as awaited by nobody
  /// (HttpRequest::abandoned), waited for and not sent.
  ~HttpServer();
  HttpServer(const HttpServer&) = delete;
  HttpServer& operator=(const HttpServer&) = delete;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

/// A port of `address` that can be listened on: `port`, or with `next` the first free one of the hundred from there;
/// for 0 any. Throws Error: usage for an address that is none, unavailable for one that this machine has not, and for a
/// port that is taken or forbidden.
int free_port(const std::string& address, int port, bool next);

}  // namespace semfield::app
