// A response as the bytes that are sent, piece by piece.
#pragma once

#include <chrono>
#include <cstdio>
#include <memory>
#include <string>
#include <string_view>

#include "app/serve/http_server.h"

namespace semfield::app {

class HttpReply {
 public:
  /// `keep`: the connection serves another request; `body`: it is sent, not its length alone. A file that cannot be
  /// read makes the answer 404.
  HttpReply(HttpResponse response, bool keep, bool body);

  /// What is to be sent next; empty at the end.
  std::string_view piece();
  void sent(std::size_t bytes) { at_ += bytes; }
  bool keeps() const { return keep_; }
  /// All that the head promised could be read.
  bool whole() const { return left_ == 0; }
  /// The client has taken less than 20 kB per second.
  bool too_slow() const { return std::chrono::steady_clock::now() > end_; }

 private:
  std::string bytes_;
  std::size_t at_ = 0;
  std::unique_ptr<std::FILE, int (*)(std::FILE*)> file_{nullptr, std::fclose};
  std::size_t left_ = 0;  // of the file
  bool keep_;
  std::chrono::steady_clock::time_point end_;
};

}  // namespace semfield::app
