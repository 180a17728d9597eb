// HTTP on one address: bounded connections, threads, heads, bodies and times. Knows nothing of the page.
#pragma once

#include <cstddef>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/non_copyable.h"

namespace semfield::app {

struct HttpRequest {
  std::string method, path;                                  ///< path: as sent, without the query
  std::string query;                                         ///< without '?'
  std::vector<std::pair<std::string, std::string>> headers;  ///< names in small letters
  std::string body;
  std::function<bool()> gone{};  ///< whether the client has closed its connection; valid until there is a response

  /// Nobody waits for the response any more.
  bool abandoned() const { return gone && gone(); }
  /// Value of a header by its name in small letters; none where it is missing.
  std::optional<std::string> header(const std::string& name) const;
  int header_count(const std::string& name) const;
};

/// Why a request is not read any further.
struct HttpRefusal {
  int status = 0;  ///< 0: the connection has ended, so that nobody gets a response
  std::string complaint{};
};

/// The request of a connection, HTTP/1.1 [RFC9112], read strictly: what two readers could understand in two ways, such
/// as two lengths of a body, is refused. It never holds more than a head, a body and what came with them.
class HttpReader {
 public:
  /// `more` adds bytes that come to those that are not read yet, or throws HttpRefusal.
  HttpReader(std::size_t most_body_bytes, std::function<void(std::string& unread)> more)
      : most_body_bytes_(most_body_bytes), more_(std::move(more)) {}

  /// The request without its body, which read_body() brings. Both throw HttpRefusal.
  HttpRequest read_head();
  void read_body(HttpRequest& request);

 private:
  std::size_t most_body_bytes_;
  std::function<void(std::string&)> more_;
  std::string unread_;
  std::size_t length_ = 0;  // of the body
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
  int port = kUsualPort;
  bool next_port = false;         ///< when the port is taken, one of the 99 behind it
  int responses = 64;             ///< made at a time; other requests wait
  std::size_t connections = 512;  ///< with more, the one that has been waited for the longest is closed
  std::size_t most_body_bytes = std::size_t{256} << 10;
  int head_ms = 5000;   ///< for a head, and for a client that reads nothing
  int body_ms = 10000;  ///< for a body
};

/// A socket that listens at the address and port, 0: any; the port that it has is written into the options. Throws
/// Error: usage for an address that is none, unavailable for one that this machine has not, and for a port that is
/// taken or forbidden.
int listen_on(HttpOptions& options);

/// A connection serves one request, in a thread of its own, so that one that is idle, slow or gone holds up nobody.
class HttpServer : NonCopyable {
 public:
  /// Serves when it returns, and closes the listener (listen_on) in the end. Throws Error(unavailable).
  HttpServer(const HttpOptions& options, int listener, HttpHandler handler);
  /// Responses that are being made get a second to be sent; those that take longer are marked as awaited by nobody
  /// (HttpRequest::abandoned), waited for and not sent.
  ~HttpServer();

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace semfield::app
