// Cases E05, E06 and E08: what a training step does with gradients that are no numbers, huge, or zero.
#include <fmt/format.h>

#include <algorithm>
#include <cstring>

#include "formats/safetensors.h"
#include "model/optim/adam.h"
#include "named_case.h"
#include "training_box.h"

namespace semfield::numerics {

namespace {

/// Puts `value` where the step's gradient of the tensor is summed up: into a lane, or into a sparse tensor's gradient.
float& gradient_slot(Tensor<float>& tensor, std::size_t element) {
  return tensor.lanes.size() > 0 ? tensor.lanes.data()[element] : tensor.grad.data()[element];
}

/// A step with `value` in one gradient of each learned tensor in turn: it throws, names the tensor, changes nothing.
void refused_everywhere(CaseRun& run, const std::string& yaml, float value) {
  TrainingBox box(run.registry(), yaml);
  for (int i = 0; i < 3; ++i) box.trainer().advance();
  int tensors = 0;
  for (Tensor<float>& tensor : box.pipeline().store().all()) {
    if (!tensor.learned()) continue;
    const std::vector<TrainingBox::Kept> before = box.state();
    const std::int64_t step = box.trainer().step();
    const auto element = static_cast<std::size_t>(tensor.size() / 2);
    const std::vector<float> kept(tensor.grad.data(), tensor.grad.data() + tensor.grad.size());
    gradient_slot(tensor, element) = value;
    const std::int64_t at = static_cast<std::int64_t>(element);
    run.expect_error(ErrorKind::failure,
                     {fmt::format("step {}", step), "'" + tensor.name + "'",
                      fmt::format("row {}, column {}", at / tensor.spec.cols, at % tensor.spec.cols)},
                     [&] { box.trainer().advance(); });
    run.expect(box.state() == before, "values and moments keep their bits (" + tensor.name + ")");
    run.expect(box.trainer().step() == step, "the step was not counted");
    // Leave the store as it was: sparse gradients are cleared by the optimiser alone.
    for (Tensor<float>& other : box.pipeline().store().all()) {
      if (other.spec.role == TensorRole::sparse) std::fill_n(other.grad.data(), other.grad.size(), 0.f);
    }
    ++tensors;
  }
  box.trainer().advance();
  run.expect(box.trainer().step() == 4, "a clean step goes on");
  run.note(fmt::format("{} tensors", tensors));
}

}  // namespace

void bad_gradient(CaseRun& run) {
  run.row("fp32");
  const float infinity = std::numeric_limits<float>::infinity();
  for (const float bad : {std::nanf(""), infinity, -infinity}) {
    refused_everywhere(run, small_config("semantics: {hidden_width: 16, weight: 0.3}\n"), bad);
    refused_everywhere(run, grid_config(), bad);
  }
  run.row("bf16");
  refused_everywhere(run, small_config("semantics: {hidden_width: 16, weight: 0.3}\nruntime: {precision: bf16}\n"),
                     std::nanf(""));
}

void loss_scale(CaseRun& run) {
  run.row("fp16");
  run.absent("no fp16 training, so no loss scale; bf16 products keep fp32's range");
}

void extreme_norms(CaseRun& run) {
  run.row("fp32");
  // Finite gradients whose square is not: Adam's second moment would become infinite and stay so, the parameter would
  // never move again, and a checkpoint of it could not be read back.
  refused_everywhere(run, small_config("semantics: {hidden_width: 16, weight: 0.3}\n"), 3e30f);
  run.row("-");
  run.absent("gradients are not clipped by norm; zero gradients are E04, infinite ones E05");
}

}  // namespace semfield::numerics
