#include "train/trainer.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <set>

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

void copy_into(const TensorRef& from, const AlignedBuffer<float>& to) {
  std::memcpy(to.data(), from.bytes.data(), from.bytes.size());
}

}  // namespace

Trainer::Trainer(Pipeline<float>& pipeline, const RaySource& rays, const AdamParams& adam,
                 const ScheduleParams& schedule)
    : pipeline_(pipeline), rays_(rays), adam_(adam), schedule_(schedule) {}

StepLosses Trainer::advance() {
  rays_.fill(step_, batch_);
  pipeline_.store().zero_gradients();
  const StepLosses losses = pipeline_.gradients(step_, batch_.view(pipeline_.has_semantics()));
  check_finite(losses);
  update();
  ++step_;
  pipeline_.derive(step_);
  pipeline_.observe(step_);
  return losses;
}

void Trainer::check_finite(const StepLosses& losses) const {
  for (const Tensor<float>& t : pipeline_.store().all()) {
    if (!t.learned()) continue;
    const std::int64_t bad = first_non_finite<float>(t.view(t.grad));
    if (bad < 0) continue;
    throw Error(ErrorKind::failure,
                fmt::format("step {}: the gradient of '{}' is not finite at row {}, column {} (loss {}); nothing was "
                            "changed in this step",
                            step_, t.name, bad / t.spec.cols, bad % t.spec.cols, losses.total),
                "lower train.adam.learning_rate, or go on from the last checkpoint with another runtime.seed");
  }
  if (!std::isfinite(losses.total)) {
    throw Error(ErrorKind::failure,
                fmt::format("step {}: the loss is {} (colour {}, semantic {}); nothing was changed in this step", step_,
                            losses.total, losses.color, losses.semantic),
                "lower train.adam.learning_rate, or go on from the last checkpoint with another runtime.seed");
  }
}

void Trainer::update() {
  const AdamStep rule = adam_step(adam_, adam_.learning_rate * schedule_factor(schedule_, step_), step_);
  for (Tensor<float>& t : pipeline_.store().all()) {
    if (!t.learned()) continue;
    if (t.spec.role == TensorRole::dense) {
      adam_dense_parallel<float>(rule, t.view(t.value), t.view(t.grad), t.view(t.moment1), t.view(t.moment2));
      continue;
    }
    adam_touched_parallel<float>(rule, t.view(t.value), t.view(t.grad), t.view(t.moment1), t.view(t.moment2));
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
