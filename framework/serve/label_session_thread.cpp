// The thread of a labelling session that trains: it takes clicks, serves pictures, saves, and publishes the state.
#include "core/findings.h"
#include "serve/label_session_parts.h"

namespace semfield {

namespace {

constexpr double kTurn_s = 0.03;  // of training between looks at what others want
constexpr int kMostHurries = 8;   // turns in a row that leave surfaces for later, because somebody waits
constexpr auto kIdle = std::chrono::milliseconds(100);
constexpr auto kPublishEvery = std::chrono::milliseconds(400);

bool is_write_error(const Error& error) {
  return error.kind() == ErrorKind::io || error.kind() == ErrorKind::cannot_create;
}

}  // namespace

// Copies what has come, and learns from it.
void LabelSession::Parts::take_events() {
  std::optional<Annotations> now;
  std::uint64_t events = 0;
  {
    const std::lock_guard lock(events_mutex);
    events = log.events().size();
    if (events == taken_events) return;
    now = annotations;
  }
  taken_events = events;
  run.take(*now);
  publish([&](LabelState& next) {
    run.describe(next);
    if (run.knows_all()) next.overlay_events = events;
    next.overlay_revision = next.revision + 1;
  });
}

void LabelSession::Parts::serve_orders() {
  std::shared_ptr<Order> order;
  std::uint64_t overlay = 0;
  {
    const std::lock_guard lock(mutex);
    for (const bool full : {false, true}) {  // what comes quickly does not wait for what takes long
      const auto first = std::find_if(orders.begin(), orders.end(),
                                      [&](const auto& o) { return !o->done() && o->request.full == full; });
      if (order == nullptr && first != orders.end()) order = *first;
    }
    if (order == nullptr) return;
    overlay = state->overlay_revision;
  }
  std::optional<Picture> made;
  std::optional<Error> error = error_of([&] {
    run.pictures().begin(order->request);
    made = run.pictures().work(kTurn_s);
  });
  while (!made && !error) {
    {
      const std::lock_guard lock(mutex);
      if (order->done() || stopping) return;
    }
    attempt([&] { take_events(); });  // a click does not wait for a large picture
    if (!failure) attempt([&] { (void)run.train(kTurn_s); });
    error = error_of([&] { made = run.pictures().work(kTurn_s); });
  }
  if (made) made->overlay_revision = overlay;
  const std::lock_guard lock(mutex);
  if (order->done()) return;
  order->made = std::move(made);
  order->error = std::move(error);
  changed.notify_all();
}

void LabelSession::Parts::save_if_wanted() {
  std::uint64_t wanted_now = 0;
  {
    const std::lock_guard lock(mutex);
    wanted_now = saves_wanted;
    if (wanted_now == saves_made && (failure || !run.keep_is_due())) return;
    if (wanted_now != saves_made && !failure && !stopping && !run.knows_all()) return;  // soon it does
  }
  std::optional<Error> error = error_of([&] {
    run.keep(wanted_now != saves_made);
    if (wanted_now != saves_made) write_record();
  });
  const bool passes = error && is_write_error(*error);
  if (error && !passes && wanted_now == saves_made) return fail(*error);
  const std::string trouble = passes ? shown(*error) : "";
  if (trouble != trouble_told) publish([&](LabelState& next) { next.trouble = trouble; });
  trouble_told = trouble;
  const std::lock_guard lock(mutex);
  save_error = std::move(error);
  saves_made = wanted_now;
  changed.notify_all();
}

void LabelSession::Parts::write_record() {
  std::shared_ptr<const LabelState> now;
  {
    const std::lock_guard lock(mutex);
    now = state;
  }
  run.write_record(*now);
}

void LabelSession::Parts::fail(const Error& error) {
  failure = error;
  publish([&](LabelState& next) {
    next.failure = shown(error);
    next.phase = "training has ended with an error; labels are stored";
  });
}

void LabelSession::Parts::end() {
  const std::lock_guard lock(mutex);
  ended = true;
  changed.notify_all();
}

void LabelSession::run() {
  Parts& p = *parts_;
  // However it ends, whoever waits gets a response.
  const std::unique_ptr<Parts, void (*)(Parts*)> ending(&p, [](Parts* parts) { parts->end(); });
  Parts::Clock::time_point published = Parts::Clock::now();
  const auto asked_to_stop = [&] {
    const std::lock_guard lock(p.mutex);
    return p.stopping;
  };
  bool untold = false;  // something has changed since the state was published
  int hurries = 0;
  while (!asked_to_stop()) {
    bool busy = false, overlay = false;
    p.attempt([&] { p.take_events(); });
    p.serve_orders();
    p.save_if_wanted();
    if (!p.failure) {
      p.attempt([&] {
        busy = p.run.train(kTurn_s, [&] { return p.is_waited_for(); });
        if (p.is_waited_for() && ++hurries <= kMostHurries) return;
        hurries = 0;
        const Parts::Watched watched = p.watched();
        overlay = p.run.tend(watched.looked_at, watched.pause, watched.quiet);
      });
    }
    untold = untold || busy || overlay;
    if (untold && (overlay || !busy || Parts::Clock::now() - published >= kPublishEvery)) {
      p.publish([&](LabelState& next) {
        p.run.describe(next);
        next.history_revision = next.revision + 1;
        if (p.run.knows_all() && p.taken_events) next.overlay_events = *p.taken_events;
        if (overlay) next.overlay_revision = next.revision + 1;
      });
      published = Parts::Clock::now();
      untold = false;
    }
    if (busy || overlay) continue;
    std::unique_lock lock(p.mutex);
    p.wanted.wait_for(lock, kIdle, [&] { return p.poked; });
    p.poked = false;
  }
  p.attempt([&] { p.take_events(); });
  if (p.failure) return;
  p.run.keep(true);
  p.write_record();
}

}  // namespace semfield
