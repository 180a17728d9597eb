#include "serve/label_session.h"

#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <exception>
#include <filesystem>
#include <map>
#include <memory>
#include <mutex>
#include <numeric>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/error.h"
#include "eval/image_output.h"
#include "formats/image_io.h"
#include "labels/clicks/annotations.h"
#include "labels/clicks/click_file.h"
#include "labels/mask_outlines.h"
#include "serve/label_run.h"
#include "system/checksum.h"
#include "system/files.h"

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
  Parts(std::unique_ptr<Run> opened, std::vector<std::string> warnings)
      : notes(std::move(warnings)),
        annotations(*opened->annotations()),
        log([&] {
          Diagnostics ignored;  // stated when the scene was opened by the file
          return open_click_log(opened->session().config.labels, opened->run_dir(), ignored);
        }()),
        run(std::move(opened)) {}

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

namespace {

constexpr int kClassRoom = 32;
constexpr auto kAbandonedLook = std::chrono::milliseconds(100);
constexpr std::size_t kMostOrders = 16;  // each holds a thread of its caller

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

std::unique_ptr<Run> open_labelling(RunConfig config, Registry& registry, const LabelSessionOptions& options,
                                    RunListener* listener, RunListener& opening) {
  TrainRequest request;
  request.driver = Driver::page;
  request.out_dir = options.run_dir;
  const std::filesystem::path folder = std::filesystem::absolute(options.run_dir);
  request.resume = std::filesystem::exists(folder / "run.yaml");
  LabelParams& labels = config.labels.selection;
  if (labels.clicks.empty()) labels.clicks = (folder / kClickFile).string();
  if (labels.class_room == 0) labels.class_room = options.class_room > 0 ? options.class_room : kClassRoom;
  config.train.ray_source = RaySourceKind::label_balanced;
  // Views of the page are where the files put them, and labels with them.
  if (config.cameras.poses == CameraTrust::automatic) config.cameras.poses = CameraTrust::given;
  return std::make_unique<Run>(std::move(config), registry, request, listener, &opening);
}

}  // namespace

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
  std::unique_ptr<Run> opened = open_labelling(std::move(config), registry, options, told, noting);
  parts_ = std::make_unique<Parts>(std::move(opened), std::move(noting.warnings));
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
  p.last_event = Parts::Clock::now();
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
  p.last_look = Parts::Clock::now();
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
    throw Error(ErrorKind::failure, "serve.training.failed", "training has ended with an error: " + p.state->failure);
  if (p.save_error) throw *p.save_error;
}

void LabelSession::stop() {
  const std::lock_guard lock(parts_->mutex);
  parts_->stopping = true;
  parts_->poke();
  parts_->changed.notify_all();
}

// The thread of a labelling session that trains: it takes clicks, serves pictures, saves, and publishes the state.

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

namespace {

constexpr std::size_t kShown = 4;  // frames with pictures
constexpr std::array<std::uint8_t, 3> kRim{{255, 255, 255}};

using Mark = Annotations::Mark;

void paint(std::vector<std::uint8_t>& rgb, const StoredFrame& photo, const Mark& mark, double radius_px,
           const std::array<std::uint8_t, 3>& color) {
  for (const PixelRun& run : stroke_runs(mark.points, radius_px, photo.width_px, photo.height_px))
    for (std::int32_t x = run.x0; x < run.x1; ++x)
      std::copy(color.begin(), color.end(),
                rgb.begin() + 3 * (static_cast<std::ptrdiff_t>(run.y) * photo.width_px + x));
}

// The photograph with the frame's clicks in the colours of their classes, large enough to be seen, with a light rim.
std::vector<std::uint8_t> with_clicks(const StoredFrame& photo, const std::vector<const Mark*>& marks,
                                      const ClassTable& classes) {
  std::vector<std::uint8_t> rgb = photo.rgb;
  const double least = std::max(1.0, photo.width_px / 160.0);
  for (const double rim : {std::max(1.0, least / 3), 0.0})
    for (const Mark* mark : marks) {
      const std::array<std::uint8_t, 3> color =
          mark->class_index == kVoid ? std::array<std::uint8_t, 3>{} : classes.valid(mark->class_index).color;
      paint(rgb, photo, *mark, std::max(mark->radius_px, least) + rim, rim > 0 ? kRim : color);
    }
  return rgb;
}

void write_pictures(const RunFolder& folder, const Session& session, LabelLoop& loop, int view,
                    const std::vector<const Mark*>& marks) {
  const PoolView& pool_view = loop.views()[static_cast<std::size_t>(view)];
  const std::string& name = session.scene.info.frames[static_cast<std::size_t>(pool_view.frame)].name;
  const auto path = [&](const char* kind) { return folder.render_path("labelled", name, kind); };
  const StoredFrame& photo = *pool_view.photo;
  const ClassTable& classes = session.scene.info.classes;
  write_png_rgb(path("clicks"), photo.width_px, photo.height_px, with_clicks(photo, marks, classes));
  if (!loop.learned()) return;
  const ViewLabels labels = loop.labels_of(view);
  write_png_rgb(path("label_vis"), labels.width_px, labels.height_px, label_colors(labels.label, classes));
  std::vector<std::uint8_t> entropy;
  for (const std::uint8_t share : labels.entropy) {
    const std::array<std::uint8_t, 3> color = perceptual_color(share / 255.0);
    entropy.insert(entropy.end(), color.begin(), color.end());
  }
  write_png_rgb(path("entropy_vis"), labels.width_px, labels.height_px, entropy);
}

}  // namespace

void write_session_record(const RunFolder& folder, const Session& session, LabelLoop& loop, const LabelState& state) {
  LabellingRecord record;
  record.step = state.step;
  record.clicks = std::ssize(state.marks);
  record.frames = std::ssize(loop.pooled());
  for (const ClassState& c : state.classes)
    record.classes.push_back({c.id, c.name, c.color, c.clicks, c.area_share, c.confidence});
  std::map<int, std::vector<const Mark*>> marks;
  for (const Mark& mark : state.marks) marks[mark.frame].push_back(&mark);
  record.clicked_frames = std::ssize(marks);
  std::vector<int> views(loop.pooled().size());
  std::iota(views.begin(), views.end(), 0);
  const auto clicks_of = [&](int view) {
    const auto found = marks.find(loop.views()[static_cast<std::size_t>(view)].frame);
    return found == marks.end() ? std::vector<const Mark*>() : found->second;
  };
  std::stable_sort(views.begin(), views.end(), [&](int a, int b) { return clicks_of(a).size() > clicks_of(b).size(); });
  for (const int view : views) {
    const std::vector<const Mark*> of_view = clicks_of(view);
    if (of_view.empty() || record.shown.size() == kShown) break;
    write_pictures(folder, session, loop, view, of_view);
    const int frame = loop.views()[static_cast<std::size_t>(view)].frame;
    record.shown.push_back({session.scene.info.frames[static_cast<std::size_t>(frame)].name, std::ssize(of_view)});
  }
  write_file_atomic(folder.labelling_path(), labelling_record_json(record));
}

}  // namespace semfield
