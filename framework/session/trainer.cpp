#include "session/trainer.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <set>

#include "compute/isa.h"
#include "core/error.h"
#include "execution/lane_executor.h"

namespace semfield {

namespace {

const char* const kMoment1 = "adam/m/";
const char* const kMoment2 = "adam/v/";

std::vector<std::int64_t> shape_of(const Tensor<float>& t) { return {t.spec.rows, t.spec.cols}; }

Error refused_network(Code code, const TensorFile& file, const std::string& what) {
  return Error(ErrorKind::data, code, file.name() + ": tensor " + what + ": this is another network's checkpoint",
               "train and load with the same configuration (run.yaml of the checkpoint's run)");
}

// Checks shape and presence of one tensor in the file.
const TensorRef& matching(const TensorFile& file, const std::string& name, const Tensor<float>& t) {
  const TensorRef* found = file.find(name);
  const std::string want = fmt::format("[{}, {}]", t.spec.rows, t.spec.cols);
  if (found == nullptr)
    throw refused_network("checkpoint.tensor.missing", file, fmt::format("'{}' {} is missing", name, want));
  if (found->shape != shape_of(t) || found->type != TensorType::f32) {
    std::string have;
    for (const std::int64_t n : found->shape) have += (have.empty() ? "" : ", ") + std::to_string(n);
    throw refused_network("checkpoint.tensor.shape", file,
                          fmt::format("'{}' is [{}], the network needs {}", name, have, want));
  }
  return *found;
}

// visit(name, tensor, buffer) for what a checkpoint holds: values, and with `moments` those of learned tensors.
template <class Visit>
void each_stored(const ParamStore<float>& store, bool moments, const Visit& visit) {
  for (const Tensor<float>& t : store.all()) {
    if (!is_stored(t.spec.role)) continue;
    visit(t.name, t, t.value);
    if (!moments || !t.learned()) continue;
    visit(kMoment1 + t.name, t, t.moment1);
    visit(kMoment2 + t.name, t, t.moment2);
  }
}

// Everything is checked before anything is changed.
void load_stored(const TensorFile& file, bool moments, const ParamStore<float>& store) {
  each_stored(store, moments, [&](const std::string& name, const Tensor<float>& t, const AlignedBuffer<float>&) {
    (void)matching(file, name, t);
  });
  each_stored(store, moments, [&](const std::string& name, const Tensor<float>& t, const AlignedBuffer<float>& to) {
    const TensorRef& from = matching(file, name, t);
    std::memcpy(to.data(), from.bytes.data(), from.bytes.size());
  });
}

std::string element_text(const Tensor<float>& t, std::int64_t element) {
  return fmt::format("row {}, column {}", element / t.spec.cols, element % t.spec.cols);
}

}  // namespace

Trainer::Trainer(Pipeline<float>& pipeline, const RaySource& rays, const AdamParams& adam,
                 const ScheduleParams& schedule, std::int64_t steps)
    : pipeline_(pipeline), rays_(rays), adam_(adam), schedule_(schedule), steps_(steps) {}

void Trainer::set_length(const ScheduleParams& schedule, std::int64_t steps) {
  schedule_ = schedule;
  steps_ = steps;
}

std::uint32_t Trainer::terms_of(std::int64_t step) const {
  std::uint32_t terms = 0;
  const std::vector<LossEntry>& entries = pipeline_.options().losses.entries();
  for (std::size_t i = 0; i < entries.size(); ++i)
    if (step >= step_of_share(entries[i].loss->rule().from_step, steps_, schedule_)) terms |= 1U << i;
  return terms;
}

StepLosses Trainer::advance() { return advance_many(1).back(); }

std::span<const StepLosses> Trainer::advance_many(std::int64_t most) {
  const WorkScope scope(pipeline_.options().work);
  const ComputeFloatMode mode;
  check_alive();
  hold_pixels();
  Executor<float>& executor = pipeline_.executor();
  const std::int64_t count = std::min<std::int64_t>(most, executor.most_queued());
  std::optional<Error> refused;  // what stopped the step behind those that are made
  bool has_batch = true;         // of that step
  for (std::int64_t i = 0; i < count && !refused; ++i) {
    const std::int64_t step = step_ + i;
    const double factor = schedule_factor(schedule_, step);
    AdamStep update = adam_step(adam_, adam_.learning_rate * factor, step);
    const double from = pipeline_.options().cameras.from_step;  // corrections fall with the cube of the factor
    update.fade = from > 0 && step < step_of_share(from, steps_, schedule_) ? 0 : factor * factor;
    try {
      has_batch = drawn_;
      if (drawn_) {
        executor.queue_drawn(step, terms_of(step), update);
        continue;
      }
      fill(step);
      has_batch = true;
      executor.queue(step, batch_.view(pipeline_.has_semantics()), update);
    } catch (const RankLost&) {
      throw;
    } catch (const Error& error) {
      refused = error;
    }
  }
  const StepResults results = executor.finish();
  step_ += std::ssize(results.losses);
  for (const StepLosses& losses : results.losses) note_density(losses);
  if (results.failed) explain_failed_step();
  if (refused && !has_batch) throw Error(*refused);
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
  return results.losses;
}

// Executors that cannot hold the pixels are given batches.
void Trainer::hold_pixels() {
  if (held_ == rays_.version()) return;
  const std::optional<PixelPool> pool = rays_.pool();
  drawn_ = pool && pool->with_labels == pipeline_.has_semantics() && pipeline_.executor().hold(*pool);
  held_ = rays_.version();
}

void Trainer::fill(std::int64_t step) {
  rays_.fill(step, batch_);
  batch_.terms = terms_of(step);
}

// The CPU makes the step again, from the same tensors: it names ray, pixel and tensor.
void Trainer::explain_failed_step() {
  collect();
  fill(step_);
  try {
    (void)pipeline_.lanes().checked_gradients(step_, batch_.view(pipeline_.has_semantics()));
  } catch (const Error& error) {
    fail(error);
  }
  pipeline_.store().clear_gradients();
  throw Error(ErrorKind::failure, "device.value.not_finite",
              fmt::format("step {}: the device met a value that is not finite where the CPU meets none; nothing was "
                          "changed in this step",
                          step_),
              "set runtime.precision: fp32, or lower train.adam.learning_rate");
}

// The tensor behind a value that is not finite: one that holds such a value, else the largest value of all if it is out
// of all proportion.
std::string Trainer::bad_tensor() const {
  constexpr float kProportion = 1e10F;
  float largest = kProportion;
  std::string text;
  for (const Tensor<float>& t : pipeline_.store().all()) {
    if (t.spec.role == TensorRole::rearranged) continue;
    const std::int64_t bad = first_non_finite<float>(t.view(t.value));
    if (bad >= 0) return fmt::format("'{}' holds {} at {}", t.name, t.value.data()[bad], element_text(t, bad));
    for (std::int64_t i = 0; i < t.size() && t.spec.role != TensorRole::state; ++i) {
      const float value = t.value.data()[i];
      if (!(std::abs(value) > largest)) continue;
      largest = std::abs(value);
      text = fmt::format("the largest value is {:.6g} in '{}' at {}", value, t.name, element_text(t, i));
    }
  }
  return text;
}

// Throws what stopped the step, with the ray's frame and pixel and the tensor behind it.
void Trainer::fail(const Error& error) {
  const std::optional<RayFault> fault = pipeline_.find_fault(step_, batch_.view(pipeline_.has_semantics()));
  const Error& cause = fault ? *fault : error;
  std::string text = fmt::format("step {}: ", step_);
  const bool is_ray = dynamic_cast<const RayFault*>(&error) != nullptr;
  if (!fault || !is_ray) text += error.message();
  if (fault && !is_ray && fault->message() != error.message()) text += "; ";
  if (fault && (is_ray || fault->message() != error.message())) text += fault->message();
  if (fault) text += "; " + rays_.place_of_row(step_, fault->ray());
  const std::string tensor = bad_tensor();
  if (!tensor.empty() && text.find(tensor) == std::string::npos) text += "; " + tensor;
  throw Error(cause.kind(), cause.code(), text + "; nothing was changed in this step", cause.remedy());
}

void Trainer::note_density(const StepLosses& losses) {
  constexpr double kExplained = 1.0 / (255.0 * 255.0);  // an empty scene in front of its background has no density
  const std::size_t passes = pipeline_.passes().size();
  dead_pass_ = 0;
  while (dead_pass_ < passes && (losses.dense_passes >> dead_pass_ & 1U) != 0) ++dead_pass_;
  dead_steps_ = dead_pass_ < passes && losses.color > kExplained ? dead_steps_ + 1 : 0;
}

void Trainer::check_alive() const {
  if (dead_steps_ < kDeadSteps) return;
  const bool relu = pipeline_.options().rules.rendering.density_activation == DensityActivation::relu;
  throw Error(
      ErrorKind::failure, "train.density.dead",
      fmt::format("step {}: pass '{}' had no density at any sample of the last {} steps: every weight is 0, no "
                  "gradient reaches the density, and it cannot learn any more; nothing was changed in this step",
                  step_, pipeline_.passes()[dead_pass_].parts().name, dead_steps_),
      relu ? "set rendering.density_activation to softplus, raise rendering.density_bias or "
             "rendering.density_noise, or take another runtime.seed"
           : "raise rendering.density_bias, lower train.adam.learning_rate, or take another runtime.seed");
}

void Trainer::check_storable() const {
  each_stored(
      pipeline_.store(), true, [&](const std::string&, const Tensor<float>& t, const AlignedBuffer<float>& buffer) {
        const std::int64_t bad = first_non_finite<float>(t.view(buffer));
        if (bad < 0) return;
        throw Error(
            ErrorKind::failure, "checkpoint.save.not_finite",
            fmt::format("no checkpoint of step {}: {}'{}' holds {} at {}", step_,
                        &buffer == &t.value ? "" : "a moment of ", t.name, buffer.data()[bad], element_text(t, bad)),
            "resume from the last checkpoint");
      });
}

std::vector<TensorRef> Trainer::state() const {
  std::vector<TensorRef> out;
  each_stored(pipeline_.store(), true,
              [&](const std::string& name, const Tensor<float>& t, const AlignedBuffer<float>& buffer) {
                out.push_back(tensor_ref(name, shape_of(t), std::span<const float>(buffer.data(), buffer.size())));
              });
  return out;
}

void Trainer::load(const TensorFile& file, std::int64_t step) {
  std::set<std::string> known;
  for (const TensorRef& wanted : state()) known.insert(wanted.name);
  for (const TensorRef& have : file.tensors())
    if (!known.contains(have.name))
      throw refused_network("checkpoint.tensor.unknown", file,
                            "'" + have.name + "' belongs to no part of this network");
  load_stored(file, true, pipeline_.store());
  step_ = step;
  pipeline_.executor().upload(step_);
}

void load_pipeline(Pipeline<float>& pipeline, const TensorFile& file) {
  load_stored(file, false, pipeline.store());
  pipeline.executor().upload(0);
}

}  // namespace semfield
