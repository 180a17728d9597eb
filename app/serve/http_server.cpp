#include "app/serve/http_server.h"

#include <arpa/inet.h>
#include <fmt/format.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cerrno>
#include <charconv>
#include <chrono>
#include <condition_variable>
#include <cstdio>
#include <cstring>
#include <deque>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <string_view>
#include <system_error>
#include <thread>
#include <utility>
#include <vector>

#include "core/error.h"

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

// Which port the server may take, checked with the system before the server starts, so that a refusal has its cause.

namespace {

// 0, or errno of what refused. `port` 0 becomes the one that the system gave.
int try_port(const in_addr& address, int& port) {
  const int probe = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
  if (probe < 0) return errno;
  sockaddr_in place{};
  place.sin_family = AF_INET;
  place.sin_addr = address;
  place.sin_port = htons(static_cast<std::uint16_t>(port));
  const int yes = 1;
  setsockopt(probe, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes);
  socklen_t size = sizeof place;
  int cause = 0;
  if (bind(probe, reinterpret_cast<const sockaddr*>(&place), sizeof place) != 0 || listen(probe, 1) != 0 ||
      getsockname(probe, reinterpret_cast<sockaddr*>(&place), &size) != 0)
    cause = errno;
  else
    port = ntohs(place.sin_port);
  close(probe);
  return cause;
}

}  // namespace

int free_port(const std::string& address, int port, bool next) {
  in_addr number{};
  if (inet_pton(AF_INET, address.c_str(), &number) != 1)
    throw Error(ErrorKind::usage, "serve.address.invalid",
                "--address " + address + ": expected an IPv4 address in numbers",
                "give 127.0.0.1 for this machine alone, or 0.0.0.0 for every network that it is in");
  const int last = next ? port + 99 : port;
  int cause = 0;
  for (int at = port; at <= last && at <= 65535; ++at) {
    int got = at;
    cause = try_port(number, got);
    if (cause == 0) return got;
    if (cause != EADDRINUSE) break;
  }
  const std::string place = address + ":" + std::to_string(port);
  if (cause == EADDRINUSE)
    throw Error(
        ErrorKind::unavailable, "serve.port.taken",
        next ? "the ports " + std::to_string(port) + " to " + std::to_string(last) + " of " + address + " are all taken"
             : "port " + std::to_string(port) + " of " + address + " is taken by another program",
        next ? "name a free one with --port N" : "end that program, name another port, or leave --port out");
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

namespace {

constexpr std::size_t kMostHeadBytes = 16384;
constexpr std::size_t kMostChunkLine = 16;  // hexadecimal digits; extensions are refused
constexpr std::string_view kLineEnd = "\r\n";

char small(char c) { return c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c; }

std::string small_letters(std::string_view text) {
  std::string out(text);
  std::transform(out.begin(), out.end(), out.begin(), small);
  return out;
}

// The characters of a method or a header's name.
bool is_token(std::string_view text) {
  return !text.empty() && std::all_of(text.begin(), text.end(), [](char c) {
    const char l = small(c);
    return (l >= 'a' && l <= 'z') || (c >= '0' && c <= '9') ||
           std::string_view("!#$%&'*+-.^_`|~").find(c) != std::string_view::npos;
  });
}

bool is_visible(char c) { return static_cast<unsigned char>(c) > 0x20 && c != 0x7F; }
bool is_text(char c) { return is_visible(c) || c == ' ' || c == '\t'; }

std::string_view trimmed(std::string_view text) {
  while (!text.empty() && (text.front() == ' ' || text.front() == '\t')) text.remove_prefix(1);
  while (!text.empty() && (text.back() == ' ' || text.back() == '\t')) text.remove_suffix(1);
  return text;
}

bool has_word(std::string_view list, std::string_view word) {
  while (!list.empty()) {
    const std::string_view item = list.substr(0, list.find(','));
    list.remove_prefix(std::min(list.size(), item.size() + 1));
    if (small_letters(trimmed(item)) == word) return true;
  }
  return false;
}

}  // namespace

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

HttpReader::State HttpReader::refuse(int status, const char* complaint) {
  status_ = status;
  complaint_ = complaint;
  pending_.clear();
  return state_ = State::refused;
}

// Whether what ends at `end` (npos: not yet) with so many bytes is longer than `most`, however its bytes are cut.
bool HttpReader::is_above(std::size_t most, std::size_t end, std::size_t ending) const {
  return end == std::string::npos ? pending_.size() > most + ending - 1 : end > most;
}

HttpReader::State HttpReader::take(std::string_view bytes) {
  if (state_ == State::refused) return state_;
  pending_ += bytes;
  return read();
}

void HttpReader::next() {
  request_ = {};
  state_ = State::head;
  keeps_ = true;
  expects_continue_ = chunked_ = in_chunk_ = false;
  left_ = 0;
  (void)read();
}

HttpReader::State HttpReader::read() {
  if (state_ == State::head) {
    while (pending_.starts_with(kLineEnd)) pending_.erase(0, kLineEnd.size());  // between requests
    const std::size_t end = pending_.find("\r\n\r\n"), bare = pending_.find("\n\n");
    if (is_above(kMostHeadBytes, std::min(end, bare), 4)) return refuse(400, "the head of the request is too long");
    if (bare < end) return refuse(400, "a line of the head does not end as lines of HTTP do");
    if (end == std::string::npos) return state_;
    read_head(end);
  }
  return state_ == State::body ? read_body() : state_;
}

HttpReader::State HttpReader::read_head(std::size_t end) {
  const std::string head = pending_.substr(0, end + kLineEnd.size());
  pending_.erase(0, end + 2 * kLineEnd.size());
  std::string_view rest = head;
  const auto line = [&] {
    const std::string_view text = rest.substr(0, rest.find(kLineEnd));
    rest.remove_prefix(text.size() + kLineEnd.size());
    return text;
  };
  const std::string_view first = line();
  const std::size_t method = first.find(' '), version = first.rfind(' ');
  if (method == std::string_view::npos || version == method) return refuse(400, "the request has no address");
  const std::string_view target = first.substr(method + 1, version - method - 1), http = first.substr(version + 1);
  if (!is_token(first.substr(0, method)) || target.empty() || !std::all_of(target.begin(), target.end(), is_visible))
    return refuse(400, "the first line of the request cannot be read");
  if (http != "HTTP/1.1" && http != "HTTP/1.0") return refuse(400, "the request is not of HTTP/1.1");
  keeps_ = http == "HTTP/1.1";
  request_.method = first.substr(0, method);
  request_.path = target.substr(0, target.find('?'));
  if (request_.path.size() < target.size()) request_.query = target.substr(request_.path.size() + 1);
  while (!rest.empty()) {
    const std::string_view text = line();
    const std::size_t colon = text.find(':');
    if (colon == std::string_view::npos || !is_token(text.substr(0, colon)) ||
        !std::all_of(text.begin(), text.end(), is_text))
      return refuse(400, "a header of the request cannot be read");
    request_.headers.emplace_back(small_letters(text.substr(0, colon)), trimmed(text.substr(colon + 1)));
  }
  return read_framing();
}

HttpReader::State HttpReader::read_framing() {
  const auto lengths = request_.header_count("content-length"), codings = request_.header_count("transfer-encoding");
  if (lengths + codings > 1) return refuse(400, "the request has two lengths");
  for (const auto& [name, value] : request_.headers)
    if (name == "connection" && has_word(value, "close")) keeps_ = false;
  expects_continue_ = small_letters(request_.header("expect").value_or("")) == "100-continue";
  state_ = State::body;
  if (codings > 0) {
    if (small_letters(*request_.header("transfer-encoding")) != "chunked")
      return refuse(400, "the body is encoded in another way than in chunks");
    chunked_ = true;
    return state_;
  }
  return lengths > 0 ? read_length(*request_.header("content-length")) : state_;
}

HttpReader::State HttpReader::read_length(const std::string& text) {
  if (text.empty() || text.find_first_not_of("0123456789") != std::string::npos)
    return refuse(400, "Content-Length is not a number of bytes");
  const auto [end, cause] = std::from_chars(text.data(), text.data() + text.size(), left_);
  if (cause != std::errc() || left_ > most_body_bytes_) return refuse(413, "the body is too large");
  return state_;
}

HttpReader::State HttpReader::read_body() {
  if (chunked_) return read_chunks();
  const std::size_t now = std::min(left_, pending_.size());
  request_.body.append(pending_, 0, now);
  pending_.erase(0, now);
  left_ -= now;
  if (left_ == 0) state_ = State::whole;
  return state_;
}

HttpReader::State HttpReader::read_chunks() {
  for (;;) {
    if (in_chunk_) {
      const std::size_t now = std::min(left_, pending_.size());
      request_.body.append(pending_, 0, now);
      pending_.erase(0, now);
      left_ -= now;
      if (left_ > 0 || pending_.size() < kLineEnd.size()) return state_;
      if (!pending_.starts_with(kLineEnd)) return refuse(400, "a chunk of the body has another length than it says");
      pending_.erase(0, kLineEnd.size());
      in_chunk_ = false;
    }
    const std::size_t end = pending_.find(kLineEnd);
    if (is_above(kMostChunkLine, end, kLineEnd.size())) return refuse(400, "a chunk's length cannot be read");
    if (end == std::string::npos) return state_;
    const auto [digits, cause] = std::from_chars(pending_.data(), pending_.data() + end, left_, 16);
    if (end == 0 || cause != std::errc() || digits != pending_.data() + end)
      return refuse(400, "a chunk's length cannot be read");
    if (left_ > most_body_bytes_ - request_.body.size()) return refuse(413, "the body is too large");
    if (left_ == 0) {  // the last one; headers behind it are refused
      if (pending_.size() < end + 2 * kLineEnd.size()) return state_;
      if (pending_.compare(end, 2 * kLineEnd.size(), "\r\n\r\n") != 0) return refuse(400, "headers follow the body");
      pending_.erase(0, end + 2 * kLineEnd.size());
      return state_ = State::whole;
    }
    pending_.erase(0, end + kLineEnd.size());
    in_chunk_ = true;
  }
}

namespace {

using Clock = std::chrono::steady_clock;

constexpr std::size_t kReadAtOnce = std::size_t{64} << 10;
constexpr double kLeastBytesPerSecond = 20e3;
constexpr auto kGrace = std::chrono::seconds(20);

const char* reason(int status) {
  static const std::map<int, const char*> reasons{{200, "OK"},
                                                  {308, "Permanent Redirect"},
                                                  {400, "Bad Request"},
                                                  {403, "Forbidden"},
                                                  {404, "Not Found"},
                                                  {405, "Method Not Allowed"},
                                                  {408, "Request Timeout"},
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

}  // namespace

HttpReply::HttpReply(HttpResponse response, bool keep, bool body) : keep_(keep) {
  std::size_t bytes = response.body.size();
  if (!response.file.empty()) {
    file_.reset(std::fopen(response.file.c_str(), "rbe"));
    if (file_ == nullptr || std::fseek(file_.get(), 0, SEEK_END) != 0) {
      response = {404, "text/plain", "the file is gone\n"};
      file_.reset();
      bytes = response.body.size();
    } else {
      bytes = left_ = static_cast<std::size_t>(std::ftell(file_.get()));
      std::rewind(file_.get());
    }
  }
  end_ = Clock::now() + kGrace +
         std::chrono::duration_cast<Clock::duration>(
             std::chrono::duration<double>(static_cast<double>(bytes) / kLeastBytesPerSecond));
  bytes_ = head_text(response, bytes, keep);
  if (!body) {
    left_ = 0;
  } else if (file_ == nullptr) {
    bytes_ += response.body;
  }
}

std::string_view HttpReply::piece() {
  if (at_ == bytes_.size() && left_ > 0) {
    at_ = 0;
    bytes_.resize(std::min(left_, kReadAtOnce));
    bytes_.resize(std::fread(bytes_.data(), 1, bytes_.size(), file_.get()));
    left_ -= bytes_.size();
  }
  return std::string_view(bytes_).substr(at_);
}

namespace {

using std::chrono::milliseconds;

constexpr milliseconds kFarewell{1000};
constexpr milliseconds kLinger{2000};  // for what a client still sends behind the request that ends its connection
constexpr milliseconds kTurn{500};     // at most between looks at the times

}  // namespace

struct HttpServer::Impl {
  class Descriptor {
   public:
    explicit Descriptor(int number) : number_(number) {}
    Descriptor(Descriptor&& other) noexcept : number_(std::exchange(other.number_, -1)) {}
    Descriptor& operator=(Descriptor&& other) noexcept {
      std::swap(number_, other.number_);
      return *this;
    }
    ~Descriptor() { close(); }
    void close() {
      if (number_ >= 0) ::close(number_);
      number_ = -1;
    }
    int get() const { return number_; }

   private:
    int number_;
  };

  // A connection, and what it is at: a request is read and its response made and sent, then the next one; or the
  // connection closes.
  struct Peer {
    enum class At { reading, answering, sending, closing };

    Peer(Descriptor d, std::size_t most_body_bytes, Clock::time_point until)
        : socket(std::move(d)), reader(most_body_bytes), deadline(until) {}

    Descriptor socket;
    HttpReader reader;
    At at = At::reading;
    bool begun = false, admitted = false;  // the head's first byte is here; all of it, and it was not refused
    Clock::time_point deadline;
    std::shared_ptr<std::atomic<bool>> gone;  // reported to whoever makes the response
    std::optional<HttpReply> reply;

    bool idle() const { return at == At::reading && !begun; }
  };

  Impl(const HttpOptions& o, HttpHandler& h)
      : options(o), handler(h), listener(listening_on(o)), waker(eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK)) {
    try {
      for (int i = 0; i < options.threads; ++i) workers.emplace_back([this] { make_answers(); });
      loop = std::thread([this] { watch(); });
    } catch (const std::system_error& e) {
      end_workers();
      throw cannot_start(options, e.what());
    }
  }
  ~Impl() {
    stopping = true;
    wake();
    loop.join();
    end_workers();
  }
  Impl(const Impl&) = delete;
  Impl& operator=(const Impl&) = delete;

  struct Job {
    std::uint64_t peer;
    HttpRequest request;
  };
  struct Made {
    std::uint64_t peer;
    HttpResponse response;
  };

  static Descriptor listening_on(const HttpOptions& options);
  static Error cannot_start(const HttpOptions& options, const std::string& cause);
  void end_workers();
  void wake() const {
    const std::uint64_t one = 1;
    (void)!write(waker.get(), &one, sizeof one);
  }
  void make_answers();
  void watch();
  void take_made();
  void accept_all();
  void serve(std::uint64_t number, Peer& peer, short events);
  void receive(Peer& peer);
  void advance(std::uint64_t number, Peer& peer);
  void reply(Peer& peer, HttpResponse response, bool keep);
  void send(Peer& peer);
  void time_out(Peer& peer);
  Clock::time_point in(int ms) const { return Clock::now() + milliseconds(ms); }

  HttpOptions options;
  HttpHandler& handler;
  Descriptor listener, waker;
  std::map<std::uint64_t, Peer> peers;  // of the loop
  std::uint64_t next_peer = 0;
  std::atomic<bool> stopping{false};

  std::mutex mutex;  // of these four
  std::condition_variable wanted;
  std::deque<Job> waiting;
  std::vector<Made> made;
  bool ended = false;

  std::vector<std::thread> workers;
  std::thread loop;
};

Error HttpServer::Impl::cannot_start(const HttpOptions& options, const std::string& cause) {
  return {ErrorKind::unavailable, "serve.port.failed",
          fmt::format("the HTTP server cannot start on {}:{}: {}", options.address, options.port, cause),
          "name another --port, or see what limits this process: ulimit -n -u"};
}

HttpServer::Impl::Descriptor HttpServer::Impl::listening_on(const HttpOptions& options) {
  Descriptor listener(socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0));
  sockaddr_in place{};
  place.sin_family = AF_INET;
  place.sin_port = htons(static_cast<std::uint16_t>(options.port));
  inet_pton(AF_INET, options.address.c_str(), &place.sin_addr);
  const int yes = 1;
  setsockopt(listener.get(), SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes);
  if (listener.get() < 0 || bind(listener.get(), reinterpret_cast<const sockaddr*>(&place), sizeof place) != 0 ||
      listen(listener.get(), SOMAXCONN) != 0)
    throw cannot_start(options, std::strerror(errno));
  return listener;
}

void HttpServer::Impl::end_workers() {
  {
    const std::scoped_lock lock(mutex);
    waiting.clear();
    ended = true;
  }
  wanted.notify_all();
  for (std::thread& worker : workers) worker.join();
}

void HttpServer::Impl::make_answers() {
  std::unique_lock lock(mutex);
  for (;;) {
    wanted.wait(lock, [&] { return ended || !waiting.empty(); });
    if (waiting.empty()) return;
    const Job job = std::move(waiting.front());
    waiting.pop_front();
    lock.unlock();
    HttpResponse response = job.request.abandoned() ? HttpResponse{} : handler.answer(job.request);
    lock.lock();
    made.push_back({job.peer, std::move(response)});
    wake();
  }
}

void HttpServer::Impl::watch() {
  std::vector<pollfd> polled;
  std::vector<std::uint64_t> numbers;
  for (Clock::time_point farewell = Clock::time_point::max();;) {
    if (stopping) {
      farewell = std::min(farewell, Clock::now() + kFarewell);
      listener.close();
      std::erase_if(peers,
                    [](const auto& p) { return p.second.at == Peer::At::reading || p.second.at == Peer::At::closing; });
      if (peers.empty() || Clock::now() > farewell) {
        for (auto& [number, peer] : peers)
          if (peer.gone != nullptr) *peer.gone = true;
        return peers.clear();
      }
    }
    polled = {{waker.get(), POLLIN, 0}, {listener.get(), POLLIN, 0}};
    numbers.clear();
    Clock::time_point soonest = std::min(Clock::now() + kTurn, farewell);
    for (auto& [number, peer] : peers) {
      short events = POLLIN;
      if (peer.at == Peer::At::answering) events = POLLRDHUP;
      if (peer.at == Peer::At::sending) events = POLLOUT;
      const bool deaf = peer.at == Peer::At::answering && *peer.gone;  // it would be reported again and again
      polled.push_back({deaf ? -1 : peer.socket.get(), events, 0});
      numbers.push_back(number);
      if (peer.at != Peer::At::answering) soonest = std::min(soonest, peer.deadline);
      if (peer.at == Peer::At::reading && peer.reader.state() != HttpReader::State::head && !peer.admitted)
        soonest = Clock::now();  // it was sent together with the one before
    }
    const auto left = std::chrono::ceil<milliseconds>(soonest - Clock::now());
    if (poll(polled.data(), polled.size(), static_cast<int>(std::max<std::int64_t>(0, left.count()))) < 0) continue;
    std::uint64_t count = 0;
    if (polled[0].revents != 0) (void)!read(waker.get(), &count, sizeof count);
    take_made();
    for (std::size_t i = 0; i < numbers.size(); ++i) {
      const auto found = peers.find(numbers[i]);
      serve(found->first, found->second, polled[i + 2].revents);
      if (found->second.socket.get() < 0) peers.erase(found);
    }
    if (polled[1].revents != 0) accept_all();
  }
}

void HttpServer::Impl::take_made() {
  std::vector<Made> now;
  {
    const std::scoped_lock lock(mutex);
    now.swap(made);
  }
  for (Made& one : now) {
    const auto peer = peers.find(one.peer);
    if (peer == peers.end()) continue;
    reply(peer->second, std::move(one.response), peer->second.reader.keeps() && !stopping);
  }
}

void HttpServer::Impl::accept_all() {
  for (;;) {
    Descriptor fresh(accept4(listener.get(), nullptr, nullptr, SOCK_CLOEXEC | SOCK_NONBLOCK));
    const bool none_left = fresh.get() < 0 && (errno == EMFILE || errno == ENFILE);
    if (fresh.get() < 0 && !none_left) return;
    if (none_left || peers.size() >= options.connections) {
      // The one that says nothing for the longest, or else that has not said all.
      auto given_up = peers.end();
      for (auto peer = peers.begin(); peer != peers.end(); ++peer) {
        if (peer->second.at != Peer::At::reading) continue;
        if (given_up == peers.end() || (peer->second.idle() && !given_up->second.idle()) ||
            (peer->second.idle() == given_up->second.idle() && peer->second.deadline < given_up->second.deadline))
          given_up = peer;
      }
      if (given_up == peers.end()) {
        if (none_left) return;
        continue;  // refused
      }
      peers.erase(given_up);
      if (none_left) continue;
    }
    const int yes = 1;
    setsockopt(fresh.get(), IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
    peers.try_emplace(++next_peer, std::move(fresh), options.most_body_bytes, in(options.head_ms));
  }
}

void HttpServer::Impl::serve(std::uint64_t number, Peer& peer, short events) {
  switch (peer.at) {
    case Peer::At::reading:
      if (events != 0) receive(peer);
      if (peer.socket.get() >= 0) advance(number, peer);
      break;
    case Peer::At::answering:
      if (events != 0) *peer.gone = true;
      return;
    case Peer::At::sending:
      if (events != 0) send(peer);
      break;
    case Peer::At::closing:
      if (events != 0) receive(peer);
  }
  if (peer.socket.get() >= 0 && peer.at != Peer::At::answering && Clock::now() > peer.deadline) time_out(peer);
}

void HttpServer::Impl::receive(Peer& peer) {
  std::array<char, kReadAtOnce> piece;
  const ssize_t got = recv(peer.socket.get(), piece.data(), piece.size(), 0);
  if (got == 0 || (got < 0 && errno != EAGAIN && errno != EINTR)) return peer.socket.close();
  if (got > 0 && peer.at == Peer::At::reading) peer.reader.take({piece.data(), static_cast<std::size_t>(got)});
}

void HttpServer::Impl::advance(std::uint64_t number, Peer& peer) {
  HttpReader& reader = peer.reader;
  if (reader.begun() && !peer.begun) {
    peer.begun = true;
    peer.deadline = in(options.head_ms);
  }
  if (reader.state() == HttpReader::State::head) return;
  if (!peer.admitted && reader.state() != HttpReader::State::refused) {
    if (std::optional<HttpResponse> refusal = handler.refuse(reader.request()))
      return reply(peer, std::move(*refusal), reader.keeps());
    peer.admitted = true;
    peer.deadline = in(options.body_ms);
    constexpr std::string_view kContinue = "HTTP/1.1 100 Continue\r\n\r\n";
    if (reader.expects_continue()) (void)!::send(peer.socket.get(), kContinue.data(), kContinue.size(), MSG_NOSIGNAL);
  }
  if (reader.state() == HttpReader::State::refused)
    return reply(peer, {reader.status(), "text/plain", reader.complaint() + "\n"}, false);
  if (reader.state() != HttpReader::State::whole) return;
  peer.at = Peer::At::answering;
  peer.gone = std::make_shared<std::atomic<bool>>(false);
  reader.request().gone = peer.gone;
  {
    const std::scoped_lock lock(mutex);
    waiting.push_back({number, reader.request()});
  }
  wanted.notify_one();
}

void HttpServer::Impl::reply(Peer& peer, HttpResponse response, bool keep) {
  peer.reply.emplace(std::move(response), keep, peer.reader.request().method != "HEAD");
  peer.at = Peer::At::sending;
  peer.deadline = in(options.head_ms);
  send(peer);
}

void HttpServer::Impl::send(Peer& peer) {
  for (;;) {
    const std::string_view piece = peer.reply->piece();
    if (piece.empty()) break;
    const ssize_t sent = ::send(peer.socket.get(), piece.data(), piece.size(), MSG_NOSIGNAL);
    if (sent < 0 && (errno == EAGAIN || errno == EINTR)) return;
    if (sent < 0 || peer.reply->too_slow()) return peer.socket.close();
    peer.reply->sent(static_cast<std::size_t>(sent));
    peer.deadline = in(options.head_ms);
  }
  if (!peer.reply->whole()) return peer.socket.close();
  const bool keep = peer.reply->keeps();
  peer.reply.reset();
  if (keep) {
    peer.at = Peer::At::reading;
    peer.begun = peer.admitted = false;
    peer.deadline = in(options.head_ms);
    return peer.reader.next();
  }
  // Closed at once, what the client still sends would make the system drop the response.
  shutdown(peer.socket.get(), SHUT_WR);
  peer.at = Peer::At::closing;
  peer.deadline = Clock::now() + kLinger;
}

void HttpServer::Impl::time_out(Peer& peer) {
  if (peer.at != Peer::At::reading || peer.idle()) return peer.socket.close();
  reply(peer, {408, "text/plain", "the request took too long\n"}, false);
}

HttpServer::HttpServer(const HttpOptions& options, HttpHandler& handler)
    : impl_(std::make_unique<Impl>(options, handler)) {}

HttpServer::~HttpServer() = default;

}  // namespace semfield::app
