// Requests of HTTP/1.1, read strictly from the bytes of a connection.
#pragma once

#include <cstddef>
#include <functional>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

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

/// The requests of one connection, HTTP/1.1 [RFC9112], read strictly: what two readers could understand in two ways,
/// such as two lengths of a body, is refused. It never holds more than a head, a body and what came with them.
class HttpReader {
 public:
  /// `more` adds bytes that come to those that are not read yet, or throws HttpRefusal.
  HttpReader(std::size_t most_body_bytes, std::function<void(std::string& unread)> more)
      : most_body_bytes_(most_body_bytes), more_(std::move(more)) {}

  /// The next request without its body, which read_body() brings. Both throw HttpRefusal.
  HttpRequest read_head();
  void read_body(HttpRequest& request);
  /// The request is read whole, and the connection may serve another one.
  bool keeps() const { return keeps_ && whole_; }
  /// The client waits for "100 Continue" before it sends the body.
  bool expects_continue() const { return expects_continue_ && !whole_; }
  /// The answer has no body.
  bool is_head() const { return is_head_; }

 private:
  void parse_head(std::string_view head, HttpRequest& request);
  void read_framing(const HttpRequest& request);

  std::size_t most_body_bytes_;
  std::function<void(std::string&)> more_;
  std::string unread_;
  bool keeps_ = true, expects_continue_ = false, whole_ = false, is_head_ = false;
  std::size_t length_ = 0;  // of the body
};

}  // namespace semfield::app
