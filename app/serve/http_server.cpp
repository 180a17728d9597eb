#include "app/serve/http_server.h"

#include <arpa/inet.h>
#include <fmt/format.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cerrno>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <list>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <string_view>
#include <system_error>
#include <thread>
#include <tuple>
#include <utility>

#include "app/serve/http_port.h"
#include "core/error.h"
#include "core/non_copyable.h"

namespace semfield::app {

namespace {

using Clock = std::chrono::steady_clock;

constexpr std::size_t kReadAtOnce = std::size_t{64} << 10;
constexpr double kLeastBytesPerSecond = 20e3;
constexpr auto kGrace = std::chrono::seconds(20);
constexpr std::chrono::milliseconds kFarewell{1000};
constexpr int kLinger_ms = 2000;  // for what a client still sends behind the request that ends its connection

const char* reason(int status) {
  static const std::map<int, const char*> reasons{{200, "OK"},
                                                  {308, "Permanent Redirect"},
                                                  {400, "Bad Request"},
                                                  {403, "Forbidden"},
                                                  {404, "Not Found"},
                                                  {405, "Method Not Allowed"},
                                                  {408, "Request Timeout"},
                                                  {411, "Length Required"},
                                                  {413, "Content Too Large"},
                                                  {503, "Service Unavailable"}};
  const auto found = reasons.find(status);
  return found == reasons.end() ? "Internal Server Error" : found->second;
}

std::string head_text(const HttpResponse& response, std::size_t bytes, bool keep) {
  std::string head = fmt::format(
      "HTTP/1.1 {} {}\r\nContent-Type: {}\r\nContent-Length: {}\r\nCache-Control: {}\r\nConnection: {}\r\n"
      "Referrer-Policy: no-referrer\r\nX-Content-Type-Options: nosniff\r\nX-Frame-Options: DENY\r\n"
      "Cross-Origin-Resource-Policy: same-origin\r\n"
      "Content-Security-Policy: default-src 'self'{}; img-src 'self' blob: data:; frame-ancestors 'none'; base-uri "
      "'none'; form-action 'none'\r\n",
      response.status, reason(response.status), response.type, bytes, response.cache, keep ? "keep-alive" : "close",
      response.own_code ? " 'unsafe-inline'" : "");
  if (!response.location.empty()) head += "Location: " + response.location + "\r\n";
  if (!response.allow.empty()) head += "Allow: " + response.allow + "\r\n";
  if (!response.download_name.empty())
    head += "Content-Disposition: attachment; filename=\"" + response.download_name + "\"\r\n";
  return head + "\r\n";
}

// Whether one of `events` comes by then.
bool wait_for(int socket, short events, Clock::time_point until) {
  for (;;) {
    const auto left = std::chrono::ceil<std::chrono::milliseconds>(until - Clock::now());
    pollfd look{socket, events, 0};
    const int ready = poll(&look, 1, static_cast<int>(std::max<std::int64_t>(0, left.count())));
    if (ready >= 0 || errno != EINTR) return ready > 0;
  }
}

// False: the client is gone, has read nothing for `still_ms`, or has taken less than 20 kB per second.
bool send_all(int socket, std::string_view bytes, int still_ms, Clock::time_point end) {
  while (!bytes.empty()) {
    const ssize_t sent = ::send(socket, bytes.data(), bytes.size(), MSG_NOSIGNAL | MSG_DONTWAIT);
    if (sent < 0 && (errno == EAGAIN || errno == EINTR)) {
      if (!wait_for(socket, POLLOUT, Clock::now() + std::chrono::milliseconds(still_ms))) return false;
      continue;
    }
    if (sent < 0 || Clock::now() > end) return false;
    bytes.remove_prefix(static_cast<std::size_t>(sent));
  }
  return true;
}

}  // namespace

struct HttpServer::Impl : NonCopyable {
  enum class At { idle, reading, answering, closing };

  // A connection and its thread: a request is read, its response made and sent, then the next one.
  struct Peer {
    Peer(int s, Clock::time_point until) : socket(s), deadline(until) {}

    const int socket;
    At at = At::idle;  // with these two under the server's lock; the thread alone changes them
    Clock::time_point deadline;
    bool ended = false;  // the socket is closed
    std::thread thread{};
  };

  Impl(const HttpOptions& o, HttpHandler h) : options(o), handler(std::move(h)) {
    in_addr address{};
    inet_pton(AF_INET, options.address.c_str(), &address);
    listener = listen_at(address, options.port);
    if (listener < 0) throw cannot_start(std::strerror(errno));
    try {
      acceptor = std::thread([this] { accept_all(); });
    } catch (const std::system_error& e) {
      close(listener);
      throw cannot_start(e.what());
    }
  }
  ~Impl();

  Error cannot_start(const std::string& cause) const {
    return {ErrorKind::unavailable, "serve.port.failed",
            fmt::format("the HTTP server cannot start on {}:{}: {}", options.address, options.port, cause),
            "name another --port, or see what limits this process: ulimit -n -u"};
  }
  void accept_all();
  bool give_up_one(std::unique_lock<std::mutex>& lock);
  void forget_ended();
  void enter(Peer& peer, At at, int ms);
  void serve(Peer& peer);
  bool serve_one(Peer& peer, HttpReader& reader);
  void receive(Peer& peer, std::string& unread);
  bool respond(Peer& peer, HttpResponse response, bool keep, bool with_body = true);

  HttpOptions options;
  HttpHandler handler;
  int listener = -1;
  std::atomic<bool> stopping{false};
  std::mutex mutex;                 // of these
  std::condition_variable changed;  // a peer has ended, or a response is made
  std::list<Peer> peers;
  int answering = 0;
  std::thread acceptor;
};

HttpServer::Impl::~Impl() {
  stopping = true;
  shutdown(listener, SHUT_RDWR);
  acceptor.join();
  close(listener);
  std::unique_lock lock(mutex);
  const auto hang_up = [&](bool all) {
    for (const Peer& peer : peers)
      if (!peer.ended && (all || peer.at != At::answering)) shutdown(peer.socket, SHUT_RDWR);
  };
  hang_up(false);
  changed.wait_for(lock, kFarewell, [&] {
    return std::all_of(peers.begin(), peers.end(), [](const Peer& peer) { return peer.ended; });
  });
  hang_up(true);
  lock.unlock();
  for (Peer& peer : peers) peer.thread.join();
}

void HttpServer::Impl::accept_all() {
  while (!stopping) {
    // With no descriptor left accept4 fails at once, also where nobody waits.
    if (!wait_for(listener, POLLIN, Clock::now() + kFarewell)) continue;
    const int fresh = accept4(listener, nullptr, nullptr, SOCK_CLOEXEC);
    const bool none_left = fresh < 0 && (errno == EMFILE || errno == ENFILE);
    if (fresh < 0 && !none_left) continue;
    std::unique_lock lock(mutex);
    forget_ended();
    if ((none_left || peers.size() >= options.connections) && !give_up_one(lock)) {
      if (none_left) changed.wait_for(lock, kFarewell);
      if (!none_left) close(fresh);  // refused
      continue;
    }
    if (none_left) continue;
    const int yes = 1;
    setsockopt(fresh, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
    Peer& peer = peers.emplace_back(fresh, Clock::now() + std::chrono::milliseconds(options.head_ms));
    try {
      peer.thread = std::thread([this, &peer] { serve(peer); });
    } catch (const std::system_error&) {
      close(fresh);
      peers.pop_back();
    }
  }
}

void HttpServer::Impl::forget_ended() {
  for (auto peer = peers.begin(); peer != peers.end();) {
    if (peer->ended) peer->thread.join();
    peer = peer->ended ? peers.erase(peer) : std::next(peer);
  }
}

// Closes the connection that says nothing for the longest, or else that has not said all; false: there is none.
bool HttpServer::Impl::give_up_one(std::unique_lock<std::mutex>& lock) {
  Peer* given_up = nullptr;
  for (Peer& peer : peers) {
    if (peer.ended || (peer.at != At::idle && peer.at != At::reading)) continue;
    if (given_up == nullptr || std::tie(peer.at, peer.deadline) < std::tie(given_up->at, given_up->deadline))
      given_up = &peer;
  }
  if (given_up == nullptr) return false;
  shutdown(given_up->socket, SHUT_RDWR);
  changed.wait(lock, [&] { return given_up->ended; });
  forget_ended();
  return true;
}

// What the peer is at from now on, for so long.
void HttpServer::Impl::enter(Peer& peer, At at, int ms) {
  const std::scoped_lock lock(mutex);
  peer.at = at;
  peer.deadline = Clock::now() + std::chrono::milliseconds(ms);
  if (stopping && at != At::answering) shutdown(peer.socket, SHUT_RDWR);
}

void HttpServer::Impl::serve(Peer& peer) {
  HttpReader reader(options.most_body_bytes, [&](std::string& unread) { receive(peer, unread); });
  const auto serves = [&] {
    try {
      return serve_one(peer, reader);
    } catch (const HttpRefusal& refusal) {
      return refusal.status != 0 &&
             respond(peer, {refusal.status, "text/plain", refusal.complaint + "\n"}, false, !reader.is_head());
    }
  };
  while (serves()) enter(peer, At::idle, options.head_ms);
  const std::scoped_lock lock(mutex);
  close(peer.socket);
  peer.ended = true;
  changed.notify_all();
}

// Waits for bytes until the peer's deadline.
void HttpServer::Impl::receive(Peer& peer, std::string& unread) {
  if (peer.at == At::idle && !unread.empty()) enter(peer, At::reading, options.head_ms);
  std::array<char, kReadAtOnce> piece;
  ssize_t got = -1;
  while (got < 0) {
    if (Clock::now() > peer.deadline || !wait_for(peer.socket, POLLIN, peer.deadline))
      throw HttpRefusal{peer.at == At::reading ? 408 : 0, "the request took too long"};
    got = recv(peer.socket, piece.data(), piece.size(), MSG_DONTWAIT);
    if (got == 0 || (got < 0 && errno != EAGAIN && errno != EINTR)) throw HttpRefusal{};
  }
  unread.append(piece.data(), static_cast<std::size_t>(got));
}

// Whether the connection serves another request.
bool HttpServer::Impl::serve_one(Peer& peer, HttpReader& reader) {
  HttpRequest request = reader.read_head();
  const bool with_body = !reader.is_head();
  if (std::optional<HttpResponse> refusal = handler.refuse(request))
    return respond(peer, std::move(*refusal), reader.keeps(), with_body);
  enter(peer, At::reading, options.body_ms);
  constexpr std::string_view kContinue = "HTTP/1.1 100 Continue\r\n\r\n";
  if (reader.expects_continue())
    (void)!::send(peer.socket, kContinue.data(), kContinue.size(), MSG_NOSIGNAL | MSG_DONTWAIT);
  reader.read_body(request);
  enter(peer, At::answering, 0);
  request.gone = [socket = peer.socket] { return wait_for(socket, POLLRDHUP, {}); };
  if (request.abandoned()) return false;
  {
    std::unique_lock lock(mutex);
    changed.wait(lock, [&] { return answering < options.responses; });
    ++answering;
  }
  std::optional<HttpResponse> response;
  if (!request.abandoned()) response = handler.answer(request);
  {
    const std::scoped_lock lock(mutex);
    --answering;
    changed.notify_all();
  }
  return response && respond(peer, std::move(*response), reader.keeps() && !stopping, with_body);
}

// Sends it; whether the connection serves another request. A file that cannot be read makes the response 404.
bool HttpServer::Impl::respond(Peer& peer, HttpResponse response, bool keep, bool with_body) {
  enter(peer, At::answering, 0);
  std::unique_ptr<std::FILE, int (*)(std::FILE*)> file(nullptr, std::fclose);
  if (!response.file.empty()) {
    file.reset(std::fopen(response.file.c_str(), "rbe"));
    if (file == nullptr || std::fseek(file.get(), 0, SEEK_END) != 0) {
      response = {404, "text/plain", "the file is gone\n"};
      file.reset();
    }
  }
  const std::size_t bytes = file ? static_cast<std::size_t>(std::ftell(file.get())) : response.body.size();
  const Clock::time_point end = Clock::now() + kGrace +
                                std::chrono::duration_cast<Clock::duration>(
                                    std::chrono::duration<double>(static_cast<double>(bytes) / kLeastBytesPerSecond));
  if (!send_all(peer.socket, head_text(response, bytes, keep) + (with_body && !file ? response.body : ""),
                options.head_ms, end))
    return false;
  if (file) std::rewind(file.get());
  std::string piece(file && with_body ? std::min(bytes, kReadAtOnce) : 0, '\0');
  for (std::size_t left = file && with_body ? bytes : 0; left > 0; left -= piece.size()) {
    piece.resize(std::min(left, piece.size()));
    if (std::fread(piece.data(), 1, piece.size(), file.get()) != piece.size()) return false;
    if (!send_all(peer.socket, piece, options.head_ms, end)) return false;
  }
  if (keep) return true;
  // Closed at once, what the client still sends would make the system drop the response.
  shutdown(peer.socket, SHUT_WR);
  enter(peer, At::closing, kLinger_ms);
  std::array<char, 4096> dropped;
  while (Clock::now() < peer.deadline && wait_for(peer.socket, POLLIN, peer.deadline) &&
         recv(peer.socket, dropped.data(), dropped.size(), 0) > 0) {
  }
  return false;
}

HttpServer::HttpServer(const HttpOptions& options, HttpHandler handler)
    : impl_(std::make_unique<Impl>(options, std::move(handler))) {}

HttpServer::~HttpServer() = default;

}  // namespace semfield::app
