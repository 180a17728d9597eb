#include "serve/label_session.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <utility>

#include "serve/label_session_parts.h"
#include "system/checksum.h"

namespace semfield {

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
  // Views of the page are where the files put them, and labels with them.
  if (config.cameras.poses == CameraTrust::automatic) config.cameras.poses = CameraTrust::given;
  return open_for_training(std::move(config), registry, request, listener);
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
  parts_ = std::make_unique<Parts>(open_labelling(std::move(config), registry, options, noting), registry,
                                   std::move(noting.warnings), told);
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

}  // namespace semfield
