// The laws of samplers.
#include <algorithm>

#include "core/rng.h"
#include "testkit/benches.h"
#include "testkit/compare.h"
#include "testkit/laws.h"

namespace semfield::testkit {

namespace {

constexpr std::int64_t kRayCounts[] = {0, 1, 31, 33, 257};
constexpr std::int64_t kFewRays = 33;
constexpr std::int32_t kProposalSamples = 16;

bool is_empty_ray(std::int64_t ray) { return ray % 8 == 5; }

// Rays from inside the bounds in addressed directions; every eighth has near == far.
struct RayBatch {
  RayBatch(std::int64_t rays, const SamplerBuild& build, std::uint64_t seed)
      : origin(rays, 3), direction(rays, 3), near_far(rays, 2) {
    const RandomAddress address{seed, 0, stream_id("testkit/rays")};
    for (std::int64_t r = 0; r < rays; ++r) {
      const auto random = [&](int i) {
        return static_cast<double>(uniform01(address, static_cast<std::uint64_t>(8 * r + i)));
      };
      const Vec3d unit = normalized(Vec3d{random(0) - 0.5, random(1) - 0.5, random(2) - 0.45});
      for (int i = 0; i < 3; ++i) {
        const double share = 0.1 + 0.8 * random(3 + i);
        origin(r, i) = build.bounds.lo[i] + share * (build.bounds.hi[i] - build.bounds.lo[i]);
        direction(r, i) = unit[i];
      }
      near_far(r, 0) = build.near_m;
      near_far(r, 1) =
          is_empty_ray(r) ? build.near_m : build.near_m + (build.far_m - build.near_m) * (0.3 + 0.7 * random(6));
    }
  }
  template <class Real>
  Rays<Real> view(std::int64_t begin, std::int64_t count) const {
    return {origin.view().row_range(begin, count), direction.view().row_range(begin, count),
            near_far.view().row_range(begin, count)};
  }
  Guarded<double> origin, direction, near_far;
};

template <class Real>
struct SampleBuffer {
  SampleBuffer(std::int64_t capacity, std::int64_t rays)
      : t(capacity, 1, 1), delta(capacity, 1, 1), ray(capacity, 1, 1), first(rays + 1, 1, 1) {
    samples = {t.view(), delta.view(), ray.view(), first.view(), 0};
  }
  Guarded<Real> t, delta;
  Guarded<std::int32_t> ray, first;
  Samples<Real> samples;
};

// What an earlier pass would have left: equal intervals with addressed positive weights.
template <class Real>
struct EarlierPass {
  EarlierPass(const RayBatch& batch, std::int64_t begin, std::int64_t rays, std::uint64_t seed)
      : buffer(rays * kProposalSamples, rays), weight(rays * kProposalSamples, 1) {
    const RandomAddress address{seed, 0, stream_id("testkit/weights")};
    std::int64_t n = 0;
    for (std::int64_t r = 0; r < rays; ++r) {
      buffer.first(r, 0) = static_cast<std::int32_t>(n);
      const double near_m = batch.near_far(begin + r, 0);
      const double width = (batch.near_far(begin + r, 1) - near_m) / kProposalSamples;
      for (std::int32_t k = 0; k < kProposalSamples && width > 0; ++k, ++n) {
        buffer.t(n, 0) = static_cast<Real>(near_m + (k + 0.5) * width);
        buffer.delta(n, 0) = static_cast<Real>(width);
        buffer.ray(n, 0) = static_cast<std::int32_t>(r);
        const auto index = static_cast<std::uint64_t>((begin + r) * kProposalSamples + k);
        weight(n, 0) = static_cast<Real>((0.01 + uniform01(address, index)) / kProposalSamples);
      }
    }
    buffer.first(rays, 0) = static_cast<std::int32_t>(n);
    buffer.samples.count = n;
    proposal = {&buffer.samples, weight.view().row_range(0, n)};
  }
  SampleBuffer<Real> buffer;
  Guarded<Real> weight;
  Proposal<Real> proposal;
};

// One sampler with tensors; run() samples rays [begin, begin + rays) of a batch as they stand in the whole.
template <class Real>
struct SamplerBench : ComponentBench<Real, Sampler> {
  SamplerBench(const Sampler<Real>& sampler, const LawOptions& options)
      : ComponentBench<Real, Sampler>(sampler, options, 0.0), seed(options.seed) {
    this->derive();
  }
  SampleBuffer<Real> run(const RayBatch& batch, std::int64_t begin, std::int64_t rays) {
    const Sampler<Real>& sampler = this->component;
    const bool needs_previous = sampler.traits().needs_previous;
    EarlierPass<Real> earlier(batch, begin, rays, seed);
    const std::int64_t room = sampler.capacity(rays, needs_previous ? kProposalSamples : 0, this->ctx.training);
    SampleBuffer<Real> out(room, rays);
    this->ctx.first_ray = begin;
    sampler.sample(this->ctx, this->box.values_only(), batch.view<Real>(begin, rays),
                   needs_previous ? &earlier.proposal : nullptr, out.samples);
    return out;
  }
  std::uint64_t seed;
};

std::string at(const char* what, std::int64_t ray) { return std::string(what) + " in ray " + std::to_string(ray); }

// Sorted, inside [near, far], delta > 0 and together no longer than the ray, numbering consistent.
template <class Real>
void check_samples(const std::string& law, const SampleBuffer<Real>& out, const RayBatch& batch, std::int64_t rays,
                   Failures& failures) {
  const std::int64_t count = out.samples.count;
  for (const std::string& guard :
       {out.t.broken_guard(), out.delta.broken_guard(), out.ray.broken_guard(), out.first.broken_guard(),
        out.first.unwritten(), out.t.unwritten(count), out.delta.unwritten(count), out.ray.unwritten(count)}) {
    note_failure(failures, law, guard);
  }
  if (!failures.empty()) return;
  if (out.first(0, 0) != 0) return note_failure(failures, law, "first[0] is not 0");
  if (out.first(rays, 0) != count) return note_failure(failures, law, "first[rays] is not the count of samples");
  for (std::int64_t r = 0; r < rays; ++r) {
    const std::int64_t begin = out.first(r, 0);
    const std::int64_t end = out.first(r + 1, 0);
    if (end < begin) return note_failure(failures, law, at("first decreases", r));
    const double near_m = batch.near_far(r, 0);
    const double far_m = batch.near_far(r, 1);
    const double slack = 1e-6 * std::max(1.0, far_m);  // rounding of fp32 distances
    if (is_empty_ray(r) && end != begin) return note_failure(failures, law, at("samples though near == far", r));
    double covered = 0;
    for (std::int64_t i = begin; i < end; ++i) {
      const auto t = static_cast<double>(out.t(i, 0));
      if (out.ray(i, 0) != r) return note_failure(failures, law, at("ray_of_sample is another ray", r));
      if (!(out.delta(i, 0) > 0)) return note_failure(failures, law, at("delta is not positive", r));
      if (t < near_m - slack || t > far_m + slack)
        return note_failure(failures, law, at("a sample lies outside [near, far]", r));
      if (i > begin && out.t(i, 0) < out.t(i - 1, 0))
        return note_failure(failures, law, at("distances are not ascending", r));
      covered += static_cast<double>(out.delta(i, 0));
    }
    if (covered > (far_m - near_m) * (1 + 1e-4) + slack)
      return note_failure(failures, law, at("intervals are together longer than the ray", r));
  }
}

// Samples of `part` have the bits of the samples of rays [begin, begin + rays) in `whole`.
template <class Real>
void check_same(const std::string& law, const SampleBuffer<Real>& part, const SampleBuffer<Real>& whole,
                std::int64_t begin, std::int64_t rays, Failures& failures) {
  const std::int64_t offset = whole.first(begin, 0);
  if (part.samples.count != whole.first(begin + rays, 0) - offset)
    return note_failure(failures, law, "another number of samples");
  const std::int64_t count = part.samples.count;
  note_failure(failures, law + ", t",
               compare_bits<Real>(part.t.view().row_range(0, count), whole.t.view().row_range(offset, count)));
  note_failure(failures, law + ", delta",
               compare_bits<Real>(part.delta.view().row_range(0, count), whole.delta.view().row_range(offset, count)));
}

template <class Real>
void check_addressing(const Sampler<Real>& sampler, const SamplerBuild& build, const LawOptions& options,
                      Failures& failures) {
  options.begin("the same rays again, and parts of them");
  const RayBatch batch(kFewRays, build, options.seed);
  SamplerBench<Real> bench(sampler, options);
  const SampleBuffer<Real> whole = bench.run(batch, 0, kFewRays);
  check_same("same seed and step again", bench.run(batch, 0, kFewRays), whole, 0, kFewRays, failures);
  check_same("second part of a split", bench.run(batch, 13, kFewRays - 13), whole, 13, kFewRays - 13, failures);
  check_same("first part of a split", bench.run(batch, 0, 13), whole, 0, 13, failures);
  for (std::int64_t r = kFewRays - 1; r >= 0; r -= 5)
    check_same("a ray alone", bench.run(batch, r, 1), whole, r, 1, failures);
  options.begin("without training");
  bench.ctx.training = false;
  const SampleBuffer<Real> still = bench.run(batch, 0, kFewRays);
  check_samples("without training", still, batch, kFewRays, failures);
  bench.ctx.seed += 1;
  bench.ctx.step += 7;
  check_same("without training, another seed and step", bench.run(batch, 0, kFewRays), still, 0, kFewRays, failures);
}

void check_precision(const Sampler<float>& sampler32, const Sampler<double>& sampler64, const SamplerBuild& build,
                     const LawOptions& options, Failures& failures) {
  options.begin("float against double");
  const RayBatch batch(kFewRays, build, options.seed);
  SamplerBench<float> single(sampler32, options);
  SamplerBench<double> twin(sampler64, options);
  const SampleBuffer<float> a = single.run(batch, 0, kFewRays);
  const SampleBuffer<double> b = twin.run(batch, 0, kFewRays);
  if (a.samples.count != b.samples.count)
    return note_failure(failures, "float against double", "another number of samples");
  const std::int64_t count = b.samples.count;
  note_failure(
      failures, "float against double, t",
      compare<float, double>(a.t.view().row_range(0, count), b.t.view().row_range(0, count), options.float_tolerance));
}

}  // namespace

Failures sampler_laws(const Sampler<float>& sampler32, const Sampler<double>& sampler64, const SamplerBuild& build,
                      const LawOptions& options) {
  Failures failures;
  std::int64_t total = 0;
  for (const std::int64_t rays : kRayCounts) {
    options.begin(std::to_string(rays) + " rays");
    const RayBatch batch(rays, build, options.seed);
    SamplerBench<float> bench(sampler32, options);
    const SampleBuffer<float> out = bench.run(batch, 0, rays);
    check_samples(std::to_string(rays) + " rays", out, batch, rays, failures);
    total += out.samples.count;
    SamplerBench<double> twin(sampler64, options);
    check_samples(std::to_string(rays) + " rays in double", twin.run(batch, 0, rays), batch, rays, failures);
  }
  if (total == 0) failures.push_back("no ray of any batch has a sample");
  check_addressing(sampler32, build, options, failures);
  check_addressing(sampler64, build, options, failures);
  check_precision(sampler32, sampler64, build, options, failures);
  return failures;
}

}  // namespace semfield::testkit
