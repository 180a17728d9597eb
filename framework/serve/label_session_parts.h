// Hold what the threads of a labelling session share: events, state, orders of pictures, and the run that one trains.
#pragma once

#include <algorithm>
#include <chrono>
#include <condition_variable>
#include <exception>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "labels/clicks/click_file.h"
#include "serve/label_run.h"
#include "serve/label_session.h"

namespace semfield {

/// What a piece of work threw.
template <class Work>
std::optional<Error> error_of(const Work& work) {
  try {
    work();
  } catch (const Error& error) {
    return error;
  } catch (const std::exception& error) {
    return Error(ErrorKind::failure, "internal.exception", error.what());
  }
  return std::nullopt;
}

struct LabelSession::Parts {
  Parts(OpenedForTraining opened, Registry& registry, std::vector<std::string> warnings, RunListener* listener)
      : notes(std::move(warnings)),
        annotations(*opened.session.config.labels.clicks),
        log([&] {
          Diagnostics ignored;  // stated when the scene was opened by the file
          return open_click_log(opened.session.config.labels, opened.folder->path(), ignored);
        }()),
        run(std::move(opened), registry, listener) {}

  using Clock = std::chrono::steady_clock;
  static constexpr auto kPauseAfter = std::chrono::milliseconds(700);
  static constexpr auto kQuietAfter = std::chrono::seconds(3);
  static constexpr auto kLookedFor = std::chrono::seconds(10);

  // A picture that somebody waits for.
  struct Order {
    PictureRequest request;
    std::optional<Picture> made;
    std::optional<Error> error;
    bool done() const { return made || error; }
  };

  std::vector<std::string> notes;
  // Of events. Held while one is stored, so it is never taken by the thread that trains for longer than a copy takes.
  std::mutex events_mutex;
  Annotations annotations;
  ClickLog log;

  // Of everything below, but for `run`, which belongs to the thread that trains.
  mutable std::mutex mutex;
  mutable std::condition_variable changed;  // the state, or an order
  std::condition_variable wanted;           // something of the thread that trains
  std::shared_ptr<const LabelState> state;
  std::optional<std::uint64_t> taken_events;  // that `run` knows
  std::vector<std::shared_ptr<Order>> orders;
  std::uint64_t saves_wanted = 0, saves_made = 0;
  std::optional<Error> save_error;
  bool stopping = false, ended = false, poked = false;  // poked: look again before going to sleep
  std::string trouble_told;
  std::optional<Error> failure;  // of the thread that trains: it trains no longer, and responds all the same
  Clock::time_point last_event = Clock::now() - kQuietAfter, last_look = Clock::now() - kLookedFor;

  LabelRun run;

  void poke() {
    poked = true;
    wanted.notify_all();
  }
  template <class Change>
  void publish(const Change& change) {
    const std::lock_guard lock(mutex);
    auto next = std::make_shared<LabelState>(*state);
    change(*next);
    ++next->revision;
    state = std::move(next);
    changed.notify_all();
  }
  /// Whether somebody looks, and whether nobody has clicked for a moment, or for long.
  struct Watched {
    bool looked_at, pause, quiet;
  };
  Watched watched() const {
    const std::lock_guard lock(mutex);
    const Clock::time_point now = Clock::now();
    const Clock::duration quiet = now - last_event;
    return {now - last_look<kLookedFor, quiet> kPauseAfter, quiet > kQuietAfter};
  }
  /// An event that `run` does not know yet, or a picture.
  bool is_waited_for() const {
    const std::lock_guard lock(mutex);
    return (taken_events && *taken_events < state->events) ||
           std::any_of(orders.begin(), orders.end(), [](const auto& order) { return !order->done(); });
  }
  void name_classes(LabelState& next) const;
  void take_events();
  void serve_orders();
  void save_if_wanted();
  void write_record();
  template <class Work>
  void attempt(const Work& work) {
    if (const std::optional<Error> error = error_of(work)) fail(*error);
  }
  void fail(const Error& error);
  void end();
};

}  // namespace semfield
