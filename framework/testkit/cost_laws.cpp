// What a component says that it costs, against what its calls took.
#include "testkit/cost_laws.h"

#include <algorithm>

#include "compute/gemm.h"
#include "testkit/field_bench.h"

namespace semfield::testkit {

namespace {

constexpr std::int64_t kCostSampleCounts[] = {1, 33};

void check_layers(const Field<float>& field, Failures& failures) {
  for (const LayerShape& layer : field.layers()) {
    if (layer.name.empty() || layer.in < 1 || layer.out < 1 || layer.rows < 1)
      failures.push_back("layers: '" + layer.name + "' has no name, or a size below 1");
  }
  for (const auto& [samples, rays] : {std::pair<std::int64_t, std::int64_t>{1, 1}, {1000, 7}, {0, 3}}) {
    std::int64_t sum = 0;
    for (const LayerShape& layer : field.layers()) sum += layer.multiply_adds(samples, rays);
    const std::int64_t said = field.multiply_adds(samples, rays);
    if (said != sum) {
      failures.push_back("multiply_adds: " + std::to_string(said) + " for " + std::to_string(samples) + " samples of " +
                         std::to_string(rays) + " rays, but the layers add up to " + std::to_string(sum));
    }
  }
}

void check_products(const Field<float>& field, const FieldBuild& build, const LawOptions& options, Failures& failures) {
  FieldBench<float> bench(field, build, kCostSampleCounts[1], 0, options);
  const std::int64_t before = multiply_adds_of_thread();
  bench.derive();
  bench.forward();
  const std::int64_t made = multiply_adds_of_thread() - before;
  const std::int64_t said = field.multiply_adds(kCostSampleCounts[1], bench.in().direction.rows);
  if (made != 0 && made != said) {
    failures.push_back("layers: they say " + std::to_string(said) + " multiply-adds, derive and forward made " +
                       std::to_string(made));
  }
}

void check_scratch(const Field<float>& field, const FieldBuild& build, const LawOptions& options, std::int64_t samples,
                   Failures& failures) {
  const bool large = samples == options.many_rows;
  FieldBench<float> bench(field, build, samples, 0, options);
  const std::int64_t rays = bench.in().direction.rows;
  const std::size_t said = field.scratch_bytes(samples, rays);
  bench.forward();
  bench.backward();
  const std::string law = "scratch_bytes, " + std::to_string(samples) + " samples";
  note_failure(failures, law, scratch_failure(said, bench.workspace.high_water_bytes(), large));
  FieldBench<float> unsaved(field, build, samples, 0, options);
  field.forward(unsaved.ctx, unsaved.box.values_only(), unsaved.in(), unsaved.out(), {});
  note_failure(failures, law + " without saved memory",
               scratch_failure(said + field.saved_bytes(samples, rays), unsaved.workspace.high_water_bytes(), false));
}

}  // namespace

std::string scratch_failure(std::size_t said, std::size_t taken, bool large) {
  const std::string text = std::to_string(said) + " bytes, but " + std::to_string(taken) + " were taken";
  if (said < taken) return text;
  return large && said > kScratchFactor * taken ? text + ", less than 1/" + std::to_string(kScratchFactor) + " of it"
                                                : std::string();
}

void check_costs(const Field<float>& field, const FieldBuild& build, const LawOptions& options, Failures& failures) {
  check_layers(field, failures);
  check_products(field, build, options, failures);
  if (options.scratch.allocate != nullptr) return;  // a device's memory is not planned ahead
  for (const std::int64_t samples : kCostSampleCounts) check_scratch(field, build, options, samples, failures);
  check_scratch(field, build, options, options.many_rows, failures);
}

}  // namespace semfield::testkit
