#include "labels/serve/label_session.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <exception>
#include <iterator>
#include <map>
#include <numeric>
#include <tuple>
#include <utility>

#include "core/checksum.h"
#include "core/error.h"
#include "core/files.h"
#include "eval/image_output.h"
#include "eval/metrics.h"
#include "labels/labelling_record.h"
#include "labels/mask_outlines.h"
#include "labels/training_labels.h"

namespace semfield {

namespace {

constexpr std::int64_t kFirstSurface = 150;  // steps before geometry is looked at
constexpr std::int64_t kAfterChange = 300;   // steps that labels get which came when training had ended
constexpr double kTendingShare = 0.05;       // of the time of training, once every view has a surface
constexpr double kFirstTendingShare = 0.5;   // until then
constexpr double kLookedAtShare = 0.5;       // of the time of training, for the view that somebody looks at
constexpr double kSlice_s = 0.03;            // of work on clicks, between steps of training
constexpr std::size_t kLeastToFit = 10;      // clicks; and half as many again as at the last fit
constexpr double kKeepAgain_s = 5;           // after files could not be written
constexpr std::size_t kGivenPixels = 48;     // of a class in a frame whose labels the configuration gives
constexpr std::size_t kMostGiven = 6000;
constexpr double kGivenWeight = 0.1;  // where a click is 1: who clicks beside given labels corrects them

// Tells marks of a frame apart that paint something else.
std::vector<std::uint64_t> checksums(const Annotations& annotations, std::size_t frames) {
  std::vector<std::uint64_t> sums(frames, 0);
  for (const Annotations::Mark& mark : annotations.marks()) {
    std::uint64_t& sum = sums[static_cast<std::size_t>(mark.frame)];
    sum = mix(mix(sum + 1, std::hash<std::string>{}(mark.id)), static_cast<std::uint64_t>(mark.class_index + 2));
  }
  return sums;
}

// Test frames with pixels: they are looked at, and nothing is learned from them.
std::vector<int> held_out_frames(const Session& session) {
  std::vector<int> frames = session.scene.frames_of(Split::test);
  std::erase_if(frames, [&](int f) { return session.scene.frames[static_cast<std::size_t>(f)].rgb.empty(); });
  return frames;
}

}  // namespace

// Pixels that the configuration's own labels name, some of every class in every frame.
std::vector<LabelledPixels> LabelSession::given_labels() const {
  std::vector<LabelledPixels> out;
  std::size_t total = 0;
  for (std::size_t v = 0; v < loop_.pooled().size() && total < kMostGiven; ++v) {
    const auto frame = static_cast<std::size_t>(loop_.views()[v].frame);
    if (frame >= opened().labels.unclicked.size()) continue;
    const TrainingLabels::Frame& labels = opened().labels.unclicked[frame];
    if (labels.empty()) continue;
    std::vector<std::vector<std::uint32_t>> of(static_cast<std::size_t>(opened().classes()));
    for (std::size_t p = 0; p < labels.size(); ++p)
      if (labels[p] >= 0) of[static_cast<std::size_t>(labels[p])].push_back(static_cast<std::uint32_t>(p));
    const std::int32_t width = loop_.views()[v].photo->width_px;
    for (std::size_t c = 0; c < of.size(); ++c) {
      if (of[c].empty()) continue;
      LabelledPixels some{static_cast<int>(v), static_cast<std::int16_t>(c), {}, kGivenWeight};
      const std::size_t count = std::min(kGivenPixels, of[c].size());
      for (std::size_t i = 0; i < count; ++i) {
        const auto pixel = static_cast<std::int32_t>(of[c][(2 * i + 1) * of[c].size() / (2 * count)]);
        some.pixels.push_back({pixel % width, pixel / width});
      }
      total += count;
      out.push_back(std::move(some));
    }
  }
  return out;
}

LabelledPixels LabelSession::labelled(const Annotations::Mark& mark, std::span<const std::int16_t> painted) const {
  const Camera& camera = opened().scene.info.frames[static_cast<std::size_t>(mark.frame)].camera;
  return {view_of(mark.frame), static_cast<std::int16_t>(mark.class_index),
          pixels_of(mark, camera.width_px, camera.height_px, painted)};
}

void LabelSession::name_pixels(const Annotations& annotations, std::span<const int> changed) {
  std::vector<std::vector<std::int16_t>> painted(view_of_frame_.size());
  for (const int f : changed) named_[static_cast<std::size_t>(f)].clear();
  for (const Annotations::Mark& mark : annotations.marks()) {
    const auto frame = static_cast<std::size_t>(mark.frame);
    if (mark.class_index == kVoid || view_of_frame_[frame] < 0 ||
        std::find(changed.begin(), changed.end(), mark.frame) == changed.end())
      continue;
    if (painted[frame].empty()) painted[frame] = annotations.paint(mark.frame, {});
    LabelledPixels named = labelled(mark, painted[frame]);
    if (!named.pixels.empty()) named_[frame].push_back(std::move(named));
  }
  clicks_ = given_;
  for (const std::vector<LabelledPixels>& of_frame : named_)
    clicks_.insert(clicks_.end(), of_frame.begin(), of_frame.end());
}

void LabelSession::ignore_pixels(const Annotations& annotations, std::span<const int> frames) {
  for (const int frame : frames) {
    const auto f = static_cast<std::size_t>(frame);
    if (view_of_frame_[f] < 0) continue;
    const Camera& camera = opened().scene.info.frames[f].camera;
    std::vector<std::int16_t> labels(static_cast<std::size_t>(std::int64_t{camera.width_px} * camera.height_px), 0);
    std::vector<bool> ignored;
    if (annotations.clear_ignored(frame, camera.width_px, camera.height_px, labels))
      std::transform(labels.begin(), labels.end(), std::back_inserter(ignored),
                     [](std::int16_t l) { return l == kVoid; });
    loop_.set_ignored(view_of_frame_[f], std::move(ignored));
  }
}

void LabelSession::take(const Annotations& annotations) {
  const std::vector<std::uint64_t> sums = checksums(annotations, marked_.size());
  std::vector<int> changed;
  for (std::size_t f = 0; f < sums.size(); ++f)
    if (sums[f] != marked_[f]) changed.push_back(static_cast<int>(f));
  training_.set_clicks(annotations, changed);
  ignore_pixels(annotations, changed);
  // What a run that goes on had learned already is no change.
  if (!changed.empty() && taken_) changed_step_ = training_.step();
  taken_ = true;
  marked_ = sums;
  name_pixels(annotations, changed);
  pictures_.set_marks(annotations.marks());
  if (!changed.empty() || !loop_.learned()) {
    unlearned_ = true;
    fold_ = 0;
    held_back_.clear();
    (void)learn_new(0.1);
  }
  std::uint64_t skips = 0;
  for (const Annotations::Mark& mark : annotations.skips()) skips = mix(skips, std::hash<std::string>{}(mark.id));
  if (skips != skips_) {
    skips_ = skips;
    std::vector<LabelledPixels> skipped;
    for (const Annotations::Mark& mark : annotations.skips())
      if (view_of(mark.frame) >= 0) skipped.push_back(labelled(mark));
    loop_.set_skipped(std::move(skipped));
  }
  summarise();
  ask();
}

bool LabelSession::learn_new(double budget_s) {
  if (!unlearned_ || !loop_.ready() || !loop_.find_places(clicks_, budget_s)) return false;
  loop_.learn(clicks_, true);
  unlearned_ = false;
  learned_quickly_ = true;
  return true;
}

// True when the temperature has changed.
bool LabelSession::fit_a_fold() {
  const std::size_t own = clicks_.size() - given_.size();
  if (own < kLeastToFit || own * 2 < fitted_at_ * 3) return false;
  for (HeldBack& held : loop_.hold_back(clicks_, fold_)) held_back_.push_back(std::move(held));
  if (++fold_ < kCalibrationFolds) return false;
  const std::optional<double> temperature = fit_temperature(held_back_);
  fold_ = 0;
  held_back_.clear();
  fitted_at_ = own;
  if (temperature) loop_.set_temperature(*temperature);
  return temperature.has_value();
}

void LabelSession::ask() {
  proposal_.reset();
  if (!loop_.ready()) return;
  const std::optional<Asked> asked = loop_.propose(opened().config.runtime.seed, asked_++);
  if (!asked) return;
  const PoolPoint& point = loop_.pool().points[static_cast<std::size_t>(asked->point)];
  proposal_ = {.id = fmt::format("q{}", asked_),
               .view = point.view,
               .at = {point.pixel.column + 0.5, point.pixel.row + 0.5},
               .why = std::string(asked->why)};
  if (const std::vector<float>& p = loop_.pool_probability(); !p.empty()) {
    const auto row = p.begin() + std::ptrdiff_t{asked->point} * loop_.classes();
    const std::ptrdiff_t best = std::max_element(row, row + loop_.classes()) - row;
    proposal_->class_guess = opened().plan.class_of_logit[static_cast<std::size_t>(best)];
  }
}

bool LabelSession::still_learns() const {
  return !training_.at_its_end() || (changed_step_ >= 0 && training_.step() < changed_step_ + kAfterChange);
}

bool LabelSession::train(double budget_s, const std::function<bool()>& interrupted) {
  if (!still_learns()) return false;
  const double before = training_.train_s();
  const auto most = static_cast<std::int64_t>(std::clamp(budget_s / std::max(step_s_, 1e-5), 1.0, 256.0));
  std::int64_t made = 0;
  while (made < most) {
    const std::span<const StepLosses> steps = run_->advance(most - made);
    made += std::ssize(steps);
    for (const StepLosses& losses : steps) {
      const double share = mse_ == 0 ? 1 : 0.05;
      mse_ += share * (losses.mse - mse_);
      loss_ += share * (losses.total - loss_);
    }
    if (interrupted && interrupted()) break;
  }
  const double spent = training_.train_s() - before;
  step_s_ = 0.8 * step_s_ + 0.2 * spent / static_cast<double>(made);
  training_s_ += spent;
  rays_per_s_ = static_cast<double>(opened().config.train.rays) / step_s_;
  return true;
}

bool LabelSession::tend(bool looked_at, bool pause, bool quiet) {
  if (training_.step() < kFirstSurface && !training_.at_its_end()) return false;
  const Clock::time_point start = Clock::now();
  const bool trains = still_learns(), was_ready = loop_.ready();
  bool changed = false;
  if (!trains || tending_s_ < (was_ready ? kTendingShare : kFirstTendingShare) * training_s_ + 0.05) {
    changed = loop_.update_surfaces(0.03);
    tending_s_ += seconds_since(start);
  }
  if (!was_ready && loop_.ready()) tending_s_ = kTendingShare * training_s_;  // the first surfaces are paid
  const bool learned = learn_new(kSlice_s);
  changed = changed || learned;
  if (learned || (changed && !proposal_)) ask();
  if (looked_at && (!trains || refining_s_ < kLookedAtShare * training_s_ + 0.05)) {
    const Clock::time_point refined = Clock::now();
    changed = pictures_.refine(0.05) || changed;
    refining_s_ += seconds_since(refined);
  }
  if (unlearned_) {
    if (changed) summarise();
    return changed;
  }
  if (pause && learned_quickly_) {
    loop_.learn(clicks_);
    learned_quickly_ = false;
    changed = true;
  } else if (quiet && loop_.learned()) {
    changed = fit_a_fold() || changed;
    loop_.refresh_places(clicks_, kSlice_s);
  }
  if (changed) summarise();
  return changed;
}

void LabelSession::describe(LabelState& state) const {
  state.name = opened().config.name;
  state.run_dir = run_->run_dir();
  state.device = opened().pipeline->executor().description();
  state.step = training_.step();
  state.train_s = training_.train_s();
  state.loss = loss_;
  state.psnr_db = mse_ > 0 ? -10 * std::log10(mse_) : 0;
  state.rays_per_s = rays_per_s_;
  state.geometry_ready = loop_.ready() && (loop_.learned() || !unlearned_);
  state.temperature = loop_.temperature();
  state.unreached = summary_.unreached;
  state.proposal = proposal_;
  if (state.failure.empty())
    state.phase = !still_learns()   ? "trained; more clicks continue it"
                  : !loop_.ready()  ? "learning colour and geometry"
                  : loop_.learned() ? "learning with your clicks"
                                    : "ready for the first click";
  for (ClassState& cls : state.classes) {
    const auto c = static_cast<std::size_t>(cls.index);
    if (c >= summary_.area.size()) continue;
    cls.area_share = summary_.area[c];
    cls.confidence = summary_.sure[c];
  }
  for (std::size_t v = 0; v < state.views.size(); ++v) {
    state.views[v].ready = state.views[v].held_out ? loop_.ready() : !loop_.views()[v].map.empty();
    if (v < summary_.entropy.size()) state.views[v].entropy = summary_.entropy[v];
  }
}

void LabelSession::summarise() {
  const std::vector<float>& probability = loop_.pool_probability();
  const auto width = static_cast<std::size_t>(loop_.classes());
  const std::size_t points = loop_.pool().points.size();
  std::vector<double> count(static_cast<std::size_t>(opened().classes()), 0), sure(count), entropy(points, 1);
  const double most = loop_.most_entropy();
  for (std::size_t i = 0; i < points && !probability.empty(); ++i) {
    const std::span<const float> row = std::span(probability).subspan(i * width, width);
    const auto best = static_cast<std::size_t>(std::max_element(row.begin(), row.end()) - row.begin());
    const auto cls = static_cast<std::size_t>(opened().plan.class_of_logit[best]);
    count[cls] += 1;
    sure[cls] += static_cast<double>(row[best]);
    entropy[i] = std::min(1.0, entropy_nats(row) / most);
  }
  const std::vector<Settled>& ways = loop_.graph().settled();
  const auto open =
      std::count_if(ways.begin(), ways.end(), [](const Settled& way) { return way.cost[0] >= ProposalRules().unseen; });
  summary_ = {count, sure, {}, points > 0 ? static_cast<double>(open) / static_cast<double>(points) : 1};
  for (std::size_t c = 0; c < count.size(); ++c) {
    summary_.sure[c] = count[c] > 0 ? sure[c] / count[c] : 0;
    summary_.area[c] = points > 0 ? count[c] / static_cast<double>(points) : 0;
  }
  if (probability.empty() && unlearned_) summary_.area.clear();  // so the state's stay
  for (const std::vector<std::int32_t>& seen : loop_.pool().point_of_pixel) {
    double sum = 0, pixels = 0;
    for (const std::int32_t point : seen) {
      if (point < 0) continue;
      sum += entropy[static_cast<std::size_t>(point)];
      pixels += 1;
    }
    summary_.entropy.push_back(pixels > 0 ? sum / pixels : 1);
  }
}

bool LabelSession::keep_is_due() const { return !failed_to_keep_ || seconds_since(*failed_to_keep_) >= kKeepAgain_s; }

void LabelSession::keep(bool checkpoint) {
  failed_to_keep_ = Clock::now();
  run_->write_rows();
  run_->write_classes();
  if (checkpoint || run_->save_is_due()) run_->save();
  failed_to_keep_.reset();
}

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

namespace {

constexpr int kClassRoom = 32;
constexpr auto kPauseAfter = std::chrono::milliseconds(700);
constexpr auto kQuietAfter = std::chrono::seconds(3);
constexpr auto kLookedFor = std::chrono::seconds(10);
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

LabelledRun open_labelling(RunConfig config, Registry& registry, const LabelSessionOptions& options,
                           RunListener* listener) {
  TrainRequest request;
  request.driver = Driver::page;
  request.out_dir = options.run_dir;
  const fs::path folder = fs::absolute(options.run_dir);
  request.resume = fs::exists(folder / "run.yaml");
  LabelParams& labels = config.labels.selection;
  if (labels.clicks.empty()) labels.clicks = (folder / kClickFile).string();
  if (labels.class_room == 0) labels.class_room = options.class_room > 0 ? options.class_room : kClassRoom;
  config.train.ray_source = RaySourceKind::label_balanced;
  // Views of the page are where the files put them, and labels with them.
  if (config.cameras.poses == CameraTrust::automatic) config.cameras.poses = CameraTrust::given;
  Noting noting(listener);
  auto run = std::make_unique<Run>(std::move(config), registry, request, listener, &noting);
  SegmentSet segments;
  if (!options.segments.empty())
    segments = read_segments(options.segments, options.pattern, run->training().session().scene.info);
  return {std::move(run), std::move(noting.warnings), std::move(segments)};
}

}  // namespace

LabelSession::LabelSession(RunConfig config, Registry& registry, const LabelSessionOptions& options,
                           RunListener* listener)
    : LabelSession(open_labelling(std::move(config), registry, options, listener)) {}

LabelSession::LabelSession(LabelledRun labelled_run)
    : run_(std::move(labelled_run.run)),
      training_(run_->training()),
      loop_(training_, opened().drawn_frames(), {}, held_out_frames(opened()), std::move(labelled_run.segments.frames)),
      pictures_(training_, loop_, [this](int view, std::int32_t most_px) { return photo(view, most_px); }),
      view_of_frame_(opened().scene.frames.size(), -1),
      named_(view_of_frame_.size()),
      marked_(view_of_frame_.size(), 0),
      annotations_(*run_->annotations()),
      log_([&] {
        Diagnostics ignored;  // stated when the scene was opened by the file
        return open_click_log(opened().config.labels, run_dir(), ignored);
      }()),
      last_event_(Clock::now() - kQuietAfter),
      last_look_(Clock::now() - kLookedFor) {
  for (std::size_t v = 0; v < loop_.views().size(); ++v)
    view_of_frame_[static_cast<std::size_t>(loop_.views()[v].frame)] = static_cast<int>(v);
  given_ = given_labels();
  auto first = std::make_shared<LabelState>();
  for (const PoolView& view : loop_.views()) {
    const FrameInfo& info = opened().scene.info.frames[static_cast<std::size_t>(view.frame)];
    const std::uint32_t checksum = crc32c(std::as_bytes(std::span(view.photo->rgb)));
    first->views.push_back({info.name, info.camera.width_px, info.camera.height_px, 0, 1, false,
                            fmt::format("{:08x}", checksum), info.split == Split::test});
  }
  first->events = log_.events().size();
  first->notes = std::move(labelled_run.warnings);
  name_classes(*first);
  // Until the surface is known again, what the run knew of it when it stopped.
  if (const std::string path = run_->folder()->labelling_path(); fs::is_regular_file(path))
    for (const LabellingRecord::Class& one : parse_labelling_record(read_text_file(path), path).classes)
      for (ClassState& cls : first->classes)
        if (cls.id == one.id) std::tie(cls.area_share, cls.confidence) = std::tie(one.area_share, one.confidence);
  describe(*first);
  first->revision = 1;
  state_ = std::move(first);
}

void LabelSession::poke() {
  poked_ = true;
  wanted_.notify_all();
}

template <class Change>
void LabelSession::publish(const Change& change) {
  const std::lock_guard lock(mutex_);
  auto next = std::make_shared<LabelState>(*state_);
  change(*next);
  ++next->revision;
  state_ = std::move(next);
  changed_.notify_all();
}

// An event that `run_` does not know yet, or a picture.
bool LabelSession::is_waited_for() const {
  const std::lock_guard lock(mutex_);
  return (taken_events_ && *taken_events_ < state_->events) ||
         std::any_of(orders_.begin(), orders_.end(), [](const auto& order) { return !order->done(); });
}

// Classes, marks and counts, from `annotations_`.
void LabelSession::name_classes(LabelState& next) const {
  const std::vector<ClassState> before = std::move(next.classes);
  next.classes.clear();
  const ClassTable& table = annotations_.classes();
  for (int c = 0; c < annotations_.named_classes(); ++c) {
    if (!annotations_.is_named(c)) continue;
    const ClassEntry& entry = table.valid(c);
    ClassState cls;
    const auto known =
        std::find_if(before.begin(), before.end(), [&](const ClassState& old) { return old.index == c; });
    if (known != before.end()) cls = *known;
    cls.index = c;
    cls.id = entry.id;
    cls.name = entry.name;
    cls.color = entry.color;
    cls.own = c < annotations_.own_classes();
    cls.clicks = 0;
    next.classes.push_back(cls);
  }
  for (ViewState& view : next.views) view.clicks = 0;
  next.marks = annotations_.marks();
  for (const Annotations::Mark& mark : next.marks) {
    const auto cls = std::find_if(next.classes.begin(), next.classes.end(),
                                  [&](const ClassState& c) { return c.index == mark.class_index; });
    if (cls != next.classes.end()) ++cls->clicks;
    if (const int view = view_of(mark.frame); view >= 0) ++next.views[static_cast<std::size_t>(view)].clicks;
  }
  next.named = static_cast<int>(next.classes.size());
  next.room = table.valid_count();
}

bool LabelSession::apply(const LabelEvent& event) {
  const std::lock_guard events(events_mutex_);
  if (!annotations_.check(event)) return false;
  log_.append(event);
  annotations_.apply(event);
  publish([&](LabelState& next) {
    next.events = log_.events().size();
    name_classes(next);
    if (event.kind == LabelEventKind::click || event.kind == LabelEventKind::skip) next.proposal.reset();
  });
  const std::lock_guard lock(mutex_);
  last_event_ = Clock::now();
  poke();
  return true;
}

std::shared_ptr<const LabelState> LabelSession::state() const {
  const std::lock_guard lock(mutex_);
  return state_;
}

std::shared_ptr<const LabelState> LabelSession::wait_state(std::uint64_t after, std::chrono::milliseconds most) const {
  std::unique_lock lock(mutex_);
  changed_.wait_for(lock, most, [&] { return state_->revision > after || stopping_; });
  return state_;
}

Picture LabelSession::picture(const PictureRequest& request, const std::function<bool()>& abandoned) {
  const auto order = std::make_shared<Order>();
  order->request = request;
  std::unique_lock lock(mutex_);
  Picture none;
  none.stale = true;
  std::vector<std::shared_ptr<Order>> others;
  for (const std::shared_ptr<Order>& other : orders_) {
    if (other->done()) continue;
    if (other->request.client == request.client) {
      other->made = none;
    } else {
      others.push_back(other);
    }
  }
  if (others.size() >= kMostOrders) others.front()->made = none;
  if (stopping_ || ended_) return none;
  orders_.push_back(order);
  last_look_ = Clock::now();
  changed_.notify_all();
  poke();
  while (!changed_.wait_for(lock, kAbandonedLook, [&] { return order->done() || ended_; }))
    if (abandoned && abandoned()) order->made = none;
  std::erase(orders_, order);
  if (order->error) throw *order->error;
  return order->made ? std::move(*order->made) : none;
}

Image<std::uint8_t> LabelSession::photo(int view, std::int32_t most_px) {
  const int frame = frame_of(view);
  const StoredFrame& trained = opened().scene.frames.at(static_cast<std::size_t>(frame));
  if (most_px > 0 && most_px <= std::max(trained.width_px, trained.height_px))
    return {trained.width_px, trained.height_px, 3, trained.rgb};
  const std::lock_guard lock(photo_mutex_);
  if (!dataset_) dataset_ = open_dataset();
  if (kept_frame_ == frame) return kept_photo_;
  FrameBuffer buffer;
  dataset_->read(frame, buffer);
  kept_photo_ = {buffer.width_px, buffer.height_px, 3, std::move(buffer.rgb)};
  kept_frame_ = frame;
  return kept_photo_;
}

std::unique_ptr<Dataset> LabelSession::open_dataset() const {
  const RunConfig& config = opened().config;
  DatasetBuild build;
  build.config_dir = config.base_dir;
  std::unique_ptr<Dataset> dataset = config.dataset.entry->dataset(*config.dataset.params, build);
  Diagnostics found;
  const SceneInfo info = dataset->open(found);
  found.throw_if_errors(ErrorKind::data, "the photographs cannot be read any more:");
  const std::vector<FrameInfo>& loaded = opened().scene.info.frames;
  if (!std::equal(info.frames.begin(), info.frames.end(), loaded.begin(), loaded.end(),
                  [](const FrameInfo& a, const FrameInfo& b) { return a.name == b.name; }))
    throw Error(ErrorKind::data, "scene.frames.changed", "the scene's files list other frames than were loaded",
                "start semfield serve again");
  return dataset;
}

void LabelSession::save() {
  std::unique_lock lock(mutex_);
  const std::uint64_t mine = ++saves_wanted_;
  poke();
  changed_.wait(lock, [&] { return saves_made_ >= mine || ended_; });
  if (saves_made_ < mine && !state_->failure.empty())
    throw Error(ErrorKind::failure, "serve.training.failed", "training has ended with an error: " + state_->failure);
  if (save_error_) throw *save_error_;
}

void LabelSession::stop() {
  const std::lock_guard lock(mutex_);
  stopping_ = true;
  poke();
  changed_.notify_all();
}

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
void LabelSession::take_events() {
  std::optional<Annotations> now;
  std::uint64_t events = 0;
  {
    const std::lock_guard lock(events_mutex_);
    events = log_.events().size();
    if (events == taken_events_) return;
    now = annotations_;
  }
  taken_events_ = events;
  take(*now);
  publish_learned(true);
}

// What `run_` has come to; `labels`: those of views are other ones.
void LabelSession::publish_learned(bool labels) {
  publish([&](LabelState& next) {
    describe(next);
    if (knows_all() && taken_events_) next.overlay_events = *taken_events_;
    if (labels) next.overlay_revision = next.revision + 1;
  });
}

void LabelSession::serve_orders() {
  std::shared_ptr<Order> order;
  std::uint64_t overlay = 0;
  {
    const std::lock_guard lock(mutex_);
    const auto first = std::find_if(orders_.begin(), orders_.end(), [](const auto& o) { return !o->done(); });
    if (first == orders_.end()) return;
    order = *first;
    overlay = state_->overlay_revision;
  }
  std::optional<Picture> made;
  std::optional<Error> error = error_of([&] { made = pictures_.make(order->request); });
  if (made) made->overlay_revision = overlay;
  const std::lock_guard lock(mutex_);
  if (order->done()) return;
  order->made = std::move(made);
  order->error = std::move(error);
  changed_.notify_all();
}

void LabelSession::save_if_wanted() {
  std::uint64_t wanted_now = 0;
  {
    const std::lock_guard lock(mutex_);
    wanted_now = saves_wanted_;
    if (wanted_now == saves_made_ && (failure_ || !keep_is_due())) return;
    if (wanted_now != saves_made_ && !failure_ && !stopping_ && !knows_all()) return;  // soon it does
  }
  std::optional<Error> error = error_of([&] {
    keep(wanted_now != saves_made_);
    if (wanted_now != saves_made_) write_record(*state());
  });
  const bool passes = error && is_write_error(*error);
  if (error && !passes && wanted_now == saves_made_) return fail(*error);
  const std::string trouble = passes ? shown(*error) : "";
  if (trouble != trouble_told_) publish([&](LabelState& next) { next.trouble = trouble; });
  trouble_told_ = trouble;
  const std::lock_guard lock(mutex_);
  save_error_ = std::move(error);
  saves_made_ = wanted_now;
  changed_.notify_all();
}

template <class Work>
void LabelSession::attempt(const Work& work) {
  if (const std::optional<Error> error = error_of(work)) fail(*error);
}

void LabelSession::fail(const Error& error) {
  failure_ = error;
  publish([&](LabelState& next) {
    next.failure = shown(error);
    next.phase = "training has ended with an error; labels are stored";
  });
}

void LabelSession::run() {
  // However it ends, whoever waits gets a response.
  const std::unique_ptr<LabelSession, void (*)(LabelSession*)> ending(this, [](LabelSession* session) {
    const std::lock_guard lock(session->mutex_);
    session->ended_ = true;
    session->changed_.notify_all();
  });
  Clock::time_point published = Clock::now();
  const auto asked_to_stop = [&] {
    const std::lock_guard lock(mutex_);
    return stopping_;
  };
  bool untold = false;  // something has changed since the state was published
  int hurries = 0;
  while (!asked_to_stop()) {
    bool busy = false, overlay = false;
    attempt([&] { take_events(); });
    serve_orders();
    save_if_wanted();
    if (!failure_) {
      attempt([&] {
        busy = train(kTurn_s, [&] { return is_waited_for(); });
        if (is_waited_for() && ++hurries <= kMostHurries) return;
        hurries = 0;
        std::unique_lock lock(mutex_);
        const Clock::time_point now = Clock::now();
        const bool looked_at = now - last_look_ < kLookedFor;
        const Clock::duration quiet = now - last_event_;
        lock.unlock();
        overlay = tend(looked_at, quiet > kPauseAfter, quiet > kQuietAfter);
      });
    }
    untold = untold || busy || overlay;
    if (untold && (overlay || !busy || Clock::now() - published >= kPublishEvery)) {
      publish_learned(overlay);
      published = Clock::now();
      untold = false;
    }
    if (busy || overlay) continue;
    std::unique_lock lock(mutex_);
    wanted_.wait_for(lock, kIdle, [&] { return poked_; });
    poked_ = false;
  }
  attempt([&] { take_events(); });
  if (failure_) return;
  keep(true);
  write_record(*state());
}

// What a session leaves in its run's folder for the report: labelling.json and pictures of the frames with most clicks.

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
  const PoolView& pool_view = loop.view(view);
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

void LabelSession::write_record(LabelState state) {
  describe(state);
  const RunFolder& folder = *run_->folder();
  const Session& session = opened();
  LabellingRecord record;
  record.step = state.step;
  record.clicks = std::ssize(state.marks);
  record.frames = std::ssize(loop_.pooled());
  for (const ClassState& c : state.classes)
    record.classes.push_back({c.id, c.name, c.color, c.clicks, c.area_share, c.confidence});
  std::map<int, std::vector<const Mark*>> of_frame;
  for (const Mark& mark : state.marks) of_frame[mark.frame].push_back(&mark);
  record.clicked_frames = std::ssize(of_frame);
  const auto marks_of = [&](int view) -> const auto& { return of_frame[loop_.view(view).frame]; };
  std::vector<int> views(loop_.pooled().size());
  std::iota(views.begin(), views.end(), 0);
  std::stable_sort(views.begin(), views.end(), [&](int a, int b) { return marks_of(a).size() > marks_of(b).size(); });
  for (const int view : views) {
    if (marks_of(view).empty() || record.shown.size() == kShown) break;
    write_pictures(folder, session, loop_, view, marks_of(view));
    const auto frame = static_cast<std::size_t>(loop_.view(view).frame);
    record.shown.push_back({session.scene.info.frames[frame].name, std::ssize(marks_of(view))});
  }
  write_file_atomic(folder.labelling_path(), labelling_record_json(record));
}

}  // namespace semfield
