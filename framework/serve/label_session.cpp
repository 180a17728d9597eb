#include "serve/label_session.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <condition_variable>
#include <exception>
#include <filesystem>
#include <mutex>
#include <optional>
#include <utility>
#include <vector>

#include "labels/clicks/click_file.h"
#include "serve/label_run.h"
#include "system/checksum.h"

namespace semfield {

namespace {

using Clock = std::chrono::steady_clock;

constexpr int kClassRoom = 32;
constexpr double kTurn_s = 0.03;  // of training between looks at what others want
constexpr auto kIdle = std::chrono::milliseconds(100);
constexpr auto kPublishEvery = std::chrono::milliseconds(400);
constexpr auto kPauseAfter = std::chrono::milliseconds(700);
constexpr auto kQuietAfter = std::chrono::seconds(3);
constexpr auto kLookedFor = std::chrono::seconds(10);
constexpr auto kAbandonedLook = std::chrono::milliseconds(100);
constexpr std::size_t kMostOrders = 16;  // each holds a thread of whoever asks

// What a piece of work threw.
template <class Work>
std::optional<Error> error_of(const Work& work) {
  try {
    work();
  } catch (const Error& error) {
    return error;
  } catch (const std::exception& error) {
    return Error(ErrorKind::failure, error.what());
  }
  return std::nullopt;
}

bool is_write_error(const Error& error) {
  return error.kind() == ErrorKind::io || error.kind() == ErrorKind::cannot_create;
}

// Keeps warnings for the page.
class Noting final : public RunListener {
 public:
  explicit Noting(RunListener* told) : told_(told) {}
  void note(const std::string& text) override {
    if (told_ != nullptr) told_->note(text);
  }
  void warning(const std::string& text) override {
    warnings.push_back(text);
    if (told_ != nullptr) told_->warning(text);
  }
  std::vector<std::string> warnings;

 private:
  RunListener* told_;
};

OpenedForTraining open_labelling(RunConfig config, Registry& registry, const LabelSessionOptions& options,
                                 RunListener& listener) {
  TrainRequest request;
  request.out_dir = options.run_dir;
  const std::filesystem::path folder = std::filesystem::absolute(options.run_dir);
  request.resume = std::filesystem::exists(folder / "run.yaml");
  LabelParams& labels = config.labels.selection;
  if (labels.clicks.empty()) labels.clicks = (folder / kClickFile).string();
  if (labels.class_room == 0) labels.class_room = options.class_room > 0 ? options.class_room : kClassRoom;
  config.train.ray_source = RaySourceKind::label_balanced;
  return open_for_training(std::move(config), registry, request, listener);
}

}  // namespace

struct LabelSession::Parts {
  Parts(OpenedForTraining opened, Registry& registry, Noting& noting, RunListener* listener)
      : notes(std::move(noting.warnings)),
        annotations(*opened.session.config.labels.clicks),
        log([&] {
          Diagnostics ignored;  // told when the scene was opened by the file
          return open_click_log(opened.session.config.labels, opened.folder->path(), ignored);
        }()),
        run(std::move(opened), registry, listener) {}

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
  std::optional<Error> failure;  // of the thread that trains: it trains no longer, and answers all the same
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

// Classes, marks and counts, from `annotations`.
void LabelSession::Parts::name_classes(LabelState& next) const {
  const std::vector<ClassState> before = std::move(next.classes);
  next.classes.clear();
  const ClassTable& table = annotations.classes();
  for (int c = 0; c < annotations.named_classes(); ++c) {
    if (!annotations.is_named(c)) continue;
    const ClassEntry& entry = table.valid(c);
    ClassState cls;
    const auto known =
        std::find_if(before.begin(), before.end(), [&](const ClassState& old) { return old.index == c; });
    if (known != before.end()) cls = *known;
    cls.index = c;
    cls.id = entry.id;
    cls.name = entry.name;
    cls.color = entry.color;
    cls.own = c < annotations.own_classes();
    cls.clicks = 0;
    next.classes.push_back(cls);
  }
  for (ViewState& view : next.views) view.clicks = 0;
  next.marks = annotations.marks();
  for (const Annotations::Mark& mark : next.marks) {
    const auto cls = std::find_if(next.classes.begin(), next.classes.end(),
                                  [&](const ClassState& c) { return c.index == mark.class_index; });
    if (cls != next.classes.end()) ++cls->clicks;
    for (std::size_t v = 0; v < next.views.size(); ++v)
      if (run.loop().views()[v].frame == mark.frame) ++next.views[v].clicks;
  }
  next.named = static_cast<int>(next.classes.size());
  next.room = table.valid_count();
  next.marks_revision = next.revision + 1;
}

LabelSession::LabelSession(RunConfig config, Registry& registry, const LabelSessionOptions& options,
                           RunListener* told) {
  Noting noting(told);
  parts_ =
      std::make_unique<Parts>(open_labelling(std::move(config), registry, options, noting), registry, noting, told);
  auto first = std::make_shared<LabelState>();
  const Session& session = parts_->run.session();
  for (const PoolView& view : parts_->run.loop().views()) {
    const FrameInfo& info = session.scene.info.frames[static_cast<std::size_t>(view.frame)];
    const std::uint32_t checksum = crc32c(std::as_bytes(std::span(view.photo->rgb)));
    first->views.push_back({info.name, info.camera.width_px, info.camera.height_px, 0, 1, false,
                            fmt::format("{:08x}", checksum), info.split == Split::test});
  }
  first->events = parts_->log.events().size();
  first->notes = parts_->notes;
  parts_->name_classes(*first);
  parts_->run.describe(*first);
  first->revision = 1;
  parts_->state = std::move(first);
}

LabelSession::~LabelSession() = default;

bool LabelSession::apply(const LabelEvent& event) {
  Parts& p = *parts_;
  const std::lock_guard events(p.events_mutex);
  if (!p.annotations.check(event)) return false;
  p.log.append(event);
  p.annotations.apply(event);
  p.publish([&](LabelState& next) {
    next.events = p.log.events().size();
    p.name_classes(next);
    if (event.kind == LabelEventKind::click || event.kind == LabelEventKind::skip) next.proposal.reset();
  });
  const std::lock_guard lock(p.mutex);
  p.last_event = Clock::now();
  p.poke();
  return true;
}

std::shared_ptr<const LabelState> LabelSession::state() const {
  const std::lock_guard lock(parts_->mutex);
  return parts_->state;
}

std::shared_ptr<const LabelState> LabelSession::wait_state(std::uint64_t after, std::chrono::milliseconds most) const {
  std::unique_lock lock(parts_->mutex);
  parts_->changed.wait_for(lock, most, [&] { return parts_->state->revision > after || parts_->stopping; });
  return parts_->state;
}

Picture LabelSession::picture(const PictureRequest& request, const std::function<bool()>& abandoned) {
  Parts& p = *parts_;
  const auto order = std::make_shared<Parts::Order>();
  order->request = request;
  std::unique_lock lock(p.mutex);
  Picture none;
  none.stale = true;
  std::vector<std::shared_ptr<Parts::Order>> others;
  for (const std::shared_ptr<Parts::Order>& other : p.orders) {
    if (other->done()) continue;
    if (other->request.client == request.client) {
      other->made = none;
    } else {
      others.push_back(other);
    }
  }
  if (others.size() >= kMostOrders) others.front()->made = none;
  if (p.stopping || p.ended) return none;
  p.orders.push_back(order);
  p.last_look = Clock::now();
  p.changed.notify_all();
  p.poke();
  while (!p.changed.wait_for(lock, kAbandonedLook, [&] { return order->done() || p.ended; }))
    if (abandoned && abandoned()) order->made = none;
  std::erase(p.orders, order);
  if (order->error) throw *order->error;
  return order->made ? std::move(*order->made) : none;
}

int LabelSession::frame_of(int view) const {
  return parts_->run.loop().views().at(static_cast<std::size_t>(view)).frame;
}

FreeCamera LabelSession::camera_of(int view) const {
  const RayCamera& camera = parts_->run.loop().views().at(static_cast<std::size_t>(view)).camera;
  constexpr double kDegrees = 57.29577951308232;
  return {camera.world_from_camera, 2 * kDegrees * std::atan(camera.camera.width_px / (2 * camera.camera.fx))};
}

int LabelSession::view_of(int frame) const {
  const std::vector<PoolView>& views = parts_->run.loop().views();
  const auto found = std::find_if(views.begin(), views.end(), [&](const PoolView& v) { return v.frame == frame; });
  return found == views.end() ? -1 : static_cast<int>(found - views.begin());
}

std::optional<Error> LabelSession::failure() const { return parts_->failure; }

const std::string& LabelSession::run_dir() const { return parts_->run.folder().path(); }

const Session& LabelSession::opened() const { return parts_->run.session(); }

void LabelSession::save() {
  Parts& p = *parts_;
  std::unique_lock lock(p.mutex);
  const std::uint64_t mine = ++p.saves_wanted;
  p.poke();
  p.changed.wait(lock, [&] { return p.saves_made >= mine || p.ended; });
  if (p.saves_made < mine && !p.state->failure.empty())
    throw Error(ErrorKind::failure, "training has ended with an error: " + p.state->failure);
  if (p.save_error) throw *p.save_error;
}

void LabelSession::stop() {
  const std::lock_guard lock(parts_->mutex);
  parts_->stopping = true;
  parts_->poke();
  parts_->changed.notify_all();
}

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
  const std::string trouble = passes ? error->what() : "";
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
    next.failure = error.what();
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
  // However it ends, whoever waits is answered.
  const std::unique_ptr<Parts, void (*)(Parts*)> ending(&p, [](Parts* parts) { parts->end(); });
  Clock::time_point published = Clock::now();
  const auto asked_to_stop = [&] {
    const std::lock_guard lock(p.mutex);
    return p.stopping;
  };
  bool untold = false;  // something has changed since the state was published
  while (!asked_to_stop()) {
    bool busy = false, overlay = false;
    p.attempt([&] { p.take_events(); });
    p.serve_orders();
    p.save_if_wanted();
    if (!p.failure) {
      p.attempt([&] {
        busy = p.run.train(kTurn_s);
        const Parts::Watched watched = p.watched();
        overlay = p.run.tend(watched.looked_at, watched.pause, watched.quiet);
      });
    }
    untold = untold || busy || overlay;
    if (untold && (overlay || !busy || Clock::now() - published >= kPublishEvery)) {
      p.publish([&](LabelState& next) {
        p.run.describe(next);
        next.history_revision = next.revision + 1;
        if (p.run.knows_all() && p.taken_events) next.overlay_events = *p.taken_events;
        if (overlay) next.overlay_revision = next.revision + 1;
      });
      published = Clock::now();
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
