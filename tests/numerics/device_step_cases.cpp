// I06 and I07 on a device beside the CPU: whole steps, and their guards.
#include <cstdio>

#include "backend_parts.h"
#include "box_room.h"
#include "session/trainer.h"
#include "system/checksum.h"

namespace semfield::numerics {

namespace {

// A room that trains where its configuration says.
struct Training {
  Training(const std::string& yaml, const std::string& runtime, Registry& registry)
      : session(open_room("scene: {type: box_room}\n" + yaml + "runtime: {" + runtime + "}\n", registry)),
        rays(session.make_ray_source()),
        trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule) {}
  StepLosses train(std::int64_t steps) {
    StepLosses last;
    while (trainer.step() < steps) last = trainer.advance_many(steps - trainer.step()).back();
    trainer.collect();
    return last;
  }
  double psnr_db() {
    return evaluate(*session.pipeline, session.eval_job({0, 1, 2}), session.limits, session.plan.class_of_logit)
        .color.psnr_db()
        .value_or(std::nan(""));
  }
  // Of the gradient, after the first step: Adam's first moment is then (1 - beta1) times it.
  long double gradient_norm() const {
    long double squares = 0;
    for (const Tensor<float>& t : session.pipeline->store().all()) {
      for (std::int64_t i = 0; t.learned() && i < t.size(); ++i)
        squares += static_cast<long double>(t.moment1.data()[i]) * t.moment1.data()[i];
    }
    return std::sqrt(squares) / (1 - session.config.adam.beta1);
  }
  std::uint32_t state() const {
    std::uint32_t crc = 0;
    for (const TensorRef& tensor : trainer.state()) crc = crc32c(tensor.bytes, crc);
    return crc;
  }
  Session session;
  std::unique_ptr<RaySource> rays;
  Trainer trainer;
};

struct Network {
  const char* yaml;
  const char* tile;  // the batch as one, as a device takes it: rays of both have the same numbers
  std::int64_t steps;
};
const Network kNetworks[] = {{kHashPass, ", tile_rays: 192", 100}, {kFrequencyPass, ", tile_rays: 128", 20}};

void step_in(CaseRun& run, Registry& registry, bool bf16) {
  for (const Network& network : kNetworks) {
    Training cpu(network.yaml, std::string("device: cpu") + network.tile, registry);
    Training cuda(network.yaml, std::string("device: cuda") + network.tile + (bf16 ? ", precision: bf16" : ""),
                  registry);
    const double want = cpu.train(1).total, got = cuda.train(1).total;
    // In bf16 products of 8 significant bits; all as on the CPU's own rows.
    run.measure(relative_error(got, want), bf16 ? 0x1p-8 : 1e-5, "loss of a step");
    run.measure(relative_error(cuda.gradient_norm(), cpu.gradient_norm()), bf16 ? 0x1p-4 : 1e-4, "gradient norm");
    cpu.train(network.steps);
    cuda.train(network.steps);
    const double there = cuda.psnr_db(), here = cpu.psnr_db();
    run.measure(std::abs(there - here), bf16 ? 0.5 : 0.05, "PSNR after training, dB");
    char text[96];
    std::snprintf(text, sizeof text, "%.3f dB after %d steps, %.3f dB on the CPU", there,
                  static_cast<int>(network.steps), here);
    run.note(text);
  }
}

}  // namespace

void whole_step_on_device(CaseRun& run) {
  for (const bool bf16 : {false, true}) {
    const std::optional<DeviceUnderTest> device = device_row(run, bf16 ? "bf16 on cuda" : "fp32 on cuda");
    if (!device) continue;
    Registry registry = with_room(run.registry());
    step_in(run, registry, bf16);
  }
}

// Every dense tensor in turn gets one NaN: the step says so and changes nothing.
void finite_checks_on_device(CaseRun& run) {
  const std::optional<DeviceUnderTest> device = device_row(run);
  if (!device) return;
  encoder_guards_on_device(run, *device);
  Registry registry = with_room(run.registry());
  const std::size_t tensors = Training(kHashPass, "device: cuda", registry).session.pipeline->store().all().size();
  int poisoned = 0;
  for (std::size_t i = 0; i < tensors; ++i) {
    Training one(kHashPass, "device: cuda", registry);  // a run ends with such a step
    Tensor<float>& t = one.session.pipeline->store().all()[i];
    if (!t.learned() || t.spec.role == TensorRole::sparse) continue;
    one.train(1);
    t.value.data()[0] = std::numeric_limits<float>::quiet_NaN();
    one.session.pipeline->executor().upload(1);
    const std::uint32_t before = one.state();
    run.expect_error(ErrorKind::failure, {}, [&] { one.trainer.advance(); });
    one.trainer.collect();
    run.expect(one.state() == before && one.trainer.step() == 1, "the step changed nothing: " + t.name);
    ++poisoned;
  }
  run.expect(poisoned > 5, "tensors were poisoned");
  run.note(std::to_string(poisoned) + " tensors of a network, each with a NaN");
}

}  // namespace semfield::numerics
