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
#include <charconv>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <list>
#include <mutex>
#include <system_error>
#include <thread>

#include "core/error.h"
#include "core/text.h"

namespace semfield::app {

int listen_on(HttpOptions& options) {
  const std::string& address = options.address;
  const int port = options.port, last = options.next_port ? port + 99 : port;
  sockaddr_in at{};
  at.sin_family = AF_INET;
  if (inet_pton(AF_INET, address.c_str(), &at.sin_addr) != 1)
    throw Error(ErrorKind::usage, "serve.address.invalid",
                "--address " + address + ": expected an IPv4 address in numbers",
                "give 127.0.0.1 for this machine alone, or 0.0.0.0 for every network that it is in");
  int cause = 0;
  for (int next = port; next <= std::min(last, 65535); ++next) {
    const int listener = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0), yes = 1;
    auto* const place = reinterpret_cast<sockaddr*>(&at);
    socklen_t size = sizeof at;
    at.sin_port = htons(static_cast<std::uint16_t>(next));
    if (listener >= 0 && setsockopt(listener, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes) == 0 &&
        bind(listener, place, size) == 0 && listen(listener, SOMAXCONN) == 0 &&
        getsockname(listener, place, &size) == 0) {
      options.port = ntohs(at.sin_port);
      return listener;
    }
    cause = errno;
    if (listener >= 0) close(listener);
    if (cause != EADDRINUSE) break;
  }
  const std::string place = address + ":" + std::to_string(port);
  if (cause == EADDRINUSE)
    throw Error(
        ErrorKind::unavailable, "serve.port.taken",
        last > port
            ? "the ports " + std::to_string(port) + " to " + std::to_string(last) + " of " + address + " are all in use"
            : "port " + std::to_string(port) + " of " + address + " is in use by another program",
        last > port ? "name a free one with --port N" : "end that program, name another port, or leave --port out");
  if (cause == EADDRNOTAVAIL)
    throw Error(ErrorKind::unavailable, "serve.address.foreign", "this machine has no address " + address,
                "see `ip address` for those that it has, or leave --address out");
  if (cause == EACCES)
    throw Error(ErrorKind::unavailable, "serve.port.privileged",
                "port " + std::to_string(port) + " may not be used by this user",
                "ports below 1024 belong to root: name a higher one with --port N");
  throw Error(ErrorKind::unavailable, "serve.port.failed", "cannot listen on " + place + ": " + std::strerror(cause),
              "try another --port, or see what limits this process: ulimit -n");
}

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

namespace {

constexpr std::size_t kMostHeadBytes = 16384;
constexpr std::string_view kLineEnd = "\r\n";

// The characters of a method or a header's name.
bool is_token(std::string_view text) {
  return !text.empty() && std::all_of(text.begin(), text.end(), [](char c) {
    return is_alnum(c) || std::string_view("!#$%&'*+-.^_`|~").find(c) != std::string_view::npos;
  });
}

bool is_visible(char c) { return static_cast<unsigned char>(c) > 0x20 && c != 0x7F; }
bool is_text(char c) { return is_visible(c) || c == ' ' || c == '\t'; }

std::string_view trimmed(std::string_view text) {
  while (!text.empty() && (text.front() == ' ' || text.front() == '\t')) text.remove_prefix(1);
  while (!text.empty() && (text.back() == ' ' || text.back() == '\t')) text.remove_suffix(1);
  return text;
}

[[noreturn]] void refuse(int status, const char* complaint) { throw HttpRefusal{status, complaint}; }

HttpRequest parsed_head(std::string_view head) {
  const auto line = [&] {
    const std::string_view text = head.substr(0, head.find(kLineEnd));
    head.remove_prefix(text.size() + kLineEnd.size());
    return text;
  };
  const std::string_view first = line();
  const std::size_t method = first.find(' '), version = first.rfind(' ');
  if (method == std::string_view::npos || version == method) refuse(400, "the request has no address");
  const std::string_view target = first.substr(method + 1, version - method - 1), http = first.substr(version + 1);
  if (!is_token(first.substr(0, method)) || target.empty() || !std::all_of(target.begin(), target.end(), is_visible))
    refuse(400, "the first line of the request cannot be read");
  if (http != "HTTP/1.1" && http != "HTTP/1.0") refuse(400, "the request is not of HTTP/1.1");
  HttpRequest request;
  request.method = first.substr(0, method);
  request.path = target.substr(0, target.find('?'));
  if (request.path.size() < target.size()) request.query = target.substr(request.path.size() + 1);
  while (!head.empty()) {
    const std::string_view text = line();
    const std::size_t colon = text.find(':');
    if (colon == std::string_view::npos || !is_token(text.substr(0, colon)) ||
        !std::all_of(text.begin(), text.end(), is_text))
      refuse(400, "a header of the request cannot be read");
    request.headers.emplace_back(lower_case(std::string(text.substr(0, colon))), trimmed(text.substr(colon + 1)));
  }
  return request;
}

std::size_t body_length(const HttpRequest& head, std::size_t most_bytes) {
  const auto lengths = head.header_count("content-length"), codings = head.header_count("transfer-encoding");
  if (lengths + codings > 1) refuse(400, "the request has two lengths");
  if (codings > 0) refuse(411, "a body needs its length: Content-Length");
  if (lengths == 0) return 0;
  const std::string text = *head.header("content-length");
  if (text.empty() || text.find_first_not_of("0123456789") != std::string::npos)
    refuse(400, "Content-Length is not a number of bytes");
  std::size_t length = 0;
  const auto [end, cause] = std::from_chars(text.data(), text.data() + text.size(), length);
  if (cause != std::errc() || length > most_bytes) refuse(413, "the body is too large");
  return length;
}

}  // namespace

HttpRequest HttpReader::read_head() {
  std::size_t end = std::string::npos;
  for (;;) {
    end = unread_.find("\r\n\r\n");
    const std::size_t bare = unread_.find("\n\n"), ends = std::min(end, bare);
    if (ends == std::string::npos ? unread_.size() > kMostHeadBytes + 3 : ends > kMostHeadBytes)
      refuse(400, "the head of the request is too long");
    if (bare < end) refuse(400, "a line of the head does not end as lines of HTTP do");
    if (end != std::string::npos) break;
    more_(unread_);
  }
  const HttpRequest request = parsed_head(std::string_view(unread_).substr(0, end + kLineEnd.size()));
  unread_.erase(0, end + 2 * kLineEnd.size());
  length_ = body_length(request, most_body_bytes_);
  return request;
}

void HttpReader::read_body(HttpRequest& request) {
  while (unread_.size() < length_) more_(unread_);
  request.body = unread_.substr(0, length_);
}

namespace {

using Clock = std::chrono::steady_clock;

constexpr std::size_t kReadAtOnce = std::size_t{64} << 10;
constexpr double kLeastBytesPerSecond = 20e3;
constexpr auto kGrace = std::chrono::seconds(20);
constexpr std::chrono::milliseconds kFarewell{1000};
constexpr int kLinger_ms = 2000;  // for what a client still sends behind its request

// Without a reason phrase, which nobody reads [RFC9112, Sec. 4].
std::string head_text(const HttpResponse& response, std::size_t bytes) {
  std::string head = fmt::format(
      "HTTP/1.1 {} \r\nContent-Type: {}\r\nContent-Length: {}\r\nCache-Control: {}\r\nConnection: close\r\n"
      "Referrer-Policy: no-referrer\r\nX-Content-Type-Options: nosniff\r\nX-Frame-Options: DENY\r\n"
      "Cross-Origin-Resource-Policy: same-origin\r\n"
      "Content-Security-Policy: default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'; base-uri "
      "'none'; form-action 'none'\r\n",
      response.status, response.type, bytes, response.cache);
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
  enum class At { reading, answering, closing };

  // A connection and its thread: a request is read, its response made and sent.
  struct Peer {
    Peer(int s, Clock::time_point until) : socket(s), deadline(until) {}

    const int socket;
    At at = At::reading;  // with these two under the server's lock; the thread alone changes them
    Clock::time_point deadline;
    bool ended = false;  // the socket is closed
    bool says = false;   // some of the request has come; the thread alone looks
    std::thread thread{};
  };

  Impl(const HttpOptions& o, int l, HttpHandler h) : options(o), handler(std::move(h)), listener(l) {
    try {
      acceptor = std::thread([this] { accept_all(); });
    } catch (const std::system_error& e) {
      close(listener);
      throw Error(ErrorKind::unavailable, "serve.port.failed",
                  fmt::format("the HTTP server cannot start on {}:{}: {}", options.address, options.port, e.what()),
                  "see what limits this process: ulimit -u");
    }
  }
  ~Impl();

  void accept_all();
  bool give_up_one(std::unique_lock<std::mutex>& lock);
  void forget_ended();
  void enter(Peer& peer, At at, int ms);
  void serve(Peer& peer);
  void serve_one(Peer& peer);
  void receive(Peer& peer, std::string& unread);
  void respond(Peer& peer, HttpResponse response, bool with_body = true);

  const HttpOptions options;
  const HttpHandler handler;
  const int listener;
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

// Closes the connection that has been waited for the longest; false: every one is answered.
bool HttpServer::Impl::give_up_one(std::unique_lock<std::mutex>& lock) {
  Peer* given_up = nullptr;
  for (Peer& peer : peers) {
    if (peer.ended || peer.at == At::answering) continue;
    if (given_up == nullptr || peer.deadline < given_up->deadline) given_up = &peer;
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
  try {
    serve_one(peer);
  } catch (const HttpRefusal& refusal) {
    if (refusal.status != 0) respond(peer, {refusal.status, "text/plain", refusal.complaint + "\n"});
  }
  const std::scoped_lock lock(mutex);
  close(peer.socket);
  peer.ended = true;
  changed.notify_all();
}

// Waits for bytes until the peer's deadline.
void HttpServer::Impl::receive(Peer& peer, std::string& unread) {
  std::array<char, kReadAtOnce> piece;
  ssize_t got = -1;
  while (got < 0) {
    if (Clock::now() > peer.deadline || !wait_for(peer.socket, POLLIN, peer.deadline))
      throw HttpRefusal{peer.says ? 408 : 0, "the request took too long"};
    got = recv(peer.socket, piece.data(), piece.size(), MSG_DONTWAIT);
    if (got == 0 || (got < 0 && errno != EAGAIN && errno != EINTR)) throw HttpRefusal{};
  }
  peer.says = true;
  unread.append(piece.data(), static_cast<std::size_t>(got));
}

void HttpServer::Impl::serve_one(Peer& peer) {
  HttpReader reader(options.most_body_bytes, [&](std::string& unread) { receive(peer, unread); });
  HttpRequest request = reader.read_head();
  const bool with_body = request.method != "HEAD";
  if (std::optional<HttpResponse> refusal = handler.refuse(request))
    return respond(peer, std::move(*refusal), with_body);
  enter(peer, At::reading, options.body_ms);
  reader.read_body(request);
  enter(peer, At::answering, 0);
  request.gone = [socket = peer.socket] { return wait_for(socket, POLLRDHUP, {}); };
  if (request.abandoned()) return;
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
  if (response) respond(peer, std::move(*response), with_body);
}

// A file that cannot be read makes the response 404.
void HttpServer::Impl::respond(Peer& peer, HttpResponse response, bool with_body) {
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
  if (!send_all(peer.socket, head_text(response, bytes) + (with_body && !file ? response.body : ""), options.head_ms,
                end))
    return;
  if (file) std::rewind(file.get());
  std::string piece(file && with_body ? std::min(bytes, kReadAtOnce) : 0, '\0');
  for (std::size_t left = file && with_body ? bytes : 0; left > 0; left -= piece.size()) {
    piece.resize(std::min(left, piece.size()));
    if (std::fread(piece.data(), 1, piece.size(), file.get()) != piece.size()) return;
    if (!send_all(peer.socket, piece, options.head_ms, end)) return;
  }
  // Closed at once, what the client still sends would make the system drop the response.
  shutdown(peer.socket, SHUT_WR);
  enter(peer, At::closing, kLinger_ms);
  std::array<char, 4096> dropped;
  while (Clock::now() < peer.deadline && wait_for(peer.socket, POLLIN, peer.deadline) &&
         recv(peer.socket, dropped.data(), dropped.size(), 0) > 0) {
  }
}

HttpServer::HttpServer(const HttpOptions& options, int listener, HttpHandler handler)
    : impl_(std::make_unique<Impl>(options, listener, std::move(handler))) {}

HttpServer::~HttpServer() = default;

}  // namespace semfield::app
