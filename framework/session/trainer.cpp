#include "session/trainer.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <set>

#include "compute/float_mode.h"
#include "core/error.h"

namespace semfield {

namespace {

const char* const kMoment1 = "adam/m/";
const char* const kMoment2 = "adam/v/";

bool stored(const Tensor<float>& t) { return t.spec.role != TensorRole::derived; }

std::vector<std::int64_t> shape_of(const Tensor<float>& t) { return {t.spec.rows, t.spec.cols}; }

std::span<const float> values_of(const AlignedBuffer<float>& buffer) { return {buffer.data(), buffer.size()}; }

// Checks shape and presence of one tensor in the file.
const TensorRef& matching(const TensorFile& file, const std::string& name, const Tensor<float>& t) {
  const TensorRef* found = file.find(name);
  const std::string want = fmt::format("[{}, {}]", t.spec.rows, t.spec.cols);
  if (found == nullptr) {
    throw Error(
        ErrorKind::data,
        fmt::format("{}: tensor '{}' {} is missing: this is another network's checkpoint", file.name(), name, want),
        "train and load with the same configuration (run.yaml of the checkpoint's run)");
  }
  if (found->shape != shape_of(t) || found->type != TensorType::f32) {
    std::string have;
    for (const std::int64_t n : found->shape) have += (have.empty() ? "" : ", ") + std::to_string(n);
    throw Error(ErrorKind::data,
                fmt::format("{}: tensor '{}' is [{}], the network needs {}: this is another network's checkpoint",
                            file.name(), name, have, want),
                "train and load with the same configuration (run.yaml of the checkpoint's run)");
  }
  return *found;
}

std::string element_text(const Tensor<float>& t, std::int64_t element) {
  return fmt::format("row {}, column {}", element / t.spec.cols, element % t.spec.cols);
}

// Of a table the whole gradient, and values and moments of the touched rows of one window: the moments of every touched
// row would cost as much memory traffic as the update. From sound numbers comes nothing else, so what this finds was
// written from outside; a value that is not finite is seen in the encoder's output in any case.
Unsound<float> unsound_of_table(const Tensor<float>& t, std::int64_t step) {
  Unsound<float> bad = first_unsound<float>({}, t.view(t.grad), {}, {}, false);
  if (bad.element >= 0) return bad;
  const std::int64_t rows = (t.spec.rows + kTableWindows - 1) / kTableWindows;
  const std::int64_t begin = std::min(step % kTableWindows * rows, t.spec.rows);
  const std::int64_t count = std::min(rows, t.spec.rows - begin);
  if (count == 0) return {};
  const auto window = [&](const AlignedBuffer<float>& buffer) { return t.view(buffer).row_range(begin, count); };
  bad = first_unsound<float>(window(t.value), window(t.grad), window(t.moment1), window(t.moment2), true);
  if (bad.element >= 0) bad.element += begin * t.spec.cols;
  return bad;
}

void copy_into(const TensorRef& from, const AlignedBuffer<float>& to) {
  std::memcpy(to.data(), from.bytes.data(), from.bytes.size());
}

}  // namespace

Trainer::Trainer(Pipeline<float>& pipeline, const RaySource& rays, const AdamParams& adam,
                 const ScheduleParams& schedule, DeviceBackend* device)
    : pipeline_(pipeline), rays_(rays), adam_(adam), schedule_(schedule), device_(device) {}

StepLosses Trainer::advance() { return advance_many(1).back(); }

std::span<const StepLosses> Trainer::advance_many(std::int64_t most) {
  const WorkScope scope(pipeline_.options().work);
  const ComputeFloatMode mode;
  done_.clear();
  if (device_ == nullptr) {
    done_.push_back(advance_on_processor());
    return done_;
  }
  const std::int64_t count = std::min<std::int64_t>(most, device_->most_queued());
  std::optional<Error> refused;  // of a batch that the device was not given
  for (std::int64_t i = 0; i < count && !refused; ++i) {
    const std::int64_t step = step_ + i;
    const AdamStep rule = rule_of(step);
    try {
      rays_.fill(step, batch_);
      device_->queue(step, batch_.view(pipeline_.has_semantics()), {rule.step_size, rule.root_scale, rate_of(step)});
    } catch (const Error& error) {
      refused = error;
    }
  }
  const DeviceSteps steps = device_->finish();
  for (const StepLosses& losses : steps.losses) {
    check_alive(losses);
    ++step_;
    done_.push_back(losses);
  }
  if (steps.failed) explain_device_fault();
  if (refused) {
    collect();
    fail(*refused);
  }
  return done_;
}

void Trainer::collect() {
  if (device_ == nullptr) return;
  device_->download();
  pipeline_.derive(step_);
}

// The processor makes the step again, from the same tensors: it names ray, pixel and tensor.
void Trainer::explain_device_fault() {
  collect();
  rays_.fill(step_, batch_);
  pipeline_.store().zero_gradients();
  try {
    check_step(pipeline_.gradients(step_, batch_.view(pipeline_.has_semantics())));
  } catch (const Error& error) {
    fail(error);
  }
  pipeline_.store().clear_gradients();
  throw Error(
      ErrorKind::failure,
      fmt::format("step {}: the device met a value that is not finite where the processor meets none; nothing was "
                  "changed in this step",
                  step_),
      "set runtime.precision: fp32, or lower train.adam.learning_rate");
}

StepLosses Trainer::advance_on_processor() {
  rays_.fill(step_, batch_);
  pipeline_.store().zero_gradients();
  StepLosses losses;
  try {
    losses = pipeline_.gradients(step_, batch_.view(pipeline_.has_semantics()));
    check_step(losses);
  } catch (const Error& error) {
    fail(error);
  }
  check_alive(losses);
  update(losses);
  ++step_;
  pipeline_.derive(step_);
  try {
    pipeline_.observe(step_);
  } catch (Error& error) {
    throw error.while_doing(fmt::format(
        "while refreshing the sampler's state after step {}, which was made; that state is as it was", step_));
  }
  return losses;
}

void Trainer::check_step(const StepLosses& losses) const {
  for (const Tensor<float>& t : pipeline_.store().all()) {
    if (!t.learned()) continue;
    const Unsound<float> bad =
        t.spec.role == TensorRole::sparse
            ? unsound_of_table(t, step_)
            : first_unsound<float>(t.view(t.value), t.view(t.grad), t.view(t.moment1), t.view(t.moment2), false);
    if (bad.element < 0) continue;
    throw Error(ErrorKind::failure,
                fmt::format("the {} of '{}' at {} is {:.6g} (loss {:.6g})", bad.array, t.name,
                            element_text(t, bad.element), bad.found, losses.total),
                std::string(fault_remedy()));
  }
  if (!std::isfinite(losses.total)) {
    std::string terms;
    const std::vector<LossEntry>& entries = pipeline_.options().losses.entries();
    for (std::size_t i = 0; i < entries.size(); ++i) terms += fmt::format(", {} {}", entries[i].type, losses.terms[i]);
    throw Error(
        ErrorKind::failure,
        fmt::format("the loss is {} (colour {}, semantic {}{})", losses.total, losses.color, losses.semantic, terms),
        std::string(fault_remedy()));
  }
  check_states();
}

// Derived and state tensors. Of a large one (the cells of a fine occupancy grid) a window is looked at in each step, so
// that the check costs the same for any grid; the sampler itself refuses what it would write.
void Trainer::check_states() const {
  constexpr std::int64_t kWindow = std::int64_t{1} << 18;
  for (const Tensor<float>& t : pipeline_.store().all()) {
    if (t.learned()) continue;
    const std::int64_t windows = (t.size() + kWindow - 1) / kWindow;
    const std::int64_t begin = step_ % windows * kWindow, count = std::min(kWindow, t.size() - begin);
    const std::int64_t at = first_non_finite<float>(View<const float>(t.value.data() + begin, count, 1));
    if (at < 0) continue;
    throw Error(ErrorKind::failure,
                fmt::format("'{}' holds {} at {}", t.name, t.value.data()[begin + at], element_text(t, begin + at)),
                std::string(fault_remedy()));
  }
}

// The tensor behind a value that is not finite: one that holds such a value, else the largest value of all if it is out
// of all proportion.
std::string Trainer::bad_tensor() const {
  constexpr float kProportion = 1e10F;
  float largest = kProportion;
  std::string text;
  for (const Tensor<float>& t : pipeline_.store().all()) {
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
  throw Error(cause.kind(), text + "; nothing was changed in this step", cause.remedy());
}

void Trainer::check_alive(const StepLosses& losses) {
  constexpr double kExplained = 1.0 / (255.0 * 255.0);  // an empty scene in front of its background has no density
  const std::vector<Pass<float>>& passes = pipeline_.passes();
  std::size_t dead = 0;
  while (dead < passes.size() && (losses.dense_passes >> dead & 1U) != 0) ++dead;
  dead_steps_ = dead < passes.size() && losses.color > kExplained ? dead_steps_ + 1 : 0;
  if (dead_steps_ < kDeadSteps) return;
  const bool relu = pipeline_.options().rules.activation == DensityActivation::relu;
  pipeline_.store().clear_gradients();
  throw Error(
      ErrorKind::failure,
      fmt::format("step {}: pass '{}' had no density at any sample of the last {} steps: every weight is 0, no "
                  "gradient reaches the density, and it cannot learn any more; nothing was changed in this step",
                  step_, passes[dead].parts().name, dead_steps_),
      relu ? "set rendering.density_activation to softplus, raise rendering.density_bias or "
             "rendering.density_noise, or take another runtime.seed"
           : "raise rendering.density_bias, lower train.adam.learning_rate, or take another runtime.seed");
}

// A step without a labelled ray says nothing about the semantic head: its tensors and their moments stay, as the rows
// of a table do that no ray touched. (Adam would move them along their old moments.)
void Trainer::update(const StepLosses& losses) {
  const AdamStep all = rule_of(step_);
  const double rate = rate_of(step_);
  for (Tensor<float>& t : pipeline_.store().all()) {
    if (!t.learned() || (losses.labelled == 0 && pipeline_.is_semantic(t))) continue;
    AdamStep rule = all;
    rule.step_size *= t.rule.rate;
    rule.decay = rate * (t.rule.rate * t.rule.decay);
    if (t.spec.role == TensorRole::dense) {
      adam_dense_parallel<float>(rule, t.view(t.value), t.view(t.grad), t.view(t.moment1), t.view(t.moment2));
      continue;
    }
    adam_touched_parallel<float>(rule, t.view(t.value), t.view(t.grad), t.view(t.moment1), t.view(t.moment2));
  }
}

double Trainer::rate_of(std::int64_t step) const { return adam_.learning_rate * schedule_factor(schedule_, step); }

AdamStep Trainer::rule_of(std::int64_t step) const { return adam_step(adam_, rate_of(step), step); }

void Trainer::check_storable() const {
  for (const Tensor<float>& t : pipeline_.store().all()) {
    if (!stored(t)) continue;
    for (const AlignedBuffer<float>* buffer : {&t.value, &t.moment1, &t.moment2}) {
      const std::int64_t bad = first_non_finite<float>(t.view(*buffer));
      if (bad < 0) continue;
      throw Error(
          ErrorKind::failure,
          fmt::format("no checkpoint of step {}: {}'{}' holds {} at {}", step_,
                      buffer == &t.value ? "" : "a moment of ", t.name, buffer->data()[bad], element_text(t, bad)),
          "resume from the last checkpoint");
    }
  }
}

std::vector<TensorRef> Trainer::state() const {
  std::vector<TensorRef> out;
  for (const Tensor<float>& t : pipeline_.store().all()) {
    if (!stored(t)) continue;
    out.push_back(tensor_ref(t.name, shape_of(t), values_of(t.value)));
    if (!t.learned()) continue;
    out.push_back(tensor_ref(kMoment1 + t.name, shape_of(t), values_of(t.moment1)));
    out.push_back(tensor_ref(kMoment2 + t.name, shape_of(t), values_of(t.moment2)));
  }
  return out;
}

void Trainer::load(const TensorFile& file, std::int64_t step) {
  std::set<std::string> known;
  for (const TensorRef& wanted : state()) known.insert(wanted.name);
  for (const TensorRef& have : file.tensors()) {
    if (known.count(have.name) == 0) {
      throw Error(ErrorKind::data,
                  file.name() + ": tensor '" + have.name +
                      "' belongs to no part of this network: this is another network's checkpoint",
                  "train and load with the same configuration (run.yaml of the checkpoint's run)");
    }
  }
  ParamStore<float>& store = pipeline_.store();
  for (const Tensor<float>& t : store.all()) {  // everything is checked before anything is changed
    if (!stored(t)) continue;
    matching(file, t.name, t);
    if (t.learned()) {
      matching(file, kMoment1 + t.name, t);
      matching(file, kMoment2 + t.name, t);
    }
  }
  for (const Tensor<float>& t : store.all()) {
    if (!stored(t)) continue;
    copy_into(matching(file, t.name, t), t.value);
    if (t.learned()) {
      copy_into(matching(file, kMoment1 + t.name, t), t.moment1);
      copy_into(matching(file, kMoment2 + t.name, t), t.moment2);
    }
  }
  step_ = step;
  pipeline_.derive(step_);
  if (device_ != nullptr) device_->upload();
}

void load_pipeline(Pipeline<float>& pipeline, const TensorFile& file) {
  for (const Tensor<float>& t : pipeline.store().all()) {
    if (stored(t)) matching(file, t.name, t);
  }
  for (const Tensor<float>& t : pipeline.store().all()) {
    if (stored(t)) copy_into(matching(file, t.name, t), t.value);
  }
  pipeline.derive(0);
}

}  // namespace semfield
