// A sampler on the CPU and on the device, given the same rays, tensors and previous samples.
#pragma once

#include <algorithm>

#include "cuda/kernels/kernels.h"
#include "plugin/kernels.h"
#include "plugin/sampler.h"
#include "tests/cuda/device_fixture.h"
#include "tests/encoder_box.h"

namespace semfield::testing {

inline SamplerBuild room_on(Device device) {
  return SamplerBuild{.device = device, .bounds = {{-2, -2, -1}, {3, 2, 2}}, .near_m = 0.05, .far_m = 12};
}

/// One sampler with the kernels of both devices.
struct Twins {
  Twins(const std::string& name, const testkit::Settings& settings)
      : on_cpu(testkit::make_part<float>(registry_with_cuda(), name, settings, room_on(Device::cpu))),
        on_device(testkit::make_part<float>(registry_with_cuda(), name, settings, room_on(Device::cuda))) {}
  std::unique_ptr<Sampler<float>> on_cpu, on_device;
  const Sampler<float>&cpu = *on_cpu, &device = *on_device;
};

struct HostRays {
  std::vector<double> origin, direction, near_far;
  std::int64_t count() const { return static_cast<std::int64_t>(near_far.size()) / 2; }
  Rays<float> view() const { return {host_view(origin, 3), host_view(direction, 3), host_view(near_far, 2)}; }
};

/// Rays from places in the room in all directions; every `empty_every`-th is empty (0: none).
inline HostRays random_rays(std::int64_t count, std::uint64_t seed, std::int64_t empty_every) {
  const Box box = room_on(Device::cpu).bounds;
  HostRays rays;
  for (std::int64_t r = 0; r < count; ++r) {
    const auto random = [&](int i) {
      return static_cast<double>(uniform01({seed, 0, 77}, static_cast<std::uint64_t>(8 * r + i)));
    };
    const Vec3d d = normalized(Vec3d{random(0) - 0.5, random(1) - 0.5, random(2) - 0.4999});
    for (int i = 0; i < 3; ++i) {
      rays.origin.push_back(box.lo[i] + (0.02 + 0.96 * random(3 + i)) * box.size()[i]);
      rays.direction.push_back(d[i]);
    }
    const double near_m = 0.05 + 0.3 * random(6), far_m = near_m + 0.2 + 12 * random(7);
    const bool empty = empty_every > 0 && r % empty_every == empty_every - 1;
    rays.near_far.insert(rays.near_far.end(), {near_m, empty ? near_m : far_m});
  }
  return rays;
}

struct HostSamples {
  std::vector<float> t, delta;
  std::vector<std::int32_t> ray, first;
  std::int64_t live() const { return first.back(); }
};

/// Samples of a previous pass; no ray has more than per_ray.
struct HostProposal {
  HostSamples samples;
  std::vector<float> weight;
  std::int64_t per_ray = 0;
};

/// On the CPU; rows behind the live ones as the device fills them.
inline HostSamples sample_on_cpu(const Sampler<float>& sampler, const StepContext& ctx, const Tensors<float>& tensors,
                                 const HostRays& rays, HostProposal* previous = nullptr) {
  const std::int64_t capacity =
      sampler.capacity(rays.count(), previous == nullptr ? 0 : previous->per_ray, ctx.training);
  HostSamples out;
  out.t.assign(static_cast<std::size_t>(capacity), 0.F);
  out.delta = out.t;
  out.ray.assign(out.t.size(), static_cast<std::int32_t>(rays.count() - 1));
  out.first.assign(static_cast<std::size_t>(rays.count() + 1), 0);
  Samples<float> old;
  Proposal<float> proposal;
  if (previous != nullptr) {
    HostSamples& s = previous->samples;
    old = {host_view(s.t, 1), host_view(s.delta, 1), host_view(s.ray, 1), host_view(s.first, 1), s.live()};
    proposal = {&old, host_view(previous->weight, 1)};
  }
  Samples<float> samples{host_view(out.t, 1), host_view(out.delta, 1), host_view(out.ray, 1), host_view(out.first, 1),
                         0};
  Workspace workspace;
  StepContext host = ctx;
  host.workspace = &workspace;
  sampler.sample(host, tensors, rays.view(), previous == nullptr ? nullptr : &proposal, samples);
  // What lies behind the live rows is the CPU's scratch.
  for (auto i = static_cast<std::size_t>(out.live()); i < out.t.size(); ++i) {
    out.t[i] = out.delta[i] = 0;
    out.ray[i] = static_cast<std::int32_t>(rays.count() - 1);
  }
  return out;
}

/// Inputs and outputs of a sampler in device memory; rows of a stride of `gap` more than their columns.
class DeviceBatch {
 public:
  DeviceBatch(const Sampler<float>& sampler, const HostRays& rays, const HostProposal* previous, std::int64_t gap,
              bool training = true)
      : sampler_(sampler),
        capacity_(sampler.capacity(rays.count(), previous == nullptr ? 0 : previous->per_ray, training)),
        origin_(rays.origin, 3, 3 + gap),
        direction_(rays.direction, 3, 3 + gap),
        near_far_(rays.near_far, 2, 2 + gap),
        t_(capacity_, 1, 1 + gap),
        delta_(capacity_, 1, 1 + gap),
        ray_(capacity_, 1, 1 + gap),
        first_(rays.count() + 1, 1, 1 + gap) {
    if (previous == nullptr) return;
    const std::int64_t rows = rays.count() * previous->per_ray;
    old_t_ = std::make_unique<DeviceMatrix<float>>(padded(previous->samples.t, rows), 1, 1 + gap);
    weight_ = std::make_unique<DeviceMatrix<float>>(padded(previous->weight, rows), 1, 1 + gap);
    old_first_ = std::make_unique<DeviceMatrix<std::int32_t>>(previous->samples.first, 1, 1 + gap);
    old_ = {old_t_->view(), old_t_->view(), {}, old_first_->view(), rows};
    proposal_ = {&old_, weight_->view()};
  }

  void sample(const StepContext& ctx, const Tensors<float>& tensors) {
    Samples<float> out{t_.view(), delta_.view(), ray_.view(), first_.view(), 0};
    sampler_.sample(ctx, tensors, {origin_.read_only(), direction_.read_only(), near_far_.read_only()},
                    old_t_ ? &proposal_ : nullptr, out);
    EXPECT_EQ(out.count, capacity_);
  }
  HostSamples read() const {
    for (const std::string& where :
         {t_.surroundings(), delta_.surroundings(), ray_.surroundings(), first_.surroundings()})
      EXPECT_EQ(where, "");
    return {t_.read(), delta_.read(), ray_.read(), first_.read()};
  }

 private:
  static std::vector<float> padded(std::vector<float> values, std::int64_t rows) {
    values.resize(static_cast<std::size_t>(rows), NAN);  // nobody may read behind the live rows
    return values;
  }
  const Sampler<float>& sampler_;
  std::int64_t capacity_;
  DeviceMatrix<double> origin_, direction_, near_far_;
  DeviceMatrix<float> t_, delta_;
  DeviceMatrix<std::int32_t> ray_, first_;
  std::unique_ptr<DeviceMatrix<float>> old_t_, weight_;
  std::unique_ptr<DeviceMatrix<std::int32_t>> old_first_;
  Samples<float> old_;
  Proposal<float> proposal_;
};

/// A context whose step stands in the launch's cell alone, as in a captured step.
inline StepContext device_context(const StepContext& ctx, DeviceLaunch& launch) {
  cuda::StepCell cell{.step = static_cast<std::uint64_t>(ctx.step)};
  launch.set_cell(cell);
  StepContext on_device = ctx;
  on_device.step = 0;
  on_device.workspace = &launch.arena();
  return on_device;
}

/// "" for equal bits, else the first difference of each kind.
inline std::string difference(const HostSamples& cpu, const HostSamples& device) {
  const auto of = [](const char* what, const auto& want, const auto& got) {
    const std::string found = testkit::compare_bits(host_view(got, 1), host_view(want, 1));
    return found.empty() ? found : what + (": " + found + "\n");
  };
  return of("first", cpu.first, device.first) + of("t", cpu.t, device.t) + of("delta", cpu.delta, device.delta) +
         of("ray", cpu.ray, device.ray);
}

inline StepContext context_at(std::int64_t step, bool training) {
  return StepContext{.seed = 11, .step = step, .training = training, .first_ray = 5, .pass = 1};
}

/// The message of the Error that `body` throws.
template <class Body>
std::string error_of(const Body& body) {
  try {
    body();
  } catch (const Error& e) {
    return e.message();
  }
  return "no error";
}

/// difference() between the sampler's calls on both devices.
inline std::string compare(const Sampler<float>& cpu, const Sampler<float>& device, const StepContext& ctx,
                           const HostRays& rays, HostProposal* previous, std::int64_t gap) {
  DeviceLaunch launch;
  const HostSamples want = sample_on_cpu(cpu, ctx, {}, rays, previous);
  DeviceBatch batch(device, rays, previous, gap, ctx.training);
  batch.sample(device_context(ctx, launch), {});
  const HostSamples got = batch.read();
  EXPECT_EQ(launch.take_fault(), std::nullopt);
  return difference(want, got);
}

/// Previous samples of `rays`: up to `per_ray` per ray, fewer on every third ray if ragged, with weights of many sizes,
/// spikes, and rays without any weight.
inline HostProposal previous_of(const HostRays& rays, std::int64_t per_ray, bool ragged) {
  const Twins twins("stratified", {{"samples", std::to_string(std::max<std::int64_t>(1, per_ray))}});
  const HostSamples all = sample_on_cpu(twins.cpu, context_at(3, true), {}, rays);
  HostProposal previous{.per_ray = per_ray};
  previous.samples.first.push_back(0);
  for (std::int64_t r = 0; r < rays.count(); ++r) {
    const std::int32_t begin = all.first[r];
    const std::int64_t given = all.first[r + 1] - begin;
    const std::int64_t kept = std::min(per_ray, ragged && r % 3 == 1 ? r % (given + 1) : given);
    for (std::int64_t k = 0; k < kept; ++k) {
      const auto at = static_cast<std::size_t>(begin + k);
      const float u = uniform01({4, 0, 5}, static_cast<std::uint64_t>(begin + k));
      previous.samples.t.push_back(all.t[at]);
      previous.samples.delta.push_back(all.delta[at]);
      previous.samples.ray.push_back(static_cast<std::int32_t>(r));
      previous.weight.push_back(r % 5 == 0 ? 0.F : r % 5 == 1 ? (k == kept / 2 ? 1.F : 0.F) : std::exp(-20 * u));
    }
    previous.samples.first.push_back(static_cast<std::int32_t>(previous.samples.t.size()));
  }
  return previous;
}

}  // namespace semfield::testing
