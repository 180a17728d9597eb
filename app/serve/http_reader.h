// One HTTP request of a connection, read as its bytes come.
#pragma once

#include <atomic>
#include <cstddef>
#include <memory>
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
  std::shared_ptr<const std::atomic<bool>> gone{};  ///< set once the client has closed its connection

  /// Nobody waits for the response any more.
  bool abandoned() const { return gone != nullptr && *gone; }
  /// Value of a header by its name in small letters; none where it is missing.
  std::optional<std::string> header(const std::string& name) const;
  int header_count(const std::string& name) const;
};

/// HTTP/1.1 [RFC9112], read strictly: what two readers could understand in two ways, such as two lengths of a body, is
/// refused. It never holds more than a head, a body and what came with them.
class HttpReader {
 public:
  enum class State { head, body, whole, refused };

  explicit HttpReader(std::size_t most_body_bytes) : most_body_bytes_(most_body_bytes) {}

  /// Bytes that have come. What lies behind the request is kept for next().
  State take(std::string_view bytes);
  State state() const { return state_; }
  /// Something of a request has come.
  bool begun() const { return state_ != State::head || !pending_.empty(); }
  /// Its head from State::body on, all of it in State::whole.
  HttpRequest& request() { return request_; }
  /// The connection may serve another request.
  bool keeps() const { return keeps_ && state_ == State::whole; }
  /// The client waits for "100 Continue" before it sends the body.
  bool expects_continue() const { return expects_continue_ && state_ == State::body; }
  /// Of a refused request: the status, and a sentence.
  int status() const { return status_; }
  const std::string& complaint() const { return complaint_; }
  /// The next request of the connection begins.
  void next();

 private:
  State refuse(int status, const char* complaint);
  bool is_above(std::size_t most, std::size_t end, std::size_t ending) const;
  State read();
  State read_head(std::size_t end);
  State read_framing();
  State read_length(const std::string& text);
  State read_body();
  State read_chunks();

  std::size_t most_body_bytes_;
  std::string pending_;  // not read yet
  HttpRequest request_;
  State state_ = State::head;
  bool keeps_ = true, expects_continue_ = false, chunked_ = false;
  std::size_t left_ = 0;  // of the body or the chunk
  bool in_chunk_ = false;
  int status_ = 0;
  std::string complaint_;
};

}  // namespace semfield::app
