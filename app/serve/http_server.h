// HTTP on one address, by civetweb: bounded threads, heads, bodies and times. Knows nothing of the page.
#pragma once

#include <cstddef>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

namespace semfield::app {

struct HttpRequest {
  std::string method, path;  ///< path: as sent, without the query
  std::string query;         ///< without '?'
  std::vector<std::pair<std::string, std::string>> headers;
  std::string body;

  /// Value of a header by its name in small letters; none where it is missing.
  std::optional<std::string> header(const std::string& name) const;
  int header_count(const std::string& name) const;
};

struct HttpResponse {
  int status = 200;
  std::string type = "application/json";
  std::string body;
  std::string file{};               ///< not empty: the body is this file, sent in pieces
  std::string cache = "no-store";   ///< Cache-Control
  std::string download_name{};      ///< not empty: the browser saves it under this name
  std::string location{}, allow{};  ///< headers of 308 and 405
};

/// What a server asks for every request, from several threads at once. Neither function throws.
class HttpHandler {
 public:
  virtual ~HttpHandler() = default;
  /// Called with an empty body, before one is read: an answer refuses the request.
  virtual std::optional<HttpResponse> refuse(const HttpRequest& head) noexcept = 0;
  virtual HttpResponse answer(const HttpRequest& request) noexcept = 0;
};

struct HttpOptions {
  std::string address = "127.0.0.1";  ///< IPv4, numbers
  int port = 8787;                    ///< a free_port()
  int threads = 64;                   ///< connections served at a time
  int connections_waiting = 128;      ///< more are refused
  std::size_t most_body_bytes = std::size_t{256} << 10;
  int head_ms = 5000;   ///< from a connection's first byte to the end of a request's head
  int body_ms = 10000;  ///< for a body
};

class HttpServer {
 public:
  /// Listens when it returns. The handler must outlive the server. Throws Error(unavailable).
  HttpServer(const HttpOptions& options, HttpHandler& handler);
  /// Answers that are being made get a second to be sent; those that take longer are waited for and not sent.
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
