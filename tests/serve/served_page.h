// A page server over a source that is no training, and a plain socket as an HTTP client: what is sent is what the test
// wrote, byte for byte.
#pragma once

#include <arpa/inet.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <string>

#include "app/serve/page_server.h"
#include "core/non_copyable.h"
#include "tests/temp_dir.h"

namespace semfield::testing_http {

// A plain socket as an HTTP client: what is sent is what the test wrote, byte for byte.

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

class Connection : NonCopyable {
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

namespace semfield::app {

// A page server over a source that is no training: two views of 4 x 3 and 6 x 4 pixels, and whatever a test gives it.

class FakeSource final : public LabelSource {
 public:
  FakeSource() {
    LabelState s{.revision = 5,
                 .name = "room",
                 .run_dir = "/runs/room",
                 .phase = "learning",
                 .named = 2,
                 .room = 8,
                 .classes = {{0, 1, "wall", {10, 20, 30}, 0, 0.5, 0.9}, {1, 2, "chair", {200, 30, 30}, 3, 0.1, 0.4}},
                 .views = {{"a", 4, 3, 0, 0.25, true, "a1"}, {"b", 6, 4, 1, 0.5, true, "b1"}},
                 .proposal = ProposalState{"p1", 1, {2.5, 3.5}, "unseen", -1},
                 .marks = {{"m1", 7, {{1.5, 2.5}}, 2, 1}}};
    state_ = std::make_shared<const LabelState>(std::move(s));
  }

  bool apply(const LabelEvent& event) override {
    const std::scoped_lock lock(mutex_);
    for (const LabelEvent& known : events_) {
      if (known.id == event.id) return false;
    }
    if (event.class_name == "nobody")
      throw Error(ErrorKind::data, "labels.class.unknown", "no class 'nobody'", "add it first");
    if (event.class_name == "full disk")
      throw Error(ErrorKind::io, "files.write.failed", "cannot write clicks.jsonl", "free some space");
    if (event.class_name == "broken") throw std::runtime_error("broken");
    events_.push_back(event);
    change_locked([](LabelState& s) { ++s.events; });
    return true;
  }
  std::shared_ptr<const LabelState> state() const override {
    const std::scoped_lock lock(mutex_);
    return state_;
  }
  std::shared_ptr<const LabelState> wait_state(std::uint64_t after, std::chrono::milliseconds most) const override {
    std::unique_lock lock(mutex_);
    changed_.wait_for(lock, most, [&] { return state_->revision > after; });
    return state_;
  }
  Picture picture(const PictureRequest& request, const std::function<bool()>& abandoned) override {
    std::unique_lock lock(mutex_);
    requests.push_back(request);
    changed_.notify_all();
    while (held && !abandoned()) changed_.wait_for(lock, std::chrono::milliseconds(20));
    Picture p{.stale = abandoned()};
    if (p.stale) {
      ++abandoned_pictures;
      return p;
    }
    p.width_px = 4;
    p.height_px = 3;
    p.overlay_revision = 9;
    p.seen = {{"m1", {{0.5, 1.5}, {2.5, 1.5}}}};
    if (request.thing) {  // the left half
      p.label = {0, 0, -1, -1, 0, 0, -1, -1, 0, 0, -1, -1};
      p.thing = ThingFacts{request.thing->level, -2, 3, 0.5, 1};
      return p;
    }
    if (request.color) p.rgb.assign(36, 128);
    if (request.labels) p.label = {-1, 0, 1, 1, -1, 0, 1, 1, -1, 0, 1, 5};
    if (request.entropy) p.entropy = {0, 20, 40, 60, 80, 100, 120, 140, 160, 180, 200, 255};
    return p;
  }
  Image<std::uint8_t> photo(int view, std::int32_t most_px) override {
    const std::scoped_lock lock(mutex_);
    photos.push_back(most_px);
    if (view == 0) return {4, 3, 3, std::vector<std::uint8_t>(36, 90)};
    return {12, 8, 3, std::vector<std::uint8_t>(288, 90)};  // the file's is twice as large as what trains
  }
  int view_of(int frame) const override { return frame == 7 ? 1 : -1; }
  void save() override { ++saves; }

  void change(const std::function<void(LabelState&)>& how) {
    const std::scoped_lock lock(mutex_);
    change_locked(how);
  }
  std::vector<LabelEvent> events() const {
    const std::scoped_lock lock(mutex_);
    return events_;
  }
  /// Pictures wait from now on, or no longer.
  void hold(bool on) {
    const std::scoped_lock lock(mutex_);
    held = on;
    changed_.notify_all();
  }
  void wait_for_requests(std::size_t count) {
    std::unique_lock lock(mutex_);
    changed_.wait(lock, [&] { return requests.size() >= count; });
  }

  std::vector<PictureRequest> requests;
  std::vector<std::int32_t> photos;  // most_px of each that was requested
  std::atomic<int> saves{0}, abandoned_pictures{0};
  bool held = false;

 private:
  void change_locked(const std::function<void(LabelState&)>& how) {
    LabelState next = *state_;
    ++next.revision;
    how(next);
    state_ = std::make_shared<const LabelState>(std::move(next));
    changed_.notify_all();
  }
  mutable std::mutex mutex_;
  mutable std::condition_variable changed_;
  std::shared_ptr<const LabelState> state_;
  std::vector<LabelEvent> events_;
};

struct ServedPage : ::testing::Test {
  ServedPage() { start(); }

  PageOptions options() const {
    PageOptions o;
    o.http.port = 0;
    o.http.responses = 16;
    o.http.head_ms = 2000;
    o.http.body_ms = 1000;
    o.token = std::string(32, 'a');
    o.run_id = "run-1";
    o.files = {{"", {"text/html; charset=utf-8", "<html></html>"}},
               {"index.html", {"text/html; charset=utf-8", "<html></html>"}},
               {"app.js", {"text/javascript; charset=utf-8", "1;"}}};
    o.exports = {"/bin/false", folder_, {}};
    o.longest_poll_ms = 1500;
    return o;
  }
  void start() { start(options()); }
  void start(const PageOptions& o) {
    server_.reset();
    server_ = std::make_unique<PageServer>(source_, o);
  }
  int port() const { return server_->port(); }
  std::string host() const { return "127.0.0.1:" + std::to_string(port()); }
  static std::string token() { return std::string(32, 'a'); }

  /// One request below the secret folder, as a page of the server would send it.
  std::string text(const std::string& method, const std::string& name, const std::string& body = "",
                   const std::string& more = "") const {
    std::string out = method + " /" + token() + "/" + name + " HTTP/1.1\r\nHost: " + host() + "\r\n" + more;
    if (!body.empty() || method == "POST") out += "Content-Length: " + std::to_string(body.size()) + "\r\n";
    return out + "\r\n" + body;
  }
  testing_http::Answer ask(const std::string& request) const {
    testing_http::Connection c(port());
    c.send(request);
    return c.receive();
  }
  testing_http::Answer get(const std::string& name) const { return ask(text("GET", name)); }
  testing_http::Answer post(const std::string& name, const std::string& body) const {
    return ask(text("POST", name, body));
  }
  static std::string click(const std::string& id, const std::string& class_name = "chair") {
    return R"({"id":")" + id + R"(","type":"click","frame":"a","size":[4,3],"points":[[1.5,2]],"radius":0,"class":")" +
           class_name + "\"}";
  }

  const TempDir dir_;
  const std::string& folder_ = dir_.path();
  FakeSource source_;
  std::unique_ptr<PageServer> server_;
};

}  // namespace semfield::app
