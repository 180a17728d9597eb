#include "train/trainer.h"

#include <fmt/format.h>

#include <algorithm>
#include <chrono>

#include "compute/isa.h"
#include "core/error.h"
#include "execution/lane_executor.h"
#include "plugin/loader.h"
#include "train/assembly.h"

namespace semfield {

namespace {

constexpr const char* kSetLabels = "set_labels";

std::unique_ptr<Session> opened(RunConfig config, Registry& registry, const SessionOptions& options,
                                TrainingListener* listener) {
  Diagnostics diagnostics;
  auto session = std::make_unique<Session>(open_session(std::move(config), registry, options, diagnostics));
  if (listener != nullptr) listener->opened(diagnostics, *session);
  return session;
}

std::unique_ptr<RaySource> own_rays(Session& session) {
  const WorkSettings work = session.work();
  const WorkScope scope(work);
  return session.make_ray_source();
}

double steady_s() { return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count(); }

}  // namespace

double TrainingListener::step_clock_s() { return steady_s(); }

void TrainingListener::opened(const Diagnostics& diagnostics, const Session& session) {
  for (const Diagnostic& finding : folded(diagnostics))
    finding.severity == Severity::note ? note(finding.shown()) : warning(finding.shown());
  for (const std::string& line : session.choices()) note(line);
}

Trainer::Trainer(RunConfig config, Registry& registry, const SessionOptions& options, TrainingListener* listener)
    : Trainer(opened(std::move(config), registry, options, listener), listener) {}

Trainer::Trainer(std::unique_ptr<Session> session, TrainingListener* listener) : Trainer(*session, listener) {
  own_ = std::move(session);
}

Trainer::Trainer(Session& session, TrainingListener* listener, std::unique_ptr<RaySource> rays,
                 std::optional<SceneInputs> inputs)
    : session_(session),
      work_(session.work()),
      listener_(listener),
      rays_(rays ? std::move(rays) : own_rays(session)),
      labels_(session, *rays_),
      modules_(module_checksums(session.config.plugins)),
      inputs_(std::move(inputs)) {
  start_pace();
}

double Trainer::clock_s() const { return listener_ != nullptr ? listener_->step_clock_s() : steady_s(); }

void Trainer::start_pace() {
  pace_.reset();
  if (last_step() == 0 && end_s(session_.config) > 0) pace_.emplace(train_s_, end_s(session_.config));
}

void Trainer::train_more(const AskedLength& asked) {
  ask_more(session_.config, asked, step(), train_s_);
  start_pace();
}

void Trainer::settle_length() {
  if (!pace_) return;
  const std::optional<std::int64_t> end = pace_->made(step(), train_s_, last_step());
  if (!end) return;
  const bool anew = last_step() > 0;
  RunConfig& config = session_.config;
  settle(config, step(), *end);
  settled_ = true;
  if (listener_ == nullptr) return;
  const double rate = pace_->steps_per_s();
  if (!anew)  // what a later correction says nobody can act on
    listener_->note(fmt::format("the length is settled: {} steps for {:.4g} s of training{}, as run.yaml says", *end,
                                end_s(config), rate > 0 ? fmt::format(" ({:.3g} steps per second)", rate) : ""));
  Diagnostics never;
  check_length(config, never);
  for (const Diagnostic& finding : never.all()) listener_->warning(finding.message);
}

const SceneInputs& Trainer::inputs() {
  const WorkScope scope(work_);
  if (!inputs_) inputs_ = scene_inputs(session_.scene, session_.labels);
  return *inputs_;
}

// Steps.

// Steps are queued one behind the other: drawn by the executor from the pixels that it holds, or given as batches.
std::span<const StepLosses> Trainer::advance(std::int64_t most) {
  const WorkScope scope(work_);
  std::optional<ComputeFloatMode> mode(std::in_place);
  const double start_s = clock_s();
  check_alive();
  hold_pixels();
  const std::int64_t end = step_ + std::min<std::int64_t>(most, executor().most_queued());
  std::optional<Error> refused;  // what stopped the step behind those that are made
  for (std::int64_t step = step_; step < end && !refused; ++step) {
    try {
      if (drawn_) {
        executor().queue_drawn(step, terms_of(step), update_of(step));
      } else {
        fill(step);
        executor().queue(step, batch(), update_of(step));
      }
    } catch (const RankLost&) {
      throw;
    } catch (const Error& error) {
      refused = error;
    }
  }
  const StepResults results = executor().finish();
  step_ += std::ssize(results.losses);
  for (const StepLosses& losses : results.losses) note_density(losses);
  if (results.failed) explain_failed_step();
  if (refused && !drawn_ && filled_ != step_) throw Error(*refused);  // its batch, before it was walked
  if (refused) {
    collect();
    if (drawn_) fill(step_);
    fail(*refused);
  }
  if (results.afterwards) {
    throw Error(*results.afterwards)
        .while_doing(fmt::format(
            "while refreshing the sampler's state after step {}, which was made; that state is as it was", step_));
  }
  mode.reset();  // a listener has its own
  train_s_ += clock_s() - start_s;
  losses_ = results.losses.back();
  settle_length();
  if (listener_ == nullptr) return results.losses;
  for (const std::string& note : executor().take_notes()) listener_->note(note);
  listener_->stepped(step_, losses_);
  return results.losses;
}

AdamStep Trainer::update_of(std::int64_t step) const {
  const RunConfig& config = session_.config;
  const double factor = schedule_factor(config.schedule, step);
  AdamStep update = adam_step(config.adam, config.adam.learning_rate * factor, step);
  const double from = pipeline().options().cameras.from_step;  // corrections fall with the cube of the factor
  update.fade = from > 0 && step < step_of_share(from, config.train.steps, config.schedule) ? 0 : factor * factor;
  return update;
}

std::uint32_t Trainer::terms_of(std::int64_t step) const {
  const RunConfig& config = session_.config;
  std::uint32_t terms = 0;
  const std::vector<LossEntry>& entries = pipeline().options().losses.entries();
  for (std::size_t i = 0; i < entries.size(); ++i)
    if (step >= step_of_share(entries[i].loss->rule().from_step, config.train.steps, config.schedule)) terms |= 1U << i;
  return terms;
}

// Executors that cannot hold the pixels are given batches.
void Trainer::hold_pixels() {
  if (held_ == rays_->version()) return;
  const std::optional<PixelPool> pool = rays_->pool();
  drawn_ = pool && pool->with_labels == pipeline().has_semantics() && executor().hold(*pool);
  held_ = rays_->version();
}

void Trainer::fill(std::int64_t step) {
  filled_ = -1;
  rays_->fill(step, batch_);
  batch_.terms = terms_of(step);
  filled_ = step;
}

// The CPU makes the step again, from the same tensors: it names ray, pixel and tensor.
void Trainer::explain_failed_step() {
  collect();
  fill(step_);
  try {
    LaneExecutor<float>& lanes = pipeline().lanes();
    pipeline().require_sound(step_, lanes.gradients(step_, batch()));
  } catch (const Error& error) {
    fail(error);
  }
  pipeline().store().clear_gradients();
  throw Error(ErrorKind::failure, "device.value.not_finite",
              fmt::format("step {}: the device met a value that is not finite where the CPU meets none; nothing was "
                          "changed in this step",
                          step_),
              "set runtime.precision: fp32, or lower train.adam.learning_rate");
}

// Throws what stopped the step, with the ray's frame and pixel and the tensor behind it.
void Trainer::fail(const Error& error) {
  const std::optional<RayFault> fault = pipeline().lanes().find_fault(step_, batch());
  const Error& cause = fault ? *fault : error;
  std::string text = fmt::format("step {}: ", step_);
  const bool is_ray = dynamic_cast<const RayFault*>(&error) != nullptr;
  if (!fault || !is_ray) text += error.message();
  if (fault && !is_ray && fault->message() != error.message()) text += "; ";
  if (fault && (is_ray || fault->message() != error.message())) text += fault->message();
  if (fault) text += "; " + rays_->place_of_row(step_, fault->ray());
  const std::string tensor = pipeline().suspect_tensor();
  if (!tensor.empty() && text.find(tensor) == std::string::npos) text += "; " + tensor;
  throw Error(cause.kind(), cause.code(), text + "; nothing was changed in this step", cause.remedy());
}

void Trainer::note_density(const StepLosses& losses) {
  constexpr double kExplained = 1.0 / (255.0 * 255.0);  // an empty scene in front of its background has no density
  const std::size_t passes = pipeline().passes().size();
  dead_pass_ = 0;
  while (dead_pass_ < passes && (losses.dense_passes >> dead_pass_ & 1U) != 0) ++dead_pass_;
  dead_steps_ = dead_pass_ < passes && losses.color > kExplained ? dead_steps_ + 1 : 0;
}

void Trainer::check_alive() const {
  if (dead_steps_ < kDeadSteps) return;
  const bool relu = pipeline().options().rules.rendering.density_activation == DensityActivation::relu;
  throw Error(
      ErrorKind::failure, "train.density.dead",
      fmt::format("step {}: pass '{}' had no density at any sample of the last {} steps: every weight is 0, no "
                  "gradient reaches the density, and it cannot learn any more; nothing was changed in this step",
                  step_, pipeline().passes()[dead_pass_].parts().name, dead_steps_),
      relu ? "set rendering.density_activation to softplus, raise rendering.density_bias or "
             "rendering.density_noise, or take another runtime.seed"
           : "raise rendering.density_bias, lower train.adam.learning_rate, or take another runtime.seed");
}

std::int64_t Trainer::train(std::int64_t steps) {
  std::int64_t made = 0;
  while (made < steps && !cancelled_) made += std::ssize(advance(steps - made));
  cancelled_ = false;
  return made;
}

// What the session shows, and what it learns from.

RenderedFrame Trainer::render(const Camera& camera, const Pose& world_from_camera, const FrameOptions& options) const {
  const WorkScope scope(work_);
  FrameOptions counted = options;
  counted.classes = session_.classes();
  return render_frame(*session_.pipeline, {camera, world_from_camera, camera.has_distortion()}, session_.limits,
                      session_.plan.class_of_logit, {}, counted);
}

SplitScore Trainer::evaluate(std::vector<int> frames) const {
  const WorkScope scope(work_);
  return session_.evaluate(session_.eval_job(std::move(frames)));
}

void Trainer::set_labels(int frame, std::vector<std::int16_t> labels) {
  const WorkScope scope(work_);
  (void)inputs();  // of the labels that there were
  labels_.set(frame, std::move(labels));
}

void Trainer::set_clicks(const Annotations& clicks, std::span<const int> frames) {
  const WorkScope scope(work_);
  labels_.set_clicks(clicks, frames);
}

CheckpointFacts Trainer::facts() {
  CheckpointFacts facts;
  facts.step = step();
  facts.train_s = train_s_;
  facts.seed = session_.config.runtime.seed;
  facts.config = write_config(resolved_config(session_.config));
  facts.classes = session_.scene.info.classes.empty() ? "" : session_.scene.info.classes.to_yaml();
  facts.scene = {session_.manifest, session_.scene.pixel_footprint_m};
  facts.inputs = inputs();
  facts.clicks = labels_.clicks();
  facts.modules = modules_;
  return facts;
}

// Checkpoints.

std::vector<TensorRef> Trainer::state() {
  const WorkScope scope(work_);
  collect();
  check_storable(pipeline().store(), step_);
  return tensors();
}

void Trainer::save(const std::string& path) {
  TensorMetadata metadata = checkpoint_metadata(facts(), identity_hash(session_.config));
  if (const std::string name = labels_.name(); !name.empty()) metadata[kSetLabels] = name;
  write_safetensors(path, state(), metadata);
}

void Trainer::load(const std::string& path) {
  const WorkScope scope(work_);
  const TensorFile file = TensorFile::read(path);
  const CheckpointFacts facts = read_checkpoint_facts(file);
  require_class_table(facts.classes, session_.scene.info.classes, session_.config.labels.clicks);
  const auto named = file.metadata().find(kSetLabels);
  if (named != file.metadata().end() && named->second != labels_.name()) {
    throw Error(ErrorKind::data, "checkpoint.labels.unset",
                fmt::format("'{}': it was trained on labels that were set while it trained, and these "
                            "are not set here",
                            path),
                "call set_labels with the same labels before load");
  }
  load(file, facts.step);
  train_s_ = facts.train_s;
  start_pace();
}

void Trainer::load(const TensorFile& file, std::int64_t step) {
  const std::vector<std::vector<float>> axes = axes_of(session_);
  load_tensors(file, pipeline().store());
  step_ = step;
  executor().upload(step_);
  follow_axes(session_, axes);
}

void load_pipeline(Pipeline<float>& pipeline, const TensorFile& file) {
  load_tensors(file, pipeline.store(), false);
  pipeline.executor().upload(0);
}

}  // namespace semfield
