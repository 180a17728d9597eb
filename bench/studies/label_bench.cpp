#include "studies/label_bench.h"

#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <filesystem>

#include "core/rng.h"
#include "eval/metrics.h"

namespace semfield {

namespace {

using Clock = std::chrono::steady_clock;
double ms_since(Clock::time_point start) { return 1e3 * std::chrono::duration<double>(Clock::now() - start).count(); }

constexpr double kHeldOutPoints = 40'000;
constexpr const char* kPerson = "label_bench/random_pixel";
constexpr std::uint64_t kMostRounds = 10'000;  // of questions, those about void pixels included

// Points of the held-out views, with the truth.
class HeldOut {
 public:
  explicit HeldOut(Training& training) : training_(training) {}

  void update(PointLearner& learner) {
    const Session& s = training_.session();
    const std::vector<int> frames = s.scene.frames_of(Split::test);
    double pixels = 0;
    for (const int f : frames) {
      const Camera& camera = s.scene.info.frames[static_cast<std::size_t>(f)].camera;
      pixels += static_cast<double>(camera.width_px) * camera.height_px;
    }
    const auto stride = static_cast<std::int32_t>(std::ceil(std::sqrt(pixels / kHeldOutPoints)));
    places_.clear();
    truth_.clear();
    for (const int f : frames) {
      const FrameInfo& info = s.scene.info.frames[static_cast<std::size_t>(f)];
      const StoredFrame& frame = s.scene.frames[static_cast<std::size_t>(f)];
      if (frame.label.empty()) continue;
      const RayCamera camera{info.camera, info.world_from_camera, s.plan.undistortion};
      const SurfaceMap map = make_surface_map(*s.pipeline, camera, s.limits, stride, training_.step());
      for (std::size_t i = 0; i < map.distance_m.size(); ++i) {
        const PixelPlace pixel = strided_place(static_cast<std::int64_t>(i), map.width_px, map.stride);
        truth_.push_back(
            frame.label[static_cast<std::size_t>(std::int64_t{pixel.row} * frame.width_px + pixel.column)]);
        places_.push_back(point_at(camera, s.limits, pixel, static_cast<double>(map.distance_m[i])));
      }
    }
    if (places_.empty())
      throw Error(ErrorKind::data, "study.scene.unlabelled",
                  s.config.name + ": no held-out view has labels, so nothing can be compared",
                  "choose a scene with a test split and labels");
    rows_ = learner.rows_at(places_);
  }

  std::vector<float> probabilities(LabelLoop& loop, double temperature) const {
    return loop.probabilities(rows_, places_, temperature);
  }

  double miou(const std::vector<float>& probability) const {
    const Session& s = training_.session();
    ConfusionMatrix confusion(s.classes());
    std::vector<std::int16_t> predicted(truth_.size());
    const std::size_t width = probability.size() / truth_.size();
    for (std::size_t i = 0; i < predicted.size(); ++i) {
      const float* const row = &probability[i * width];
      predicted[i] = static_cast<std::int16_t>(
          s.plan.class_of_logit[static_cast<std::size_t>(std::max_element(row, row + width) - row)]);
    }
    confusion.add(truth_, predicted);
    return confusion.miou_present().value_or(0);
  }

  double ece(const std::vector<float>& probability) const {
    const Session& s = training_.session();
    const std::vector<std::int16_t> logit_of_class = s.logit_of_class();
    std::vector<std::int16_t> truth(truth_.size(), kVoid);
    for (std::size_t i = 0; i < truth.size(); ++i)
      if (truth_[i] >= 0) truth[i] = logit_of_class[static_cast<std::size_t>(truth_[i])];
    Calibration calibration;
    calibration.add(probability, static_cast<int>(probability.size() / truth_.size()), truth);
    return calibration.ece().value_or(0);
  }

 private:
  Training& training_;
  PointRows rows_;
  std::vector<Vec3d> places_;
  std::vector<std::int16_t> truth_;
};

struct Place {
  int view = 0;
  PixelPlace pixel;
};

// Any pixel of any view, by address.
Place random_pixel(const LabelLoop& loop, std::uint64_t seed, std::uint64_t draw) {
  const RandomAddress address{seed, draw, stream_id(kPerson)};
  const auto view = uniform_below(address, 0, loop.views().size());
  const StoredFrame& photo = *loop.views()[view].photo;
  return {static_cast<int>(view),
          {static_cast<std::int32_t>(uniform_below(address, 1, static_cast<std::uint64_t>(photo.width_px))),
           static_cast<std::int32_t>(uniform_below(address, 2, static_cast<std::uint64_t>(photo.height_px)))}};
}

// A scene whose geometry is learned, and the persons that label it one after the other.
class Labelled {
 public:
  Labelled(RunConfig config, const LabelBenchOptions& options, const StudyTools& tools)
      : options_(options), tools_(tools), training_(std::move(config), tools.registry), held_out_(training_) {
    while (training_.train_s() < options.geometry_s) (void)training_.advance(50);
    loop_.emplace(training_, session().drawn_frames(), LabelLoopOptions{});
    if (options.between_s > 0) start_ = save_start();
    see();
    tools.note(fmt::format(
        "{}: {} steps of colour and geometry in {:.1f} s, training PSNR {:.2f} dB; {} views, {} points of the surface",
        name(), training_.step(), training_.train_s(), -10 * std::log10(training_.losses().mse), loop_->views().size(),
        loop_->pool().points.size()));
  }
  ~Labelled() {
    std::error_code ignored;
    if (!start_.empty()) std::filesystem::remove_all(start_.parent_path(), ignored);
  }
  Labelled(const Labelled&) = delete;
  Labelled& operator=(const Labelled&) = delete;

  LabelCourse course(Acquisition how, int seed) {
    restart();
    LabelCourse course{name(), how, seed, {}, {}, {}, {}};
    std::vector<LabelledPixels> clicks, skipped;
    std::vector<bool> seen(static_cast<std::size_t>(session().classes()), false);
    for (std::uint64_t round = 0; std::ssize(clicks) < options_.most_clicks && round < kMostRounds; ++round) {
      const Clock::time_point asked = Clock::now();
      const Place place = question(how, static_cast<std::uint64_t>(seed), round);
      course.proposal_ms.push_back(ms_since(asked));
      const std::int16_t truth = truth_at(place);
      if (truth == kVoid) {
        skipped.push_back({place.view, 0, {place.pixel}});
        loop_->set_skipped(skipped);
        continue;
      }
      clicks.push_back({place.view, truth, {place.pixel}});
      seen[static_cast<std::size_t>(truth)] = true;
      const Clock::time_point clicked = Clock::now();
      loop_->learn(clicks);
      course.learn_ms.push_back(ms_since(clicked));
      course.miou.push_back(held_out_.miou(held_out_.probabilities(*loop_, 1)));
      course.classes.push_back(static_cast<int>(std::count(seen.begin(), seen.end(), true)));
      train_with(clicks.back());
    }
    course.ece_before = held_out_.ece(held_out_.probabilities(*loop_, 1));
    std::vector<HeldBack> held_back;
    for (int fold = 0; fold < kCalibrationFolds; ++fold)
      for (HeldBack& click : loop_->hold_back(clicks, fold)) held_back.push_back(std::move(click));
    course.temperature = fit_temperature(held_back).value_or(1);
    course.ece_after = held_out_.ece(held_out_.probabilities(*loop_, course.temperature));
    return course;
  }

 private:
  const Session& session() const { return training_.session(); }
  const std::string& name() const { return session().config.name; }

  std::filesystem::path save_start() {
    const std::filesystem::path folder =
        std::filesystem::temp_directory_path() /
        fmt::format("semfield_bench_label_{}", Clock::now().time_since_epoch().count());
    std::filesystem::create_directories(folder);
    training_.save((folder / "start.safetensors").string());
    return folder / "start.safetensors";
  }

  void see() {
    while (!loop_->update_surfaces(1e9) && !loop_->ready()) {
    }
    held_out_.update(loop_->learner());
  }

  void restart() {
    for (const int frame : clicked_) {
      const Camera& camera = session().scene.info.frames[static_cast<std::size_t>(frame)].camera;
      const auto pixels = static_cast<std::size_t>(std::int64_t{camera.width_px} * camera.height_px);
      training_.set_labels(frame, std::vector<std::int16_t>(pixels, kVoid));
    }
    clicked_.clear();
    if (!start_.empty()) {
      training_.load(start_.string());
      loop_.emplace(training_, session().drawn_frames(), LabelLoopOptions{});
      see();
    }
    loop_->learn({});
    loop_->set_skipped({});
  }

  Place question(Acquisition how, std::uint64_t seed, std::uint64_t round) const {
    if (how != Acquisition::random) {
      if (const std::optional<Asked> asked = loop_->propose(how, seed, round)) {
        const PoolPoint& point = loop_->pool().points[static_cast<std::size_t>(asked->point)];
        return {point.view, point.pixel};
      }
    }
    return random_pixel(*loop_, seed, round);
  }

  std::int16_t truth_at(const Place& place) const {
    const StoredFrame& photo = *loop_->views()[static_cast<std::size_t>(place.view)].photo;
    if (photo.label.empty()) return kVoid;
    return photo.label[static_cast<std::size_t>(std::int64_t{place.pixel.row} * photo.width_px + place.pixel.column)];
  }

  void train_with(const LabelledPixels& click) {
    if (!(options_.between_s > 0)) return;
    const int frame = loop_->views()[static_cast<std::size_t>(click.view)].frame;
    const Camera& camera = session().scene.info.frames[static_cast<std::size_t>(frame)].camera;
    std::vector<std::int16_t> labels = session().labels.frames[static_cast<std::size_t>(frame)].hard.expand();
    labels.resize(static_cast<std::size_t>(std::int64_t{camera.width_px} * camera.height_px), kVoid);
    for (const PixelPlace& pixel : click.pixels)
      labels[static_cast<std::size_t>(std::int64_t{pixel.row} * camera.width_px + pixel.column)] = click.class_index;
    training_.set_labels(frame, std::move(labels));
    clicked_.push_back(frame);
    const double until = training_.train_s() + options_.between_s;
    while (training_.train_s() < until) (void)training_.advance(20);
    if (loop_->update_surfaces(1e9)) held_out_.update(loop_->learner());
  }

  LabelBenchOptions options_;
  const StudyTools& tools_;
  Training training_;
  HeldOut held_out_;
  std::optional<LabelLoop> loop_;
  std::filesystem::path start_;
  std::vector<int> clicked_;  // frames
};

}  // namespace

std::optional<int> LabelCourse::clicks_to(double level) const {
  const auto found = std::find_if(miou.begin(), miou.end(), [&](double value) { return value >= level; });
  if (found == miou.end()) return std::nullopt;
  return static_cast<int>(found - miou.begin()) + 1;
}

std::vector<LabelCourse> measure_labelling(RunConfig config, const LabelBenchOptions& options,
                                           const StudyTools& tools) {
  config.labels.selection.frames = "none";
  config.labels.selection.class_room = std::max(config.labels.selection.class_room, 1);
  const auto first_seed = static_cast<int>(config.runtime.seed);
  Labelled labelled(std::move(config), options, tools);
  std::vector<LabelCourse> courses;
  for (int seed = first_seed; seed < first_seed + options.seeds; ++seed) {
    for (const Acquisition how : options.strategies) {
      courses.push_back(labelled.course(how, seed));
      const LabelCourse& done = courses.back();
      const auto at = [&](std::size_t clicks) { return done.miou.size() >= clicks ? done.miou[clicks - 1] : NAN; };
      tools.note(fmt::format(
          "{} {} {}: mIoU {:.3f} after 10 clicks, {:.3f} after 30, {:.3f} after 60, {:.3f} after {}; "
          "{} classes; ECE {:.3f} -> {:.3f} at temperature {:.2f}",
          done.scene, ChoiceNames<Acquisition>::names[static_cast<std::size_t>(how)], seed, at(10), at(30), at(60),
          done.miou.empty() ? NAN : done.miou.back(), done.miou.size(), done.classes.empty() ? 0 : done.classes.back(),
          done.ece_before, done.ece_after, done.temperature));
    }
  }
  return courses;
}

}  // namespace semfield
