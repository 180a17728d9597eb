// A session that trains while somebody clicks: how long labels take, what an open page costs, and what a kill loses.
#include <fcntl.h>
#include <fmt/format.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <csignal>
#include <filesystem>
#include <thread>

#include "core/rng.h"
#include "labels/clicks/click_log.h"
#include "serve/label_session.h"
#include "session/settings/choices.h"
#include "studies/label_bench.h"

namespace semfield {

namespace {

namespace fs = std::filesystem;
using Clock = std::chrono::steady_clock;
using std::chrono::milliseconds;

constexpr double kWindow_s = 8;
constexpr milliseconds kBetweenClicks{400};

double seconds_since(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

class TemporaryFolder {
 public:
  explicit TemporaryFolder(const char* what)
      : path_(fs::temp_directory_path() / fmt::format("{}_{}", what, Clock::now().time_since_epoch().count())) {
    fs::create_directories(path_);
  }
  ~TemporaryFolder() {
    std::error_code ignored;
    fs::remove_all(path_, ignored);
  }
  TemporaryFolder(const TemporaryFolder&) = delete;
  TemporaryFolder& operator=(const TemporaryFolder&) = delete;
  const fs::path& path() const { return path_; }

 private:
  fs::path path_;
};

// What training does in a window: its own seconds per step, and all seconds per step.
struct MeasuredPace {
  double training_s = 0, wall_s = 0;
};

MeasuredPace pace_of(const LabelSession& session, double seconds) {
  const auto before = session.state();
  const Clock::time_point start = Clock::now();
  std::this_thread::sleep_for(std::chrono::duration<double>(seconds));
  const auto after = session.wait_state(session.state()->revision, milliseconds(2000));
  const double wall = seconds_since(start);
  const double steps = static_cast<double>(std::max<std::int64_t>(1, after->step - before->step));
  return {(after->train_s - before->train_s) / steps, wall / steps};
}

// A page that is open and idle: it waits for the state and asks for its view's labels when they have changed.
class OpenPage {
 public:
  explicit OpenPage(LabelSession& session)
      : thread_([&session, this] {
          std::uint64_t seen = 0, overlay = 0;
          while (!ended_) {
            const auto state = session.wait_state(seen, milliseconds(500));
            seen = state->revision;
            if (state->overlay_revision == overlay) continue;
            overlay = state->overlay_revision;
            PictureRequest request;
            request.client = "page";
            request.view = 0;
            (void)session.picture(request);
          }
        }) {}
  ~OpenPage() {
    ended_ = true;
    thread_.join();
  }
  OpenPage(const OpenPage&) = delete;
  OpenPage& operator=(const OpenPage&) = delete;

 private:
  std::atomic<bool> ended_{false};
  std::thread thread_;
};

// Answers the session's questions with the truth. Seconds from each answer to the labels of its view.
std::vector<double> click_through(LabelSession& session, const LoadedScene& scene, int clicks) {
  std::vector<double> out;
  for (int made = 0, asked = 0; made < clicks && asked < 5 * clicks; ++asked) {
    auto state = session.state();
    while (!state->proposal && state->failure.empty()) state = session.wait_state(state->revision, milliseconds(1000));
    if (!state->failure.empty())
      throw Error(ErrorKind::failure, "serve.training.failed", "the session has ended: " + state->failure);
    const ProposalState question = *state->proposal;
    const auto frame = static_cast<std::size_t>(session.frame_of(question.view));
    const StoredFrame& pixels = scene.frames[frame];
    const auto at = static_cast<std::size_t>(static_cast<std::int64_t>(question.at.y) * pixels.width_px +
                                             static_cast<std::int64_t>(question.at.x));
    const std::int16_t label = pixels.label.empty() ? kVoid : pixels.label[at];
    LabelEvent event;
    event.id = fmt::format("bench-{}", asked);
    event.kind = label == kVoid ? LabelEventKind::skip : LabelEventKind::click;
    event.frame = scene.info.frames[frame].name;
    event.width_px = pixels.width_px;
    event.height_px = pixels.height_px;
    event.points = {question.at};
    if (label != kVoid) event.class_name = scene.info.classes.valid(label).name;
    const Clock::time_point start = Clock::now();
    (void)session.apply(event);
    const std::uint64_t own = session.state()->events;
    do {
      state = session.wait_state(state->revision, milliseconds(5000));
    } while (state->overlay_events < own && state->failure.empty());
    if (label == kVoid) continue;
    PictureRequest request;
    request.client = "person";
    request.view = question.view;
    (void)session.picture(request);
    out.push_back(1e3 * seconds_since(start));
    ++made;
    std::this_thread::sleep_for(kBetweenClicks);
  }
  return out;
}

}  // namespace

LabelLatency measure_label_latency(RunConfig config, int clicks, double geometry_s, const StudyTools& tools) {
  const TemporaryFolder folder("semfield_bench_label");
  config.labels.selection.frames = "none";
  config.schedule.decay_steps = kStepsOnCpu;
  config.train.steps = 1'000'000'000;  // it trains to the end of the measurement
  LabelSession session(std::move(config), tools.registry, {(folder.path() / "run").string(), 0}, nullptr);
  std::thread trains([&] { session.run(); });
  LabelLatency out;
  try {
    auto state = session.state();
    while ((!state->geometry_ready || state->train_s < geometry_s) && state->failure.empty())
      state = session.wait_state(state->revision, milliseconds(1000));
    // Before and after, so that neither a neighbour of this machine nor training itself counts.
    const MeasuredPace before = pace_of(session, kWindow_s);
    MeasuredPace open;
    {
      const OpenPage page(session);
      std::this_thread::sleep_for(milliseconds(3000));  // its view has been drawn
      open = pace_of(session, kWindow_s);
    }
    const MeasuredPace after = pace_of(session, kWindow_s);
    out.slowdown = open.wall_s / ((before.training_s + after.training_s) / 2);
    const Session& opened = session.opened();
    out.overlay_ms = click_through(session, opened.scene, clicks);
  } catch (...) {
    session.stop();
    trains.join();
    throw;
  }
  session.stop();
  trains.join();
  return out;
}

int count_lost_clicks(int kills) {
  const TemporaryFolder folder("semfield_bench_kills");
  const std::string path = (folder.path() / "clicks.jsonl").string();
  int lost = 0, next = 0;
  for (int kill_number = 0; kill_number < kills; ++kill_number) {
    int pipe_ends[2];
    if (pipe2(pipe_ends, O_CLOEXEC) != 0) throw Error(ErrorKind::io, "system.process.limit", "cannot make a pipe");
    const pid_t child = fork();
    if (child == 0) {
      Diagnostics ignored;
      ClickLog log = ClickLog::open(path, ignored);
      for (int i = next;; ++i) {
        LabelEvent event;
        event.id = fmt::format("k{}", i);
        event.kind = LabelEventKind::add_class;
        event.class_name = fmt::format("class {}", i);
        log.append(event);
        if (write(pipe_ends[1], &i, sizeof i) != sizeof i) _exit(0);
      }
    }
    close(pipe_ends[1]);
    const RandomAddress address{1, static_cast<std::uint64_t>(kill_number), stream_id("label_bench/kill")};
    std::this_thread::sleep_for(std::chrono::microseconds(200 + uniform_below(address, 0, 20000)));
    kill(child, SIGKILL);
    int acknowledged = next - 1, value = 0;
    while (read(pipe_ends[0], &value, sizeof value) == sizeof value) acknowledged = value;
    close(pipe_ends[0]);
    waitpid(child, nullptr, 0);
    Diagnostics ignored;
    const ClickLog log = ClickLog::open(path, ignored);
    const auto stored = static_cast<int>(log.events().size());
    lost += std::max(0, acknowledged + 1 - stored);
    next = stored;
  }
  return lost;
}

}  // namespace semfield
