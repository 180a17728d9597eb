#include "serve/label_run.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <functional>
#include <iterator>

#include "eval/metrics.h"
#include "serve/label_session.h"
#include "serve/view_pictures.h"

namespace semfield {

namespace {

constexpr std::int64_t kFirstSurface = 150;  // steps before geometry is looked at
constexpr std::int64_t kAfterChange = 300;   // steps that labels get which came when training had ended
constexpr double kTendingShare = 0.05;       // of the time of training, once every view has a surface
constexpr double kFirstTendingShare = 0.5;   // until then
constexpr double kLookedAtShare = 0.5;       // of the time of training, for the view that somebody looks at
constexpr double kSlice_s = 0.03;            // of work on clicks, between steps of training
constexpr std::size_t kLeastToFit = 10;      // clicks; and half as many again as at the last fit
constexpr std::size_t kMostHistory = 600;
constexpr double kHistoryEvery_s = 1;
constexpr double kKeepAgain_s = 5;        // after files could not be written
constexpr std::size_t kGivenPixels = 48;  // of a class in a frame whose labels the configuration gives
constexpr std::size_t kMostGiven = 6000;
constexpr double kGivenWeight = 0.1;  // where a click is 1: who clicks beside given labels corrects them

double seconds_since(std::chrono::steady_clock::time_point start) {
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

std::uint64_t mix(std::uint64_t hash, std::uint64_t value) { return (hash ^ value) * 0x100000001B3ull; }

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

LabelRun::LabelRun(std::unique_ptr<Run> run)
    : run_(std::move(run)),
      training_(run_->training()),
      loop_(training_, training_.session().drawn_frames(), {}, held_out_frames(training_.session())),
      pictures_(training_, loop_) {
  view_of_frame_.assign(session().scene.frames.size(), -1);
  for (std::size_t v = 0; v < loop_.views().size(); ++v)
    view_of_frame_[static_cast<std::size_t>(loop_.views()[v].frame)] = static_cast<int>(v);
  marked_.assign(session().scene.frames.size(), 0);
  named_.resize(session().scene.frames.size());
  given_ = given_labels();
}

// Pixels that the configuration's own labels name, some of every class in every frame.
std::vector<LabelledPixels> LabelRun::given_labels() const {
  std::vector<LabelledPixels> out;
  std::size_t total = 0;
  for (std::size_t v = 0; v < loop_.pooled().size() && total < kMostGiven; ++v) {
    const auto frame = static_cast<std::size_t>(loop_.views()[v].frame);
    if (frame >= session().labels.unclicked.size()) continue;
    const TrainingLabels::Frame& labels = session().labels.unclicked[frame];
    if (labels.empty()) continue;
    std::vector<std::vector<std::uint32_t>> of(static_cast<std::size_t>(session().classes()));
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

void LabelRun::name_pixels(const Annotations& annotations, std::span<const int> changed) {
  std::vector<std::vector<std::int16_t>> painted(view_of_frame_.size());
  for (const int f : changed) named_[static_cast<std::size_t>(f)].clear();
  for (const Annotations::Mark& mark : annotations.marks()) {
    const auto frame = static_cast<std::size_t>(mark.frame);
    if (mark.class_index == kVoid || view_of_frame_[frame] < 0 ||
        std::find(changed.begin(), changed.end(), mark.frame) == changed.end())
      continue;
    if (painted[frame].empty()) painted[frame] = annotations.paint(mark.frame, {});
    const Camera& camera = session().scene.info.frames[frame].camera;
    LabelledPixels named{view_of_frame_[frame], static_cast<std::int16_t>(mark.class_index),
                         pixels_of(mark, camera.width_px, camera.height_px, painted[frame])};
    if (!named.pixels.empty()) named_[frame].push_back(std::move(named));
  }
  clicks_ = given_;
  for (const std::vector<LabelledPixels>& of_frame : named_)
    clicks_.insert(clicks_.end(), of_frame.begin(), of_frame.end());
}

void LabelRun::ignore_pixels(const Annotations& annotations, std::span<const int> frames) {
  for (const int frame : frames) {
    const auto f = static_cast<std::size_t>(frame);
    if (view_of_frame_[f] < 0) continue;
    const Camera& camera = session().scene.info.frames[f].camera;
    std::vector<std::int16_t> labels(static_cast<std::size_t>(std::int64_t{camera.width_px} * camera.height_px), 0);
    std::vector<bool> ignored;
    if (annotations.clear_ignored(frame, camera.width_px, camera.height_px, labels))
      std::transform(labels.begin(), labels.end(), std::back_inserter(ignored),
                     [](std::int16_t l) { return l == kVoid; });
    loop_.set_ignored(view_of_frame_[f], std::move(ignored));
  }
}

void LabelRun::take(const Annotations& annotations) {
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
  marks_ = annotations.marks().size();
  pictures_.set_marks(annotations.marks(), view_of_frame_);
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
    for (const Annotations::Mark& mark : annotations.skips()) {
      const auto frame = static_cast<std::size_t>(mark.frame);
      const Camera& camera = session().scene.info.frames[frame].camera;
      if (view_of_frame_[frame] >= 0)
        skipped.push_back({view_of_frame_[frame], 0, pixels_of(mark, camera.width_px, camera.height_px)});
    }
    loop_.set_skipped(std::move(skipped));
  }
  summarise();
  ask();
}

bool LabelRun::learn_new(double budget_s) {
  if (!unlearned_ || !loop_.ready() || !loop_.find_places(clicks_, budget_s)) return false;
  loop_.learn(clicks_, true);
  unlearned_ = false;
  learned_quickly_ = true;
  return true;
}

// True when the temperature has changed.
bool LabelRun::fit_a_fold() {
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

void LabelRun::ask() {
  proposal_.reset();
  if (!loop_.ready()) return;
  const std::optional<Asked> asked = loop_.propose(Acquisition::surface, session().config.runtime.seed, asked_++);
  if (!asked) return;
  const PoolPoint& point = loop_.pool().points[static_cast<std::size_t>(asked->point)];
  ProposalState proposal;
  proposal.id = fmt::format("q{}", asked_);
  proposal.view = point.view;
  proposal.at = {point.pixel.column + 0.5, point.pixel.row + 0.5};
  proposal.why = asked->why;
  if (const std::vector<float>& p = loop_.pool_probability(); !p.empty()) {
    const auto row = p.begin() + std::ptrdiff_t{asked->point} * loop_.classes();
    const std::ptrdiff_t best = std::max_element(row, row + loop_.classes()) - row;
    proposal.class_guess = session().plan.class_of_logit[static_cast<std::size_t>(best)];
  }
  proposal_ = std::move(proposal);
}

bool LabelRun::still_learns() const {
  return !training_.at_its_end() || (changed_step_ >= 0 && training_.step() < changed_step_ + kAfterChange);
}

bool LabelRun::train(double budget_s, const std::function<bool()>& interrupted) {
  if (!still_learns()) return false;
  const double before = training_.train_s();
  const auto most = static_cast<std::int64_t>(std::clamp(budget_s / std::max(step_s_, 1e-5), 1.0, 256.0));
  std::int64_t made = 0;
  while (made < most) {
    const std::span<const StepLosses> steps = run_->advance(most - made);
    made += std::ssize(steps);
    show(steps);
    if (interrupted && interrupted()) break;
  }
  const double spent = training_.train_s() - before;
  step_s_ = 0.8 * step_s_ + 0.2 * spent / static_cast<double>(made);
  training_s_ += spent;
  rays_per_s_ = static_cast<double>(session().config.train.rays) / step_s_;
  return true;
}

void LabelRun::show(std::span<const StepLosses> steps) {
  for (const StepLosses& losses : steps) {
    const double share = mse_ == 0 ? 1 : 0.05;
    mse_ += share * (losses.mse - mse_);
    loss_ += share * (losses.total - loss_);
  }
  if (!history_.empty() && training_.train_s() - history_.back().train_s < kHistoryEvery_s) return;
  history_.push_back({training_.train_s(), loss_, -10 * std::log10(mse_), static_cast<int>(marks_)});
  if (history_.size() <= kMostHistory) return;
  for (std::size_t i = 0; 2 * i + 1 < history_.size(); ++i) history_[i] = history_[2 * i + 1];
  history_.resize(history_.size() / 2);
}

bool LabelRun::tend(bool looked_at, bool pause, bool quiet) {
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

void LabelRun::describe(LabelState& state) const {
  state.name = session().config.name;
  state.run_dir = run_->run_dir();
  state.device = session().pipeline->executor().description();
  state.step = training_.step();
  state.train_s = training_.train_s();
  state.loss = loss_;
  state.psnr_db = mse_ > 0 ? -10 * std::log10(mse_) : 0;
  state.rays_per_s = rays_per_s_;
  state.geometry_ready = loop_.ready() && (loop_.learned() || !unlearned_);
  state.temperature = loop_.temperature();
  state.proposal = proposal_;
  state.history = history_;
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

void LabelRun::summarise() {
  const std::vector<float>& probability = loop_.pool_probability();
  const auto width = static_cast<std::size_t>(loop_.classes());
  const std::size_t points = loop_.pool().points.size();
  std::vector<double> count(static_cast<std::size_t>(session().classes()), 0), sure(count), entropy(points, 1);
  const double most = std::log(
      static_cast<double>(std::max<std::ptrdiff_t>(2, std::count(loop_.live().begin(), loop_.live().end(), true))));
  for (std::size_t i = 0; i < points && !probability.empty(); ++i) {
    const std::span<const float> row = std::span(probability).subspan(i * width, width);
    const auto best = static_cast<std::size_t>(std::max_element(row.begin(), row.end()) - row.begin());
    const auto cls = static_cast<std::size_t>(session().plan.class_of_logit[best]);
    count[cls] += 1;
    sure[cls] += static_cast<double>(row[best]);
    entropy[i] = std::min(1.0, entropy_nats(row) / most);
  }
  summary_ = {count, sure, {}};
  for (std::size_t c = 0; c < count.size(); ++c) {
    summary_.sure[c] = count[c] > 0 ? sure[c] / count[c] : 0;
    summary_.area[c] = points > 0 ? count[c] / static_cast<double>(points) : 0;
  }
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

void LabelRun::write_record(LabelState state) {
  describe(state);
  write_session_record(folder(), session(), loop_, state);
}

bool LabelRun::keep_is_due() const { return !failed_to_keep_ || seconds_since(*failed_to_keep_) >= kKeepAgain_s; }

void LabelRun::keep(bool checkpoint) {
  failed_to_keep_ = Clock::now();
  run_->write_rows();
  run_->write_classes();
  if (checkpoint || run_->save_is_due()) run_->save();
  failed_to_keep_.reset();
}

}  // namespace semfield
