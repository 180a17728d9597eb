// An encoder of the registry with its own tensors.
#pragma once

#include "core/rng.h"
#include "core/workspace.h"
#include "named_case.h"
#include "plugin/encoder.h"
#include "testkit/compare.h"
#include "testkit/laws.h"

namespace semfield::numerics {

template <class Real>
std::unique_ptr<Encoder<Real>> make_encoder(const Registry& registry, const std::string& name,
                                            const testkit::Settings& settings, const EncoderBuild& build) {
  const PluginEntry& entry = registry.get(PluginKind::encoder, name);
  const std::unique_ptr<PluginParams> params = testkit::make_params(entry, settings);
  if constexpr (std::is_same_v<Real, float>) {
    return entry.encoder32(*params, build, registry.kernels());
  } else {
    return entry.encoder64(*params, build, registry.kernels());
  }
}

template <class Real>
class EncoderBox {
 public:
  EncoderBox(const Registry& registry, const std::string& name, const testkit::Settings& settings,
             std::int32_t in_dims = 3)
      : encoder_(make_encoder<Real>(registry, name, settings, build_of(in_dims))), box_(*encoder_, 1, 1.0) {}

  const Encoder<Real>& encoder() const { return *encoder_; }
  testkit::TensorBox<Real>& tensors() { return box_; }
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
  static EncoderBuild build_of(std::int32_t in_dims) { return EncoderBuild{.in_dims = in_dims}; }
  std::int64_t rows(const std::vector<double>& x) const { return static_cast<std::int64_t>(x.size()) / in_dims(); }
  std::unique_ptr<Encoder<Real>> encoder_;
  testkit::TensorBox<Real> box_;
  Workspace workspace_;
};

/// Uniform numbers for inputs, by address; float64 with all 53 bits.
class Numbers {
 public:
  explicit Numbers(std::uint64_t seed) : seed_(seed) {}
  double in(double low, double high) { return low + (high - low) * uniform(); }
  double uniform() {
    const PhiloxBlock b = random_block({seed_, 0, stream_id("stiff cases")}, next_++);
    return static_cast<double>((std::uint64_t{b.v[0]} << 21) ^ (b.v[1] >> 11)) * 0x1p-53;
  }

 private:
  std::uint64_t seed_, next_ = 0;
};

}  // namespace semfield::numerics
