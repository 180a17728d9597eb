// Plugins by name, and an encoder with its own tensors.
#pragma once

#include <memory>
#include <type_traits>

#include "core/workspace.h"
#include "plugin/encoder.h"
#include "plugin/field.h"
#include "plugin/registry.h"
#include "plugin/sampler.h"
#include "testkit/compare.h"
#include "testkit/laws.h"

namespace semfield::testkit {

/// The plugin of that name, of the kind that `Build` builds; Real = double: its oracle.
template <class Real, class Build>
auto make_part(const Registry& registry, const std::string& name, const Settings& settings, const Build& build) {
  const auto [kind, single, oracle] = makers_for(build);
  const PluginEntry& entry = registry.get(kind, name);
  const std::unique_ptr<PluginParams> params = make_params(entry, settings);
  if constexpr (std::is_same_v<Real, float>) {
    return (entry.*single)(*params, build, registry.kernels());
  } else {
    return (entry.*oracle)(*params, build, registry.kernels());
  }
}

template <class Real>
class EncoderBox {
 public:
  explicit EncoderBox(std::unique_ptr<Encoder<Real>> encoder, const BlockSource& scratch = {})
      : encoder_(std::move(encoder)), box_(*encoder_, 1, 1.0), workspace_(scratch) {}
  EncoderBox(const Registry& registry, const std::string& name, const Settings& settings, std::int32_t in_dims = 3)
      : EncoderBox(make_part<Real>(registry, name, settings, EncoderBuild{.in_dims = in_dims})) {}

  const Encoder<Real>& encoder() const { return *encoder_; }
  TensorBox<Real>& tensors() { return box_; }
  std::int32_t in_dims() const { return encoder_->traits().in_dims; }
  std::int32_t out_dims() const { return encoder_->traits().out_dims; }

  /// y [rows, out_dims] from x [rows, in_dims].
  std::vector<Real> forward(const std::vector<double>& x) {
    std::vector<Real> y(static_cast<std::size_t>(rows(x) * out_dims()), Real(-99));
    encoder_->forward(context(), box_.tensors(), {x.data(), rows(x), in_dims()}, {y.data(), rows(x), out_dims()});
    return y;
  }
  /// dx; gradients are added to the box's.
  std::vector<Real> backward(const std::vector<double>& x, const std::vector<Real>& dy) {
    std::vector<Real> dx(x.size(), Real(-99));
    encoder_->backward(context(), box_.tensors(), {x.data(), rows(x), in_dims()}, {dy.data(), rows(x), out_dims()},
                       {dx.data(), rows(x), in_dims()});
    return dx;
  }
  StepContext context() { return StepContext{.workspace = &workspace_}; }

 private:
  std::int64_t rows(const std::vector<double>& x) const { return static_cast<std::int64_t>(x.size()) / in_dims(); }
  std::unique_ptr<Encoder<Real>> encoder_;
  TensorBox<Real> box_;
  Workspace workspace_;
};

}  // namespace semfield::testkit
