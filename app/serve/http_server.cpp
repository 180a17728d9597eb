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
#include <chrono>
#include <condition_variable>
#include <cstring>
#include <deque>
#include <map>
#include <mutex>
#include <system_error>
#include <thread>
#include <utility>
#include <vector>

#include "app/serve/http_reply.h"
#include "core/error.h"

namespace semfield::app {

namespace {

using Clock = std::chrono::steady_clock;
using std::chrono::milliseconds;

constexpr std::size_t kReceivedAtOnce = std::size_t{64} << 10;
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
  std::array<char, kReceivedAtOnce> piece;
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
