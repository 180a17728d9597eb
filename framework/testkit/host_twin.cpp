// Copies to a device and back around every call.
#include "testkit/host_twin.h"

#include <algorithm>
#include <cstring>
#include <string>
#include <vector>

#include "core/error.h"

namespace semfield::testkit {

namespace {

enum class Access : std::uint8_t { read, write };

constexpr std::size_t kGuardBytes = 256;
constexpr std::byte kGuard{0xFF};  // NaN in float

/// The device's copies of one call's views.
class Copies {
 public:
  Copies(const char* call, const DeviceCalls& calls) : call_(call), calls_(calls) {}
  Copies(const Copies&) = delete;
  Copies& operator=(const Copies&) = delete;
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
  std::vector<View<float>> all(std::span<const View<float>> views, Access access) {
    std::vector<View<float>> device;
    for (const View<float>& view : views) device.push_back(take(view, access));
    return device;
  }

  /// What was written, to the host.
  void bring_back() {
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
  const char* call_;
  const DeviceCalls& calls_;
  std::vector<Copy> copies_;
};

/// The device's copies of tensors.
struct DeviceTensors {
  DeviceTensors(Copies& copies, const Tensors<float>& host, Access values, Access grads)
      : value(copies.all(host.value, values)), grad(copies.all(host.grad, grads)) {}
  Tensors<float> view() const { return {value, grad}; }
  std::vector<View<float>> value, grad;
};

template <class Component>
void derive_on(const Component& component, const TwinOptions& options, const StepContext& ctx,
               const Tensors<float>& tensors) {
  Copies copies("derive", options.calls);
  const DeviceTensors t(copies, tensors, Access::write, Access::read);
  options.calls.run(options.deterministic, [&] { component.derive(ctx, t.view()); });
  copies.bring_back();
}

template <class Component>
void derive_backward_on(const Component& component, const TwinOptions& options, const StepContext& ctx,
                        const Tensors<float>& tensors) {
  Copies copies("derive_backward", options.calls);
  const DeviceTensors t(copies, tensors, Access::read, Access::write);
  options.calls.run(options.deterministic, [&] { component.derive_backward(ctx, t.view()); });
  copies.bring_back();
}

FieldIn<float> inputs_on(Copies& copies, const FieldIn<float>& in) {
  return {copies.in(in.position), copies.in(in.direction), copies.in(in.ray_of_sample)};
}

}  // namespace

void HostEncoder::derive(const StepContext& ctx, const Tensors<float>& tensors) const {
  derive_on(device_, options_, ctx, tensors);
}
void HostEncoder::derive_backward(const StepContext& ctx, const Tensors<float>& tensors) const {
  derive_backward_on(device_, options_, ctx, tensors);
}

void HostEncoder::do_forward(const StepContext& ctx, const Tensors<float>& tensors, View<const double> x,
                             View<float> y) const {
  Copies copies("encoder.forward", options_.calls);
  const DeviceTensors t(copies, tensors, Access::read, Access::read);
  const View<const double> x_there = copies.in(x);
  const View<float> y_there = copies.out(y);
  options_.calls.run(options_.deterministic, [&] { device_.forward(ctx, t.view(), x_there, y_there); });
  copies.bring_back();
}

void HostEncoder::do_backward(const StepContext& ctx, const Tensors<float>& tensors, View<const double> x,
                              View<const float> dy, View<float> dx) const {
  Copies copies("encoder.backward", options_.calls);
  const DeviceTensors t(copies, tensors, Access::read, Access::write);
  const View<const double> x_there = copies.in(x);
  const View<const float> dy_there = copies.in(dy);
  const View<float> dx_there = copies.out(dx);
  options_.calls.run(options_.deterministic, [&] { device_.backward(ctx, t.view(), x_there, dy_there, dx_there); });
  copies.bring_back();
}

void HostField::derive(const StepContext& ctx, const Tensors<float>& tensors) const {
  derive_on(device_, options_, ctx, tensors);
}
void HostField::derive_backward(const StepContext& ctx, const Tensors<float>& tensors) const {
  derive_backward_on(device_, options_, ctx, tensors);
}

void HostField::do_forward(const StepContext& ctx, const Tensors<float>& tensors, const FieldIn<float>& in,
                           const FieldOut<float>& out, Saved saved) const {
  Copies copies("field.forward", options_.calls);
  const DeviceTensors t(copies, tensors, Access::read, Access::read);
  const FieldIn<float> in_there = inputs_on(copies, in);
  const FieldOut<float> out_there{copies.out(out.sigma), copies.out(out.rgb), copies.out(out.feature)};
  const Saved saved_there = copies.out(saved);
  options_.calls.run(options_.deterministic, [&] { device_.forward(ctx, t.view(), in_there, out_there, saved_there); });
  copies.bring_back();
}

void HostField::do_backward(const StepContext& ctx, const Tensors<float>& tensors, const FieldIn<float>& in,
                            const FieldOut<float>& out, const FieldGrad<float>& grad, Saved saved,
                            View<float> d_position) const {
  Copies copies("field.backward", options_.calls);
  const DeviceTensors t(copies, tensors, Access::read, Access::write);
  const FieldIn<float> in_there = inputs_on(copies, in);
  const FieldOut<float> out_there{copies.in(out.sigma), copies.in(out.rgb), copies.in(out.feature)};
  const FieldGrad<float> grad_there{copies.in(grad.sigma), copies.in(grad.rgb), copies.in(grad.feature)};
  const Saved saved_there = copies.out(saved);
  const View<float> d_position_there = copies.out(d_position);
  options_.calls.run(options_.deterministic, [&] {
    device_.backward(ctx, t.view(), in_there, out_there, grad_there, saved_there, d_position_there);
  });
  copies.bring_back();
}

void HostHead::derive(const StepContext& ctx, const Tensors<float>& tensors) const {
  derive_on(device_, options_, ctx, tensors);
}
void HostHead::derive_backward(const StepContext& ctx, const Tensors<float>& tensors) const {
  derive_backward_on(device_, options_, ctx, tensors);
}

void HostHead::hidden_forward(const StepContext& ctx, const Tensors<float>& tensors, View<const float> feature,
                              View<float> hidden) const {
  Copies copies("head.hidden_forward", options_.calls);
  const DeviceTensors t(copies, tensors, Access::read, Access::read);
  const View<const float> feature_there = copies.in(feature);
  const View<float> hidden_there = copies.out(hidden);
  options_.calls.run(options_.deterministic,
                     [&] { device_.hidden_forward(ctx, t.view(), feature_there, hidden_there); });
  copies.bring_back();
}

void HostHead::hidden_backward(const StepContext& ctx, const Tensors<float>& tensors, View<const float> feature,
                               View<const float> hidden, View<float> d_hidden, View<float> d_feature) const {
  Copies copies("head.hidden_backward", options_.calls);
  const DeviceTensors t(copies, tensors, Access::read, Access::write);
  const View<const float> feature_there = copies.in(feature), hidden_there = copies.in(hidden);
  const View<float> d_hidden_there = copies.out(d_hidden), d_feature_there = copies.out(d_feature);
  options_.calls.run(options_.deterministic, [&] {
    device_.hidden_backward(ctx, t.view(), feature_there, hidden_there, d_hidden_there, d_feature_there);
  });
  copies.bring_back();
}

void HostHead::output_forward(const StepContext& ctx, const Tensors<float>& tensors, View<const float> h,
                              View<const float> opacity, View<float> rows) const {
  Copies copies("head.output_forward", options_.calls);
  const DeviceTensors t(copies, tensors, Access::read, Access::read);
  const View<const float> h_there = copies.in(h), opacity_there = copies.in(opacity);
  const View<float> rows_there = copies.out(rows);
  options_.calls.run(options_.deterministic,
                     [&] { device_.output_forward(ctx, t.view(), h_there, opacity_there, rows_there); });
  copies.bring_back();
}

void HostHead::output_backward(const StepContext& ctx, const Tensors<float>& tensors, View<const float> h,
                               View<const float> opacity, View<const float> d_rows, View<float> d_h,
                               View<float> d_opacity) const {
  Copies copies("head.output_backward", options_.calls);
  const DeviceTensors t(copies, tensors, Access::read, Access::write);
  const View<const float> h_there = copies.in(h), opacity_there = copies.in(opacity), d_there = copies.in(d_rows);
  const View<float> d_h_there = copies.out(d_h), d_opacity_there = copies.out(d_opacity);
  options_.calls.run(options_.deterministic, [&] {
    device_.output_backward(ctx, t.view(), h_there, opacity_there, d_there, d_h_there, d_opacity_there);
  });
  copies.bring_back();
}

void HostSampler::derive(const StepContext& ctx, const Tensors<float>& tensors) const {
  derive_on(device_, options_, ctx, tensors);
}

void HostSampler::observe(const StepContext&, const Tensors<float>&, const DensityQuery<float>&) const {
  throw Error(ErrorKind::internal, "internal.sampler.twin", "a sampler's twin on the host does not observe");
}

void HostSampler::do_sample(const StepContext& ctx, const Tensors<float>& tensors, const Rays<float>& rays,
                            const Proposal<float>* previous, Samples<float>& out) const {
  Copies copies("sampler.sample", options_.calls);
  const DeviceTensors t(copies, tensors, Access::read, Access::read);
  const Rays<float> rays_there{copies.in(rays.origin), copies.in(rays.direction), copies.in(rays.near_far)};
  Samples<float> out_there{copies.out(out.t), copies.out(out.delta), copies.out(out.ray_of_sample),
                           copies.out(out.first), 0};
  Samples<float> before;
  Proposal<float> proposal;
  if (previous != nullptr) {
    const Samples<float>& given = *previous->samples;
    before = {copies.in(given.t), copies.in(given.delta), copies.in(given.ray_of_sample), copies.in(given.first),
              given.t.rows};
    proposal = {&before, copies.in(previous->weight, given.t.rows)};
  }
  options_.calls.run(options_.deterministic, [&] {
    device_.sample(ctx, t.view(), rays_there, previous != nullptr ? &proposal : nullptr, out_there);
  });
  copies.bring_back();
  out.count = out.first(rays.origin.rows, 0);
}

}  // namespace semfield::testkit
