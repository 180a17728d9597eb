// A plain socket as an HTTP client: what is sent is what the test wrote, byte for byte.
#pragma once

#include <arpa/inet.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <string>

namespace semfield::testing_http {

struct Answer {
  int status = 0;  ///< 0: the connection ended without one
  std::string head, body;

  /// Value of a header by its name in small letters; "" where it is missing.
  std::string header(const std::string& name) const {
    std::string small = head;
    std::transform(small.begin(), small.end(), small.begin(), [](unsigned char c) { return std::tolower(c); });
    const std::size_t at = small.find("\r\n" + name + ": ");
    if (at == std::string::npos) return "";
    const std::size_t start = at + 4 + name.size();
    return head.substr(start, head.find("\r\n", start) - start);
  }
};

class Connection {
 public:
  explicit Connection(int port) : socket_(socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0)) {
    sockaddr_in place{};
    place.sin_family = AF_INET;
    place.sin_port = htons(static_cast<std::uint16_t>(port));
    place.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    open_ = connect(socket_, reinterpret_cast<const sockaddr*>(&place), sizeof place) == 0;
    const int yes = 1;
    setsockopt(socket_, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
  }
  Connection(const Connection&) = delete;
  Connection& operator=(const Connection&) = delete;
  ~Connection() { close(socket_); }

  bool open() const { return open_; }

  /// False when the other end has gone.
  bool send(const std::string& bytes) {
    std::size_t at = 0;
    while (at < bytes.size()) {
      const ssize_t sent = ::send(socket_, bytes.data() + at, bytes.size() - at, MSG_NOSIGNAL);
      if (sent <= 0) return false;
      at += static_cast<std::size_t>(sent);
    }
    return true;
  }

  /// The next response; status 0 when none has come whole within so many seconds.
  Answer receive(double seconds = 30) {
    const auto end = std::chrono::steady_clock::now() + std::chrono::milliseconds(static_cast<long>(1000 * seconds));
    Answer answer = receive_head(seconds);
    const std::size_t size = std::strtoul(answer.header("content-length").c_str(), nullptr, 10);
    while (got_.size() < size) {
      if (!more(end)) return {};
    }
    answer.body = got_.substr(0, size);
    got_.erase(0, size);
    return answer;
  }

  /// The next response's head, where it has no body whatever its length says.
  Answer receive_head(double seconds) {
    const auto end = std::chrono::steady_clock::now() + std::chrono::milliseconds(static_cast<long>(1000 * seconds));
    std::size_t head = std::string::npos;
    while ((head = got_.find("\r\n\r\n")) == std::string::npos) {
      if (!more(end)) return {};
    }
    Answer answer{0, got_.substr(0, head + 2), ""};
    answer.status = std::atoi(answer.head.c_str() + std::min<std::size_t>(9, answer.head.size()));
    got_.erase(0, head + 4);
    return answer;
  }

  /// Whether the other end closes within so many seconds.
  bool closes(double seconds) {
    const auto end = std::chrono::steady_clock::now() + std::chrono::milliseconds(static_cast<long>(1000 * seconds));
    while (more(end)) {
    }
    return ended_;
  }

 private:
  bool more(std::chrono::steady_clock::time_point end) {
    const auto left =
        std::chrono::duration_cast<std::chrono::milliseconds>(end - std::chrono::steady_clock::now()).count();
    pollfd ready{socket_, POLLIN, 0};
    if (left <= 0 || poll(&ready, 1, static_cast<int>(left)) <= 0) return false;
    char piece[65536];
    const ssize_t got = recv(socket_, piece, sizeof piece, 0);
    if (got <= 0) {
      ended_ = true;
      return false;
    }
    got_.append(piece, static_cast<std::size_t>(got));
    return true;
  }

  int socket_;
  bool open_ = false, ended_ = false;
  std::string got_;
};

}  // namespace semfield::testing_http
