#include "studies/leave_out_side.h"

#include <fmt/format.h>

#include <algorithm>
#include <cstdio>
#include <cstring>
#include <ctime>
#include <functional>
#include <limits>
#include <memory>

#include "core/error.h"
#include "execution/lane_executor.h"
#include "formats/image_formats.h"
#include "formats/image_io.h"
#include "studies/step_bench.h"
#include "system/checksum.h"

namespace semfield {

double processor_s() {
  timespec now{};
  ::clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

LeaveOutSide::LeaveOutSide(const LeaveOutPair& pair, const std::vector<std::string>& own, const PairOptions& options,
                           Registry& registry, const std::string& config_path, int seed) {
  std::vector<std::string> set = options.set;
  set.insert(set.end(), pair.both.begin(), pair.both.end());
  set.insert(set.end(), own.begin(), own.end());
  set.emplace_back("runtime.threads=1");
  set.emplace_back("runtime.precision=fp32");  // what is compared are sums of fp32, on every machine
  set.push_back(fmt::format("runtime.seed={}", seed));
  Diagnostics diagnostics;
  SessionOptions session_options;
  session_options.depth = DepthKept::test;
  session = open_session(load_run_config(config_path, set, registry), registry, session_options, diagnostics);
  rays = session.make_ray_source();
  trainer = std::make_unique<Trainer>(*session.pipeline, *rays, session.config.adam, session.config.schedule,
                                      session.config.train.steps);
}

void LeaveOutSide::train(int steps) {
  for (int i = 0; i < steps; ++i) trainer->advance();
}

std::int64_t LeaveOutSide::bytes() const {
  return static_cast<std::int64_t>(session.memory_facts.frames + session.pipeline->store().bytes() +
                                   session.pipeline->lanes().workspace_bytes());
}

SplitScore LeaveOutSide::score(int frames) const {
  return evaluate(*session.pipeline, session.eval_job(evenly_spaced(test_frames(), frames)), session.limits,
                  session.plan.class_of_logit);
}

PairCost measure_sides(const char* of, int rounds, int repeats, const std::function<void()>& out,
                       const std::function<void()>& kept) {
  std::vector<double> out_s, kept_s, share;
  for (int round = 0; round < rounds; ++round) {
    const double a = processor_s();
    out();
    const double b = processor_s();
    kept();
    const double c = processor_s();
    out_s.push_back((b - a) / repeats);
    kept_s.push_back((c - b) / repeats);
    share.push_back(1 - out_s.back() / kept_s.back());
  }
  std::sort(share.begin(), share.end());
  PairCost cost;
  cost.of = of;
  cost.out_s = spread_of(out_s).median;
  cost.kept_s = spread_of(kept_s).median;
  cost.share = spread_of(share).median;
  cost.noise = 0.5 * (share[share.size() * 3 / 4] - share[share.size() / 4]);
  return cost;
}

namespace {

std::span<const std::byte> bytes_of(const AlignedBuffer<float>& buffer) {
  return std::as_bytes(std::span<const float>(buffer.data(), buffer.size()));
}

}  // namespace

std::string hash_of_shared(const Pipeline<float>& of, Pipeline<float>& other, int& shared) {
  Sha256 sum;
  shared = 0;
  for (const Tensor<float>& t : of.store().all()) {
    const Tensor<float>* there = other.store().find(t.name);
    if (there == nullptr || there->size() != t.size() || !t.learned()) continue;
    sum.add(std::as_bytes(std::span(t.name)));
    for (const AlignedBuffer<float>* buffer : {&t.value, &t.moment1, &t.moment2}) sum.add(bytes_of(*buffer));
    ++shared;
  }
  return sum.hex();
}

void copy_tensors(Pipeline<float>& from, Pipeline<float>& to) {
  for (Tensor<float>& t : to.store().all()) {
    const Tensor<float>* source = from.store().find(t.name);
    if (source == nullptr || source->size() != t.size()) continue;
    std::copy_n(source->value.data(), t.size(), t.value.data());
  }
  to.derive(0);
}

std::string hashes_text(const std::string& a, const std::string& b, const std::string& of) {
  return a == b ? fmt::format("SHA-256 {}... on both sides ({})", a.substr(0, 16), of)
                : fmt::format("SHA-256 {}... against {}... ({})", a.substr(0, 16), b.substr(0, 16), of);
}

bool is_mapped(const std::string& name) {
  std::FILE* maps = std::fopen("/proc/self/maps", "r");
  if (maps == nullptr) return false;
  char line[4096];
  bool found = false;
  while (!found && std::fgets(line, sizeof line, maps) != nullptr) found = std::strstr(line, name.c_str()) != nullptr;
  std::fclose(maps);
  return found;
}

namespace {

// Resident bytes now; 0 where the system does not tell.
std::int64_t resident_bytes() {
  std::FILE* file = std::fopen("/proc/self/statm", "r");
  if (file == nullptr) return 0;
  long long all = 0, resident = 0;
  const int read = std::fscanf(file, "%lld %lld", &all, &resident);
  std::fclose(file);
  return read == 2 ? resident * 4096 : 0;
}

}  // namespace

PairResult cost_of_image_library() {
  PairResult result;
  result.cost.of = "start";
  if (!images_available()) {
    result.result = "this build has none";
    return result;
  }
  const bool before = is_mapped("OpenImageIO");
  const std::int64_t bytes = resident_bytes();
  const double begin = processor_s();
  image_formats();
  result.cost.kept_s = processor_s() - begin;
  result.cost.kept_bytes = resident_bytes() - bytes;
  result.cost.share = 1;
  result.holds = !before && is_mapped("OpenImageIO");
  result.result =
      before ? "the library was mapped before it was needed"
             : "no OpenImageIO in the process's memory map after training and rendering, mapped when asked for";
  return result;
}

PairResult compare_rows(const PairOptions& options, LeaveOutSide& side, LeaveOutSide& fresh) {
  PairResult result;
  std::int64_t rows = 0, untouched = 0, changed = 0;
  for (const Tensor<float>& t : side.pipeline().store().all()) {
    if (t.spec.role != TensorRole::sparse) continue;
    const Tensor<float>& start = *fresh.pipeline().store().find(t.name);
    const auto n = static_cast<std::size_t>(t.spec.cols);
    for (std::int64_t r = 0; r < t.spec.rows; ++r, ++rows) {
      const float* m = t.moment1.data() + r * t.spec.cols;
      const float* v = t.moment2.data() + r * t.spec.cols;
      const bool met = std::any_of(m, m + n, [](float x) { return x != 0; }) ||
                       std::any_of(v, v + n, [](float x) { return x != 0; });
      if (met) continue;
      ++untouched;
      const std::int64_t at = r * t.spec.cols;
      if (std::memcmp(t.value.data() + at, start.value.data() + at, n * sizeof(float)) != 0) ++changed;
    }
  }
  result.holds = rows > 0 && untouched > 0 && changed == 0;
  result.result = fmt::format("{} of {} rows of tables never met in {} steps; {} of them differ from their first bits",
                              untouched, rows, side.trainer->step(), changed);
  // A step's own gradients, left in the store for both rules; values and moments are copies.
  const double step_s = measure_sides(
                            "step", options.rounds, options.steps_a_round, [&] { side.train(options.steps_a_round); },
                            [&] { fresh.train(options.steps_a_round); })
                            .out_s;
  BatchBuffers batch;
  side.rays->fill(side.trainer->step(), batch);
  side.pipeline().store().zero_gradients();
  side.pipeline().gradients(side.trainer->step(), batch.view(side.pipeline().has_semantics()));
  double touched_s = 0, dense_s = 0;
  const AdamStep rule = adam_step(side.session.config.adam, 0.01, 1000);
  for (const Tensor<float>& t : side.pipeline().store().all()) {
    if (t.spec.role != TensorRole::sparse) continue;
    const auto copy = [](const AlignedBuffer<float>& b) { return std::vector<float>(b.data(), b.data() + b.size()); };
    const auto view = [&](std::vector<float>& v) { return View<float>(v.data(), t.spec.rows, t.spec.cols); };
    const std::vector<float> gradient = copy(t.grad);
    std::vector<float> value = copy(t.value), m = copy(t.moment1), v = copy(t.moment2), g;
    std::vector<double> touched, dense;
    for (int round = 0; round < options.rounds; ++round) {
      g = gradient;
      const double a = processor_s();
      adam_touched_parallel<float>(rule, view(value), view(g), view(m), view(v));
      const double b = processor_s();
      g = gradient;
      const double c = processor_s();
      adam_dense_parallel<float>(rule, view(value), view(g), view(m), view(v));
      std::fill(g.begin(), g.end(), 0.0F);
      const double d = processor_s();
      touched.push_back(b - a);
      dense.push_back(d - c);
    }
    touched_s += spread_of(touched).median;
    dense_s += spread_of(dense).median;
  }
  result.cost.of = "step";
  result.cost.out_s = step_s;
  result.cost.kept_s = step_s + dense_s - touched_s;
  result.cost.share = 1 - result.cost.out_s / result.cost.kept_s;
  return result;
}

PairResult compare_evaluation(const PairOptions& options, LeaveOutSide& out, LeaveOutSide& kept) {
  constexpr double kEvery_s = 10;  // default of report.eval_every_s
  std::vector<double> seconds;
  for (int round = 0; round < options.rounds; ++round) {
    out.train(options.steps_a_round);
    kept.train(options.steps_a_round);
    const double begin = processor_s();
    kept.score(kept.session.config.report.eval_frames);
    seconds.push_back(processor_s() - begin);
  }
  int shared = 0;
  const std::string a = hash_of_shared(out.pipeline(), kept.pipeline(), shared);
  const std::string b = hash_of_shared(kept.pipeline(), out.pipeline(), shared);
  PairResult result;
  result.holds = a == b && shared > 0;
  result.result = hashes_text(a, b,
                              fmt::format("{} tensors after {} steps, with {} evaluations and without", shared,
                                          out.trainer->step(), options.rounds));
  const double evaluation_s = spread_of(seconds).median;
  result.cost.of = "stretch of 10 s of training";
  result.cost.out_s = kEvery_s;
  result.cost.kept_s = kEvery_s + evaluation_s;
  result.cost.share = evaluation_s / (kEvery_s + evaluation_s);
  return result;
}

PairResult cost_of_checks(const PairOptions& options, LeaveOutSide& side) {
  PairResult result;
  // Learned tensors whose gradient has a value that is not finite.
  const auto bad_tensors = [&side] {
    std::int64_t bad = 0;
    for (const Tensor<float>& t : side.pipeline().store().all())
      bad += t.learned() && first_non_finite<float>(t.view(t.grad)) >= 0 ? 1 : 0;
    return bad;
  };
  std::int64_t bad = 0, learned = 0;
  const PairCost cost = measure_sides(
      "step", options.rounds, options.steps_a_round,
      [&] {
        for (int i = 0; i < options.steps_a_round; ++i) bad += bad_tensors();
      },
      [&] { side.train(options.steps_a_round); });
  // Checks that overlook what they look for cost nothing worth measuring.
  for (Tensor<float>& t : side.pipeline().store().all()) {
    if (!t.learned()) continue;
    ++learned;
    t.grad.data()[t.size() - 1] = std::numeric_limits<float>::quiet_NaN();
  }
  result.holds = bad == 0 && bad_tensors() == learned;
  result.cost = cost;
  result.cost.out_s = cost.kept_s - cost.out_s;  // a step without the checks
  result.cost.share = cost.out_s / cost.kept_s;
  return result;
}

}  // namespace semfield
