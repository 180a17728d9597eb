#include "app/bench/step_case.h"

#include <algorithm>
#include <chrono>
#include <cmath>

#include "compute/parallel.h"
#include "core/check.h"
#include "core/rng.h"
#include "model/param_store.h"
#include "train/assembly.h"

namespace semfield {

namespace {

constexpr int kFrames = 8;
constexpr std::int32_t kWidth = 64, kHeight = 48;

// A proper rotation: a unit quaternion, uniform over the sphere.
Pose random_pose(const RandomAddress& where, std::uint64_t frame) {
  const auto u = [&](std::uint64_t i) { return static_cast<double>(uniform01(where, 8 * frame + i)); };
  const double a = std::sqrt(1 - u(0)), b = std::sqrt(u(0)), s = 2 * M_PI * u(1), t = 2 * M_PI * u(2);
  const double x = a * std::sin(s), y = a * std::cos(s), z = b * std::sin(t), w = b * std::cos(t);
  Pose pose;
  pose.r = {{{1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)},
             {2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)},
             {2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)}}};
  pose.t = {0.5 * u(3) - 0.25, 0.5 * u(4) - 0.25, 0.5 * u(5) - 0.25};
  return pose;
}

FrameBuffer random_frame(std::uint64_t number, int classes) {
  FrameBuffer frame;
  frame.width_px = kWidth;
  frame.height_px = kHeight;
  const std::size_t pixels = std::size_t{kWidth} * kHeight;
  frame.rgb.resize(3 * pixels);
  const RandomAddress color{1, number, stream_id("step_bench/color")};
  for (std::size_t i = 0; i < frame.rgb.size(); ++i)
    frame.rgb[i] = static_cast<std::uint8_t>(uniform_below(color, i, 256));
  if (classes == 0) return frame;
  frame.label.resize(pixels);
  const RandomAddress label{1, number, stream_id("step_bench/label")};
  for (std::size_t i = 0; i < pixels; ++i) {
    frame.label[i] = static_cast<std::int16_t>(uniform_below(label, i, static_cast<std::uint64_t>(classes)));
  }
  return frame;
}

SceneManifest manifest_of(int classes) {
  SceneManifest manifest;
  manifest.classes = classes;
  manifest.train_frames = manifest.labelled_frames = kFrames;
  manifest.train_pixels = std::int64_t{kFrames} * kWidth * kHeight;
  manifest.train_class_pixels.assign(static_cast<std::size_t>(classes),
                                     classes == 0 ? 0 : std::max<std::int64_t>(manifest.train_pixels / classes, 1));
  return manifest;
}

}  // namespace

StepCase::StepCase(const StepCaseOptions& options, Registry& registry) {
  RunConfig& config = session_.config = load_run_config(options.config, options.set, registry);
  config.train.rays = options.rays;
  config.train.ray_source = RaySourceKind::all_images;
  config.adam.learning_rate =
      0;  // random pictures have no shape to learn: in hundreds of steps their density would die
  SceneExtent extent;
  extent.bounds = {{-0.5, -0.5, -0.5}, {0.5, 0.5, 0.5}};
  extent.near_m = 0.05;
  extent.far_m = 1;
  extent.pixel_footprint_m = 0.01;
  config.runtime.threads = 0;  // `seconds` says how many
  Diagnostics ignored;
  const DeviceId device = chosen_device(config, registry, ignored).device;
  config.runtime.precision = precision_of(config, registry, device);
  std::unique_ptr<Sampler<float>> last = make_last_sampler(config, registry, extent);
  const BuildPlan plan = plan_build(manifest_of(options.classes), build_request(config, registry, last->traits()), {});
  session_.pipeline = assemble(make_parts<float>(config, registry, plan, extent, std::move(last)), {}, true);
  run_on({device}, config, registry, plan, extent, *session_.pipeline);

  std::int64_t per_ray = 0, all = 0;
  for (const Pass<float>& pass : session_.pipeline->passes()) {
    per_ray = pass.capacity_per_ray(per_ray, true);
    all += per_ray;
  }
  samples_last_ = per_ray * options.rays;
  samples_all_ = all * options.rays;

  RayLimits limits;
  limits.near_m = extent.near_m;
  limits.far_m = extent.far_m;
  limits.bounds = extent.bounds;
  limits.clip = true;
  Camera camera;
  camera.width_px = kWidth;
  camera.height_px = kHeight;
  camera.fx = camera.fy = 0.5 * kWidth;
  camera.cx = 0.5 * kWidth;
  camera.cy = 0.5 * kHeight;
  const RandomAddress where{1, 0, stream_id("step_bench/pose")};
  std::vector<TrainFrame> frames;
  for (std::uint64_t f = 0; f < kFrames; ++f) pixels_.emplace_back(random_frame(f, options.classes));
  for (const StoredFrame& frame : pixels_) labels_.push_back({frame.label, {}});
  for (std::uint64_t f = 0; f < kFrames; ++f) {
    frames.push_back(
        {{camera, random_pose(where, f), false}, &pixels_[f], options.classes > 0 ? &labels_[f] : nullptr});
  }
  std::vector<std::int16_t> logit_of_class;
  for (int c = 0; c < options.classes; ++c) logit_of_class.push_back(static_cast<std::int16_t>(c));
  RaySourceOptions source;
  source.seed = config.runtime.seed;
  source.train.rays = options.rays;
  source.tile_rays = session_.pipeline->executor().tile_rays(options.rays);
  trainer_ = std::make_unique<Trainer>(
      session_, nullptr, std::make_unique<RaySource>(std::move(frames), std::move(logit_of_class), limits, source));
}

void StepCase::start_threads(int threads) {
  const int before = thread_count();
  set_thread_count(threads);
  parallel_for(threads, [](std::int64_t) {});
  set_thread_count(before);
}

double StepCase::seconds(int threads, int steps) {
  const int before = thread_count();
  set_thread_count(threads);
  const auto begin = std::chrono::steady_clock::now();
  for (std::int64_t done = 0; done < steps;) {
    const std::span<const StepLosses> made = trainer_->advance(steps - done);
    losses_ = made.back();
    done += std::ssize(made);
  }
  const double elapsed = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
  set_thread_count(before);
  SEMFIELD_CHECK(losses_.samples == samples_last_, "every ray has all its samples, or the count is wrong");
  return elapsed / steps;
}

double StepCase::render_seconds(std::int64_t rays) {
  std::vector<double> origin, direction, near_far;
  BatchBuffers batch;
  for (std::int64_t step = 0; std::ssize(near_far) < 2 * rays; ++step) {
    trainer_->rays().fill(step, batch);
    origin.insert(origin.end(), batch.origin.begin(), batch.origin.end());
    direction.insert(direction.end(), batch.direction.begin(), batch.direction.end());
    near_far.insert(near_far.end(), batch.near_far.begin(), batch.near_far.end());
  }
  const auto n = static_cast<std::size_t>(rays);
  std::vector<float> color(3 * n), depth(n), entropy(n);
  std::vector<std::int16_t> label(n);
  RenderJob<float> job;
  job.origin = {origin.data(), rays, 3};
  job.direction = {direction.data(), rays, 3};
  job.near_far = {near_far.data(), rays, 2};
  job.color = {color.data(), rays, 3};
  job.depth = {depth.data(), rays, 1};
  if (session_.pipeline->has_semantics()) {
    job.label = {label.data(), rays, 1};
    job.entropy = {entropy.data(), rays, 1};
  }
  const auto begin = std::chrono::steady_clock::now();
  session_.pipeline->executor().render(job);
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
}

Spread spread_of(std::vector<double> values) {
  SEMFIELD_CHECK(!values.empty(), "a spread needs a measurement");
  std::sort(values.begin(), values.end());
  const std::size_t n = values.size();
  return {n % 2 == 1 ? values[n / 2] : 0.5 * (values[n / 2 - 1] + values[n / 2]), values.front(), values.back()};
}

std::vector<Spread> alternate(const std::vector<std::function<double()>>& measurements, int repeats) {
  std::vector<std::vector<double>> values(measurements.size());
  for (int round = 0; round < repeats; ++round) {
    for (std::size_t i = 0; i < measurements.size(); ++i) values[i].push_back(measurements[i]());
  }
  std::vector<Spread> spreads;
  for (std::vector<double>& v : values) spreads.push_back(spread_of(std::move(v)));
  return spreads;
}

}  // namespace semfield
