// A labelling session of the analytic room whose training runs in a thread of its own.
#pragma once

#include <thread>

#include "core/error.h"
#include "serve/label_session.h"
#include "tests/label_loop/looped_room.h"

namespace semfield::testing_loop {

inline constexpr int kSteps = 60;

inline std::string session_config(const std::string& scene = "analytic_room, with_labels: false, with_classes: false") {
  std::string yaml = room_config(scene);
  yaml.replace(yaml.find("steps: 200"), 10, "steps: " + std::to_string(kSteps));
  return yaml;
}

/// run() in a thread from start() on; what it throws is in `ended_with`. Stopped at the end.
class RunningSession {
 public:
  RunningSession(const std::string& yaml, const std::string& run_dir, RunListener* listener = nullptr,
                 int class_room = 6)
      : RunningSession(run_config_of(parse_config_text(yaml, "test.yaml"), registry()), run_dir, listener, class_room) {
  }
  RunningSession(RunConfig config, const std::string& run_dir, RunListener* listener = nullptr, int class_room = 6)
      : session(std::move(config), registry(), {run_dir, class_room}, listener) {}
  ~RunningSession() { stop(); }
  RunningSession(const RunningSession&) = delete;
  RunningSession& operator=(const RunningSession&) = delete;

  static Registry& registry() {
    static Registry all = testing_train::make_registry();
    return all;
  }
  RunningSession& start() {
    thread_ = std::thread([this] {
      try {
        session.run();
      } catch (const std::exception& error) {
        ended_with = error.what();
      }
    });
    return *this;
  }
  void stop() {
    session.stop();
    if (thread_.joinable()) thread_.join();
  }

  /// The first state that is as wanted. Far more time than it takes; a test that needs it has failed.
  std::shared_ptr<const LabelState> wait_until(const std::function<bool(const LabelState&)>& wanted) const {
    std::shared_ptr<const LabelState> state = session.state();
    for (int turn = 0; !wanted(*state) && turn < 100; ++turn)
      state = session.wait_state(state->revision, std::chrono::milliseconds(300));
    EXPECT_TRUE(wanted(*state)) << state->phase << ", step " << state->step << ", failure: " << state->failure;
    return state;
  }
  /// Labels know every event and all views have some.
  std::shared_ptr<const LabelState> settled() const {
    return wait_until([](const LabelState& s) { return s.geometry_ready && s.overlay_events == s.events; });
  }

  LabelEvent add(const std::string& id, const std::string& name) const {
    return LabelEvent{.id = id, .kind = LabelEventKind::add_class, .class_name = name};
  }
  LabelEvent undo(const std::string& id, const std::string& of) const {
    return LabelEvent{.id = id, .kind = LabelEventKind::undo, .of = of};
  }
  LabelEvent click(const std::string& id, int view, const std::string& name, PixelPoint at, double radius = 1) const {
    const ViewState& shown = session.state()->views.at(static_cast<std::size_t>(view));
    return LabelEvent{.id = id,
                      .frame = shown.frame,
                      .width_px = shown.width_px,
                      .height_px = shown.height_px,
                      .points = {at},
                      .radius_px = radius,
                      .class_name = name};
  }

  LabelSession session;
  std::string ended_with;

 private:
  std::thread thread_;
};

}  // namespace semfield::testing_loop
