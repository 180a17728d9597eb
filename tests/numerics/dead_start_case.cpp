// Case D18: runs that begin with no density at any sample.
#include <fmt/format.h>

#include "loss_cases.h"
#include "training_box.h"

namespace semfield::numerics {

namespace {

enum class End { learns, stopped, unnoticed };

/// ReLU density with `bias`, 200 steps at most. `last` is the step at which it ended.
End outcome(CaseRun& run, int seed, const char* bias, std::int64_t& last) {
  TrainingBox box(run.registry(),
                  fmt::format("scene: {{type: box_room, load: {{downscale: 4}}}}\n"
                              "rendering: {{density_activation: relu, density_bias: {}}}\n"
                              "passes:\n"
                              "  - sampler: {{type: stratified, samples: 8}}\n"
                              "    position: {{type: frequency, frequencies: 2}}\n"
                              "    field: {{type: tiny_mlp, hidden_width: 16, color_width: 16, color_layers: 1}}\n"
                              "train: {{steps: 200, rays: 16}}\n"
                              "runtime: {{seed: {}}}\n",
                              bias, seed));
  bool dense = false;
  try {
    for (last = 0; last < 200; ++last) dense = box.trainer().advance().dense_passes != 0;
  } catch (const Error& error) {
    const std::string text = error.what();
    run.expect(error.kind() == ErrorKind::failure && text.find("no density") != std::string::npos &&
                   text.find("pass 'main'") != std::string::npos && text.find("density_bias") != std::string::npos,
               "the message names pass, cause and remedy");
    return End::stopped;
  }
  return dense ? End::learns : End::unnoticed;
}

}  // namespace

void dead_start(CaseRun& run) {
  run.row("fp32");
  // With -0.3 about half of the runs begin dead; the others show that a run that learns is left alone.
  for (const auto& [bias, seeds] : {std::pair{"-0.3", 100}, std::pair{"0", 20}, std::pair{"-3", 20}}) {
    int counts[3] = {};
    std::int64_t latest = 0;
    for (int seed = 0; seed < seeds; ++seed) {
      std::int64_t last = 0;
      const End end = outcome(run, seed, bias, last);
      ++counts[static_cast<int>(end)];
      if (end == End::stopped) latest = std::max(latest, last);
    }
    run.measure(counts[2], 0, "runs dead and unnoticed");
    run.expect(latest <= 200, "within 200 steps");
    run.note(fmt::format("bias {}: {} learn, {} stopped by step {}", bias, counts[0], counts[1], latest));
  }
}

}  // namespace semfield::numerics
