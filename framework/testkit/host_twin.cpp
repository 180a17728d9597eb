// Copies to a device and back around every call.
#include "testkit/host_twin.h"

#include <algorithm>
#include <cstring>
#include <functional>
#include <string>
#include <vector>

#include "core/error.h"
#include "core/non_copyable.h"

namespace semfield::testkit {

namespace {

enum class Access : std::uint8_t { read, write };

constexpr std::size_t kGuardBytes = 256;
constexpr std::byte kGuard{0xFF};  // NaN in float

/// The device's copies of one call's views, its tensors first.
class Copies : NonCopyable {
 public:
  Copies(const char* call, const TwinOptions& options, const Tensors<float>& tensors, Access grads = Access::read,
         Access values = Access::read)
      : call_(call),
        options_(options),
        calls_(options.calls),
        value_(all(tensors.value, values)),
        grad_(all(tensors.grad, grads)) {}
  ~Copies() {
    for (const Copy& copy : copies_) calls_.memory.release(copy.device);
  }

  /// The view on the device, with room for `rows` rows or as many as it has.
  template <class T>
  View<T> take(const View<T>& host, Access access, std::int64_t rows = 0) {
    const View<T> empty(nullptr, host.rows, host.cols, host.row_stride, calls_.memory.device);
    if (host.empty()) return empty;
    View<T> device = empty;
    device.rows = std::max(rows, host.rows);
    const std::size_t used = bytes_of(host);
    const std::size_t room = (bytes_of(device) + kGuardBytes - 1) / kGuardBytes * kGuardBytes;
    Copy copy;
    copy.whole.assign(room + 2 * kGuardBytes, kGuard);
    copy.used = used;
    copy.host = access == Access::write ? const_cast<std::remove_const_t<T>*>(host.data) : nullptr;
    if (used > 0) std::memcpy(copy.whole.data() + kGuardBytes, host.data, used);
    copy.device = calls_.memory.allocate(copy.whole.size());
    copies_.push_back(std::move(copy));
    const Copy& kept = copies_.back();
    calls_.to_device(kept.whole.data(), kept.device, kept.whole.size());
    device.data = reinterpret_cast<T*>(kept.device + kGuardBytes);
    return device;
  }
  template <class T>
  View<T> in(const View<T>& host, std::int64_t rows = 0) {
    return take(host, Access::read, rows);
  }
  template <class T>
  View<T> out(const View<T>& host) {
    return take(host, Access::write);
  }
  Saved out(Saved host) {
    const View<std::byte> view = out(View<std::byte>(host.data(), static_cast<std::int64_t>(host.size()), 1));
    return Saved(view.data, host.size());
  }
  Tensors<float> tensors() const { return {value_, grad_}; }

  /// Runs the call, then brings what it wrote to the host.
  void run(const std::function<void()>& body) {
    calls_.run(options_.deterministic, body);
    for (const Copy& copy : copies_) {
      std::vector<std::byte> now(copy.whole.size());
      calls_.to_host(copy.device, now.data(), now.size());
      const std::size_t end = kGuardBytes + copy.used;
      for (std::size_t i = 0; i < now.size(); ++i) {
        const bool inside = i >= kGuardBytes && i < end;
        if (now[i] == copy.whole[i] || (inside && copy.host != nullptr)) continue;
        const std::string where = inside            ? "into an input"
                                  : i < kGuardBytes ? std::to_string(kGuardBytes - i) + " bytes before a view"
                                                    : std::to_string(i - end) + " bytes behind a view";
        throw Error(ErrorKind::internal, "plugin.kernels.out_of_bounds",
                    std::string(call_) + " on the device wrote " + where);
      }
      if (copy.host != nullptr) std::memcpy(copy.host, now.data() + kGuardBytes, copy.used);
    }
  }

 private:
  struct Copy {
    std::vector<std::byte> whole;  // guard, rows, guard
    std::size_t used = 0;          // bytes of the host's rows
    void* host = nullptr;          // where they go back to
    std::byte* device = nullptr;
  };
  template <class T>
  static std::size_t bytes_of(const View<T>& view) {
    const std::int64_t elements = view.rows == 0 ? 0 : (view.rows - 1) * view.row_stride + view.cols;
    return static_cast<std::size_t>(elements) * sizeof(T);
  }
  std::vector<View<float>> all(std::span<const View<float>> views, Access access) {
    std::vector<View<float>> device;
    for (const View<float>& view : views) device.push_back(take(view, access));
    return device;
  }
  const char* call_;
  const TwinOptions& options_;
  const DeviceCalls& calls_;
  std::vector<Copy> copies_;
  std::vector<View<float>> value_, grad_;
};

/// What twins of every kind are.
template <class Kind>
class HostTwin : public Kind {
 public:
  HostTwin(const Kind& on_device, const TwinOptions& options) : device_(on_device), options_(options) {}
  void declare(ParamDeclarer& declarer) const final { device_.declare(declarer); }
  void derive(const StepContext& ctx, const Tensors<float>& tensors) const final {
    Copies there("derive", options_, tensors, Access::read, Access::write);
    there.run([&] { device_.derive(ctx, there.tensors()); });
  }
  void derive_backward(const StepContext& ctx, const Tensors<float>& tensors) const final {
    Copies there("derive_backward", options_, tensors, Access::write);
    there.run([&] { device_.derive_backward(ctx, there.tensors()); });
  }

 protected:
  const Kind& device_;
  TwinOptions options_;
};

class HostEncoder final : public HostTwin<Encoder<float>> {
 public:
  using HostTwin::HostTwin;
  EncoderTraits traits() const noexcept override { return device_.traits(); }

 protected:
  void do_forward(const StepContext& ctx, const Tensors<float>& tensors, View<const double> x,
                  View<float> y) const override {
    Copies there("encoder.forward", options_, tensors);
    x = there.in(x), y = there.out(y);
    there.run([&] { device_.forward(ctx, there.tensors(), x, y); });
  }
  void do_backward(const StepContext& ctx, const Tensors<float>& tensors, View<const double> x, View<const float> dy,
                   View<float> dx) const override {
    Copies there("encoder.backward", options_, tensors, Access::write);
    x = there.in(x), dy = there.in(dy), dx = there.out(dx);
    there.run([&] { device_.backward(ctx, there.tensors(), x, dy, dx); });
  }
};

class HostField final : public HostTwin<Field<float>> {
 public:
  using HostTwin::HostTwin;
  FieldTraits traits() const noexcept override { return device_.traits(); }
  std::size_t saved_bytes(std::int64_t samples, std::int64_t rays) const noexcept override {
    return device_.saved_bytes(samples, rays);
  }

 protected:
  static FieldIn<float> inputs_on(Copies& there, const FieldIn<float>& in) {
    return {there.in(in.position), there.in(in.direction), there.in(in.ray_of_sample)};
  }
  void do_forward(const StepContext& ctx, const Tensors<float>& tensors, const FieldIn<float>& in,
                  const FieldOut<float>& out, Saved saved) const override {
    Copies there("field.forward", options_, tensors);
    const FieldIn<float> inputs = inputs_on(there, in);
    const FieldOut<float> outputs{there.out(out.sigma), there.out(out.rgb), there.out(out.feature)};
    saved = there.out(saved);
    there.run([&] { device_.forward(ctx, there.tensors(), inputs, outputs, saved); });
  }
  void do_backward(const StepContext& ctx, const Tensors<float>& tensors, const FieldIn<float>& in,
                   const FieldOut<float>& out, const FieldGrad<float>& grad, Saved saved,
                   View<float> d_position) const override {
    Copies there("field.backward", options_, tensors, Access::write);
    const FieldIn<float> inputs = inputs_on(there, in);
    const FieldOut<float> outputs{there.in(out.sigma), there.in(out.rgb), there.in(out.feature)};
    const FieldGrad<float> gradients{there.in(grad.sigma), there.in(grad.rgb), there.in(grad.feature)};
    saved = there.out(saved), d_position = there.out(d_position);
    there.run([&] { device_.backward(ctx, there.tensors(), inputs, outputs, gradients, saved, d_position); });
  }
};

class HostHead final : public HostTwin<Head<float>> {
 public:
  using HostTwin::HostTwin;
  std::int32_t hidden_width() const override { return device_.hidden_width(); }
  std::int32_t width() const override { return device_.width(); }
  void hidden_forward(const StepContext& ctx, const Tensors<float>& tensors, View<const float> feature,
                      View<float> hidden) const override {
    Copies there("head.hidden_forward", options_, tensors);
    feature = there.in(feature), hidden = there.out(hidden);
    there.run([&] { device_.hidden_forward(ctx, there.tensors(), feature, hidden); });
  }
  void hidden_backward(const StepContext& ctx, const Tensors<float>& tensors, View<const float> feature,
                       View<const float> hidden, View<float> d_hidden, View<float> d_feature) const override {
    Copies there("head.hidden_backward", options_, tensors, Access::write);
    feature = there.in(feature), hidden = there.in(hidden);
    d_hidden = there.out(d_hidden), d_feature = there.out(d_feature);
    there.run([&] { device_.hidden_backward(ctx, there.tensors(), feature, hidden, d_hidden, d_feature); });
  }
  void output_forward(const StepContext& ctx, const Tensors<float>& tensors, View<const float> h,
                      View<const float> opacity, View<float> rows) const override {
    Copies there("head.output_forward", options_, tensors);
    h = there.in(h), opacity = there.in(opacity), rows = there.out(rows);
    there.run([&] { device_.output_forward(ctx, there.tensors(), h, opacity, rows); });
  }
  void output_backward(const StepContext& ctx, const Tensors<float>& tensors, View<const float> h,
                       View<const float> opacity, View<const float> d_rows, View<float> d_h,
                       View<float> d_opacity) const override {
    Copies there("head.output_backward", options_, tensors, Access::write);
    h = there.in(h), opacity = there.in(opacity), d_rows = there.in(d_rows);
    d_h = there.out(d_h), d_opacity = there.out(d_opacity);
    there.run([&] { device_.output_backward(ctx, there.tensors(), h, opacity, d_rows, d_h, d_opacity); });
  }
};

class HostSampler final : public HostTwin<Sampler<float>> {
 public:
  using HostTwin::HostTwin;
  SamplerTraits traits() const noexcept override { return device_.traits(); }
  std::int64_t capacity(std::int64_t rays, std::int64_t previous_per_ray, bool training) const noexcept override {
    return device_.capacity(rays, previous_per_ray, training);
  }
  void observe(const StepContext&, const Tensors<float>&, const DensityQuery<float>&) const override {
    throw Error(ErrorKind::internal, "internal.sampler.twin", "a sampler's twin on the host does not observe");
  }

 protected:
  void do_sample(const StepContext& ctx, const Tensors<float>& tensors, const Rays<float>& rays,
                 const Proposal<float>* previous, Samples<float>& out) const override {
    Copies there("sampler.sample", options_, tensors);
    const Rays<float> seen{there.in(rays.origin), there.in(rays.direction), there.in(rays.near_far)};
    Samples<float> drawn{there.out(out.t), there.out(out.delta), there.out(out.ray_of_sample), there.out(out.first), 0};
    Samples<float> before;
    Proposal<float> proposal;
    if (previous != nullptr) {
      const Samples<float>& given = *previous->samples;
      before = {there.in(given.t), there.in(given.delta), there.in(given.ray_of_sample), there.in(given.first),
                given.t.rows};
      proposal = {&before, there.in(previous->weight, given.t.rows)};
    }
    there.run([&] { device_.sample(ctx, there.tensors(), seen, previous != nullptr ? &proposal : nullptr, drawn); });
    out.count = out.first(rays.origin.rows, 0);
  }
};

}  // namespace

std::unique_ptr<Encoder<float>> host_twin(const Encoder<float>& on_device, const TwinOptions& options) {
  return std::make_unique<HostEncoder>(on_device, options);
}
std::unique_ptr<Field<float>> host_twin(const Field<float>& on_device, const TwinOptions& options) {
  return std::make_unique<HostField>(on_device, options);
}
std::unique_ptr<Head<float>> host_twin(const Head<float>& on_device, const TwinOptions& options) {
  return std::make_unique<HostHead>(on_device, options);
}
std::unique_ptr<Sampler<float>> host_twin(const Sampler<float>& on_device, const TwinOptions& options) {
  return std::make_unique<HostSampler>(on_device, options);
}

}  // namespace semfield::testkit
