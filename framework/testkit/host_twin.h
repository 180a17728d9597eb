// Components on a device that look like ones on the host: laws and numerical cases written for host memory run on them.
#pragma once

#include "execution/device_library.h"
#include "plugin/encoder.h"
#include "plugin/field.h"
#include "plugin/head.h"
#include "plugin/sampler.h"

namespace semfield::testkit {

/// Where a twin's calls run. Each call copies its views to the device, with their strides and what stands between their
/// rows, so that an element which the kernel leaves alone comes back as it was; then whatever the call may write is
/// copied back. Throws Error(internal) when a kernel wrote into an input or beside a view. StepContext::workspace is an
/// arena of `calls.memory` (LawOptions::scratch).
struct TwinOptions {
  DeviceCalls calls;
  bool deterministic = false;
};

/// Parametric::derive and derive_backward of a component on the device.
void derive_there(const Parametric<float>& component, const TwinOptions& options, const StepContext& ctx,
                  const Tensors<float>& tensors);
void derive_backward_there(const Parametric<float>& component, const TwinOptions& options, const StepContext& ctx,
                           const Tensors<float>& tensors);

/// What twins of every kind are. `on_device` was built for the device of `options.calls` and outlives the twin.
template <class Kind>
class HostTwin : public Kind {
 public:
  HostTwin(const Kind& on_device, TwinOptions options) : device_(on_device), options_(options) {}
  void declare(ParamDeclarer& declarer) const final { device_.declare(declarer); }
  void derive(const StepContext& ctx, const Tensors<float>& tensors) const final {
    derive_there(device_, options_, ctx, tensors);
  }
  void derive_backward(const StepContext& ctx, const Tensors<float>& tensors) const final {
    derive_backward_there(device_, options_, ctx, tensors);
  }

 protected:
  const Kind& device_;
  TwinOptions options_;
};

class HostEncoder final : public HostTwin<Encoder<float>> {
 public:
  using HostTwin::HostTwin;
  EncoderTraits traits() const noexcept override { return device_.traits(); }
  std::size_t scratch_bytes(std::int64_t samples) const noexcept override { return device_.scratch_bytes(samples); }

 protected:
  void do_forward(const StepContext& ctx, const Tensors<float>& tensors, View<const double> x,
                  View<float> y) const override;
  void do_backward(const StepContext& ctx, const Tensors<float>& tensors, View<const double> x, View<const float> dy,
                   View<float> dx) const override;
};

class HostField final : public HostTwin<Field<float>> {
 public:
  using HostTwin::HostTwin;
  FieldTraits traits() const noexcept override { return device_.traits(); }
  std::size_t saved_bytes(std::int64_t samples, std::int64_t rays) const noexcept override {
    return device_.saved_bytes(samples, rays);
  }
  std::size_t scratch_bytes(std::int64_t samples, std::int64_t rays) const noexcept override {
    return device_.scratch_bytes(samples, rays);
  }
  std::vector<LayerShape> layers() const override { return device_.layers(); }
  std::int64_t multiply_adds(std::int64_t samples, std::int64_t rays) const override {
    return device_.multiply_adds(samples, rays);
  }

 protected:
  void do_forward(const StepContext& ctx, const Tensors<float>& tensors, const FieldIn<float>& in,
                  const FieldOut<float>& out, Saved saved) const override;
  void do_backward(const StepContext& ctx, const Tensors<float>& tensors, const FieldIn<float>& in,
                   const FieldOut<float>& out, const FieldGrad<float>& grad, Saved saved,
                   View<float> d_position) const override;
};

class HostHead final : public HostTwin<Head<float>> {
 public:
  using HostTwin::HostTwin;
  std::int32_t hidden_width() const override { return device_.hidden_width(); }
  std::int32_t width() const override { return device_.width(); }
  void hidden_forward(const StepContext& ctx, const Tensors<float>& tensors, View<const float> feature,
                      View<float> hidden) const override;
  void hidden_backward(const StepContext& ctx, const Tensors<float>& tensors, View<const float> feature,
                       View<const float> hidden, View<float> d_hidden, View<float> d_feature) const override;
  void output_forward(const StepContext& ctx, const Tensors<float>& tensors, View<const float> h,
                      View<const float> opacity, View<float> rows) const override;
  void output_backward(const StepContext& ctx, const Tensors<float>& tensors, View<const float> h,
                       View<const float> opacity, View<const float> d_rows, View<float> d_h,
                       View<float> d_opacity) const override;
};

/// On a device Samples::count is the capacity; the twin gives the samples in use, as on the host. All rows of a
/// proposal's views count as its capacity. observe() is not passed on: Error(internal).
class HostSampler final : public HostTwin<Sampler<float>> {
 public:
  using HostTwin::HostTwin;
  SamplerTraits traits() const noexcept override { return device_.traits(); }
  std::int64_t capacity(std::int64_t rays, std::int64_t previous_per_ray) const noexcept override {
    return device_.capacity(rays, previous_per_ray);
  }
  void observe(const StepContext& ctx, const Tensors<float>& tensors, const DensityQuery<float>& query) const override;

 protected:
  void do_sample(const StepContext& ctx, const Tensors<float>& tensors, const Rays<float>& rays,
                 const Proposal<float>* previous, Samples<float>& out) const override;
};

}  // namespace semfield::testkit
