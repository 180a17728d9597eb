// One step and a short training of a small network, under the instruction set that SEMFIELD_ISA names: the suite
// compares what several of these print. step_probe CONFIGURATION STEPS: a line of numbers.
#include <cstdio>
#include <cstdlib>
#include <iostream>

#include "core/checksum.h"
#include "core/files.h"
#include "plugin/loader.h"
#include "rooms.h"

namespace semfield::numerics {
namespace {

template <class Real>
void print_step(Pipeline<Real>& pipeline, const RaySource& rays) {
  BatchBuffers batch;
  rays.fill(0, batch);
  pipeline.store().zero_gradients();
  pipeline.derive(0);
  const StepLosses losses = pipeline.lanes().gradients(0, batch.view(pipeline.has_semantics()));
  long double squares = 0;
  for (const Tensor<Real>& t : pipeline.store().all()) {
    if (!t.learned()) continue;
    for (std::int64_t i = 0; i < t.size(); ++i)
      squares += static_cast<long double>(t.grad.data()[i]) * t.grad.data()[i];
  }
  std::printf("%.17g %.17g ", losses.total, static_cast<double>(std::sqrt(squares)));
}

int run(const std::string& path, int steps) {
  Registry known;
  register_linked_plugins(known);
  Registry registry = with_room(known);
  Session session = open_room(read_text_file(path), registry);
  const auto rays = session.make_ray_source();
  print_step(*session.pipeline, *rays);
  const Precision precision = session.config.runtime.precision;
  session.config.runtime.precision = Precision::fp32;  // float64 has no other
  const auto oracle = assemble(make_parts<double>(session.config, registry, session.plan, session.extent), {}, true);
  print_step(*oracle, *rays);
  session.config.runtime.precision = precision;
  // A pipeline that has not stepped yet, so that nothing of the above is in what follows.
  session.pipeline = assemble(make_parts<float>(session.config, registry, session.plan, session.extent), {}, true);
  Trainer trainer(session);
  for (int step = 0; step < steps; ++step) trainer.advance();
  std::uint32_t state = 0;
  for (const TensorRef& tensor : trainer.tensors()) state = crc32c(tensor.bytes, state);
  const SplitScore score =
      evaluate(*session.pipeline, session.eval_job({0, 1, 2}), session.limits, session.plan.class_of_logit);
  std::printf("%.9g %u\n", score.color.psnr_db().value_or(std::nan("")), state);
  return 0;
}

}  // namespace
}  // namespace semfield::numerics

int main(int count, char** words) {
  if (count != 3) return 2;
  try {
    return semfield::numerics::run(words[1], std::atoi(words[2]));
  } catch (const std::exception& error) {
    std::cerr << error.what() << '\n';
    return 1;
  }
}
