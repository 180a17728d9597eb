// Group B: limits of rays, very long ways, and nothing at all.

#include "loading/frame_source.h"
#include "losses/semantic_cross_entropy.h"
#include "model_bench.h"
#include "sampling_cases.h"
#include "testkit/analytic_scene.h"

namespace semfield::numerics {

namespace {

constexpr const char* kSamplers[] = {"stratified", "importance", "occupancy_grid"};

testkit::Settings settings_of(const std::string& sampler) {
  if (sampler == "occupancy_grid") return {{"resolution", "32"}, {"max_samples", "64"}};
  return {{"samples", "8"}};
}

// Samples of rays with these limits; a sampler that wants an earlier pass gets one that left nothing.
template <class Real>
std::unique_ptr<RayBench<Real>> drawn(CaseRun& run, const std::string& sampler, const std::vector<double>& limits,
                                      std::int64_t first_ray = 0) {
  auto bench = std::make_unique<RayBench<Real>>(run.registry(), sampler, settings_of(sampler));
  bench->ctx.first_ray = first_ray;
  bench->set_rays(limits);
  std::vector<std::int32_t> first(static_cast<std::size_t>(bench->count + 1), 0);
  Real none = 0;
  Samples<Real> samples{
      View<Real>(&none, 0, 1), View<Real>(&none, 0, 1), {}, View<std::int32_t>(first.data(), bench->count + 1, 1), 0};
  const Proposal<Real> proposal{&samples, View<const Real>(&none, 0, 1)};
  bench->draw(sampler == "importance" ? &proposal : nullptr, 0);
  return bench;
}

std::string errors_of(const SceneLoadOptions& options) {
  Diagnostics diagnostics;
  const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene({4, 16, 12});
  load_scene(*scene, options, diagnostics);
  std::string text;
  for (const Diagnostic& found : diagnostics.all()) text += found.text() + "\n";
  return diagnostics.has_errors() ? text : "";
}

}  // namespace

void bounds(CaseRun& run) {
  const double infinity = std::numeric_limits<double>::infinity(), nan = std::numeric_limits<double>::quiet_NaN();
  in_both_precisions(run, [&]<class Real>(Real) {
    for (const std::string sampler : kSamplers) {
      const auto bench = drawn<Real>(run, sampler, {1, 1, 3, 2, 0, 1, 0, 0, 0, 1e-300});
      run.expect(bench->first[1] == 0 && bench->first[2] == 0, "near = far and near > far are empty rays: " + sampler);
      run.expect(bench->first[3] > 0, "near = 0 has samples: " + sampler);
      run.expect(bench->first[4] == bench->first[3], "near = far = 0 is an empty ray: " + sampler);
      for (std::int32_t k = 0; k < bench->first[3]; ++k) {
        const auto t = static_cast<double>(bench->t[k]);
        run.expect(t >= 0 && t <= 1, "samples from near = 0 lie inside: " + sampler);
      }
      for (const Real d : bench->delta) run.expect(d >= 0 && std::isfinite(d), "intervals are finite: " + sampler);
      for (const std::pair<double, double>& limits :
           {std::pair(0.0, infinity), {-infinity, 1.0}, {0.0, nan}, {nan, 1.0}, {infinity, infinity}}) {
        run.expect_error(ErrorKind::data, {"ray 41", "finite"}, [&] {
          drawn<Real>(run, sampler, {0, 1, limits.first, limits.second}, 40);
        });
      }
    }
  });
  run.row("-");
  const auto expect_refused = [&](double near_m, double far_m, const std::string& word) {
    SceneLoadOptions options{.near_m = near_m, .far_m = far_m};
    const std::string text = errors_of(options);
    run.expect(text.find(word) != std::string::npos,
               "near " + figure(near_m) + ", far " + figure(far_m) + " is refused with '" + word + "': " + text);
  };
  SceneLoadOptions derived;
  run.expect(errors_of(derived).empty(), "near and far of the scene are good");
  expect_refused(3, 2, "near_m must be below far_m");
  expect_refused(2, 2, "near_m must be below far_m");
  expect_refused(1000, 0, "scene.load.near_m");  // far comes from the depth of the scene and is nearer
  expect_refused(0.5, 1e-3, "near_m must be below far_m");
  run.note("no sampler divides by a distance: near = 0 is an ordinary limit");
}

void stall(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    constexpr double kUlp = std::is_same_v<Real, float> ? 0x1p-23 : 0x1p-52;
    struct Way {
      double from, to, step_m;  // the grid's box along x
    };
    // Steps below the spacing of fp32 at 1e5 m; 2e10 steps; a box of 1e7 m that starts at the origin.
    for (const Way& way :
         {Way{1e5 - 1, 1e5 + 1, 1e-3}, Way{-1e7, 1e7, 1e-3}, Way{0, 1e7, 1e-3}, Way{1e7 - 1, 1e7, 1e-6}}) {
      constexpr std::int64_t kMost = 4096;
      SamplerBuild build = unit_build();
      build.bounds = {{way.from, -1, -1}, {way.to, 1, 1}};
      RayBench<Real> bench(
          run.registry(), "occupancy_grid",
          {{"resolution", "32"}, {"max_samples", std::to_string(kMost)}, {"step_m", figure(way.step_m)}}, build);
      for (const bool training : {false, true}) {
        bench.ctx.training = training;
        bench.set_rays(1, 0, 1e7);
        bench.draw();
        const std::int64_t n = bench.out.count;
        run.expect(n > 0 && n <= kMost, "the march ends with at most max_samples samples");
        // What the ray has of the box, whose sides are padded by 1 % of the longest.
        const double pad = 0.01 * std::max(2.0, way.to - way.from), begin = std::max(0.0, way.from - pad),
                     end = std::min(1e7, way.to + pad);
        const double wanted = std::ceil((end - begin) / way.step_m);
        run.expect(static_cast<double>(n) >= std::min(wanted, kMost / 2.0) - 1,
                   "no fewer than it needs, or half the most");
        double covered = 0;
        for (const Real d : bench.delta) covered += static_cast<double>(d);
        run.measure(std::abs(covered / (end - begin) - 1), 1e-9 + 4 * kUlp * end / (end - begin),
                    "intervals cover the ray");
        const long double step =
            (static_cast<long double>(end) - static_cast<long double>(begin)) / static_cast<long double>(n);
        const double jitter =
            training ? static_cast<double>(uniform01(bench.ctx.random("sampler/occupancy_grid"), 0)) : 0.5;
        for (std::int64_t i = 0; i < n; ++i) {
          const long double place =
              static_cast<long double>(begin) + (static_cast<long double>(i) + static_cast<long double>(jitter)) * step;
          const auto t = static_cast<long double>(bench.t[i]);
          run.measure(static_cast<double>(std::abs(t - place)), 4 * kUlp * end, "place");
          run.expect(i == 0 || bench.t[i] >= bench.t[i - 1], "places ascend");
        }
        if (static_cast<double>(n) < wanted)
          run.expect(static_cast<double>(bench.delta[0]) > 1.5 * way.step_m, "longer steps stand in their intervals");
      }
    }
    RayBench<Real> even(run.registry(), "stratified", {{"samples", "1024"}});
    even.set_rays({1e5, 1e5 + 1e-3, 0, 1e7, 1e7 - 1, 1e7});
    even.draw();
    for (std::size_t i = 0; i < even.t.size(); ++i) {
      const std::size_t r = i / 1024;
      const double near_m = even.near_far[2 * r], length = even.near_far[2 * r + 1] - near_m;
      const double place = near_m + length * (static_cast<double>(i % 1024) + 0.5) / 1024;
      run.measure(std::abs(static_cast<double>(even.t[i]) - place), kUlp * (near_m + length), "place on a long ray");
      run.expect(even.delta[i] > 0 || std::is_same_v<Real, float>, "intervals have length");
    }
    run.note("a ray that needs more than max_samples takes longer steps over its whole length: its intervals say so");
  });
}

namespace {

template <class Real>
std::unique_ptr<Pipeline<Real>> pipeline(const Registry& registry, bool learned_encoding) {
  PipelineOptions options{.rules = {.rendering = {.background = {0.5, 0.5, 0.5}, .early_stop = 0}}, .lanes = 2};
  std::vector<PassParts<Real>> passes;
  passes.push_back(learned_encoding
                       ? small_pass<Real>(registry, "8", "hash_grid",
                                          {{"levels", "2"}, {"log2_entries", "10"}, {"finest_resolution", "32"}},
                                          {{0, 0, 0}, 0.05, 0.5})
                       : small_pass<Real>(registry, "8"));
  return std::make_unique<Pipeline<Real>>(std::move(passes), options, true);
}

// A batch of `rays` rays with these limits and no label.
struct Batch {
  Batch(std::int64_t rays, double near_m, double far_m)
      : count(rays),
        direction(3 * static_cast<std::size_t>(rays), 0.0),
        target(direction.size(), 0.25F),
        label(static_cast<std::size_t>(rays), kVoid) {
    for (std::size_t r = 0; r < label.size(); ++r) {
      direction[3 * r] = 1;
      near_far.insert(near_far.end(), {near_m, far_m});
    }
    origin.assign(direction.size(), 0.0);
    if (rays == 0) origin = near_far = direction = {0}, target = {0}, label = {kVoid};  // an address without rows
  }
  RayBatch view() const {
    return RayBatch{.origin = {origin.data(), count, 3},
                    .direction = {direction.data(), count, 3},
                    .near_far = {near_far.data(), count, 2},
                    .targets = {.color = {target.data(), count, 3}, .label = {label.data(), count, 1}}};
  }
  std::int64_t count;
  std::vector<double> origin, direction, near_far;
  std::vector<float> target;
  std::vector<std::int16_t> label;
};

}  // namespace

void empty_batch(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    for (const std::string sampler : kSamplers) {
      const auto none = drawn<Real>(run, sampler, {});
      run.expect(none->out.count == 0 && none->first[0] == 0, "no rays, no samples: " + sampler);
    }
    RayBuffers<Real> no_rays({}, 2), no_samples({0, 0}, 2);
    no_samples.background = {0.25, 0.5, 1};
    for (auto* rays : {&no_rays, &no_samples}) {
      rays->forward();
      rays->backward();
    }
    run.measure(std::abs(static_cast<double>(no_samples.color[2]) - 1), 0,
                "a ray without samples shows the background");
    run.measure(std::abs(no_samples.opacity[1]), 0, "its opacity");
    Real nothing = 0;
    const float no_target = 0;
    const std::int16_t no_label = kVoid;
    run.measure(photometric_loss<Real>(View<const Real>(&nothing, 0, 3), View<const float>(&no_target, 0, 3), 1, 1, {}),
                0, "colour loss");
    SemanticTargets targets{.hard = {&no_label, 0, 1}};
    run.measure(semantic_cross_entropy<Real>(View<const Real>(&nothing, 0, 5), targets, {}, 0, 1, {}).sum, 0,
                "semantic loss");
    for (const bool learned_encoding : {false, true}) {
      const auto model = pipeline<Real>(run.registry(), learned_encoding);
      const auto largest_gradient = [&] {
        double largest = 0;
        for (const Tensor<Real>& tensor : model->store().all()) {
          for (std::size_t i = 0; i < tensor.grad.size(); ++i)
            largest = std::max<double>(largest, std::abs(tensor.grad.data()[i]));
        }
        return largest;
      };
      const StepLosses none = model->gradients(0, Batch(0, 0, 0).view());
      for (const double loss : {none.total, none.color, none.semantic, none.mse})
        run.measure(loss, 0, "loss of no rays");
      run.measure(largest_gradient(), 0, "its gradient");
      const StepLosses dark = model->gradients(1, Batch(20, 1, 1).view());
      run.measure(std::abs(dark.color - 0.0625), 1e-15, "loss of rays that see the background alone");
      run.measure(std::abs(dark.semantic), 0, "semantic loss without labels");
      run.measure(largest_gradient(), 0, "gradient of rays without samples");
      run.expect(dark.samples == 0, "rays without samples have none");
      RenderJob<Real> job;
      const Batch empty(0, 0, 0), rays(3, 2, 2);
      job.origin = empty.view().origin;
      job.direction = empty.view().direction;
      job.near_far = empty.view().near_far;
      model->render(job);
      std::vector<Real> color(9, -1), opacity(3, -1);
      job.origin = rays.view().origin;
      job.direction = rays.view().direction;
      job.near_far = rays.view().near_far;
      job.color = {color.data(), 3, 3};
      job.opacity = {opacity.data(), 3, 1};
      model->render(job);
      for (const Real c : color) run.measure(std::abs(static_cast<double>(c) - 0.5), 0, "rendered background");
      for (const Real o : opacity) run.measure(std::abs(o), 0, "rendered opacity");
    }
  });
}

}  // namespace semfield::numerics
