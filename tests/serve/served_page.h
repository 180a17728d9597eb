// A page server over a source that is no training: two views of 4 x 3 and 6 x 4 pixels, and whatever a test gives it.
#pragma once

#include <gtest/gtest.h>

#include "app/serve/page_server.h"
#include "core/error.h"
#include "tests/serve/http_client.h"
#include "tests/temp_dir.h"

namespace semfield::app {

class FakeSource final : public PageSource {
 public:
  FakeSource() {
    LabelState s{.revision = 5,
                 .marks_revision = 4,
                 .history_revision = 2,
                 .name = "room",
                 .run_dir = "/runs/room",
                 .phase = "learning",
                 .named = 2,
                 .room = 8,
                 .classes = {{0, 1, "wall", {10, 20, 30}, 0, 0.5, 0.9}, {1, 2, "chair", {200, 30, 30}, 3, 0.1, 0.4}},
                 .views = {{"a", 4, 3, 0, 0.25, true, "a1"}, {"b", 6, 4, 1, 0.5, true, "b1"}},
                 .proposal = ProposalState{"p1", 1, {2.5, 3.5}, "unseen", -1},
                 .marks = {{"m1", 7, {{1.5, 2.5}}, 2, 1}},
                 .history = {{1.0, 0.5, 20.0, 1}}};
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
    const std::size_t mine = ++asked_[request.client];
    changed_.notify_all();
    while (held && asked_[request.client] == mine && !abandoned())
      changed_.wait_for(lock, std::chrono::milliseconds(20));
    if (abandoned()) ++abandoned_pictures;
    Picture p{.stale = asked_[request.client] != mine || abandoned()};
    if (p.stale) return p;
    p.width_px = 4;
    p.height_px = 3;
    p.overlay_revision = 9;
    if (request.at) {
      p.meets_surface = request.at->x < 0.9;
      p.nearest_view = 1;
      if (request.at->x < 0.5) p.spot = Spot{0, {2.5, 1.5}};
      return p;
    }
    p.seen = {{"m1", {{0.5, 1.5}, {2.5, 1.5}}}};
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
  FreeCamera camera_of(int view) const override { return FreeCamera{.world_from_camera = {.t = {1, 2, 3.0 + view}}}; }
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
  std::map<std::string, std::size_t> asked_;
};

class ServedPage : public ::testing::Test {
 protected:
  ServedPage() { start(); }

  PageOptions options() const {
    PageOptions o;
    o.http.port = 0;
    o.http.threads = 16;
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
