// An encoder that breaks a law: its gradient of the position is twice what it should be.

#include "plugin/module.h"

namespace outside {

using semfield::View;

struct BentParams {};
void describe(semfield::ParamVisitor&, BentParams&) {}
void validate(const BentParams&, semfield::Diagnostics&) {}

/// y[d] = sin(x[d])
template <class Real>
class Bent final : public semfield::Encoder<Real> {
 public:
  Bent(const BentParams&, const semfield::EncoderBuild& build, const semfield::KernelTables&) : dims_(build.in_dims) {}
  semfield::EncoderTraits traits() const noexcept override { return {dims_, dims_, semfield::Domain::metric}; }

 protected:
  void do_forward(const semfield::StepContext&, const semfield::Tensors<Real>&, View<const double> x,
                  View<Real> y) const override {
    for (std::int64_t r = 0; r < x.rows; ++r) {
      for (std::int32_t d = 0; d < dims_; ++d) y(r, d) = static_cast<Real>(std::sin(x(r, d)));
    }
  }
  void do_backward(const semfield::StepContext&, const semfield::Tensors<Real>&, View<const double> x,
                   View<const Real> dy, View<Real> dx) const override {
    for (std::int64_t r = 0; r < x.rows && !dx.empty(); ++r) {
      for (std::int32_t d = 0; d < dims_; ++d)
        dx(r, d) = static_cast<Real>(2 * static_cast<double>(dy(r, d)) * std::cos(x(r, d)));
    }
  }

 private:
  std::int32_t dims_;
};

void register_into(semfield::Registry& registry) {
  registry.add_encoder<Bent, BentParams>("bent", "Sines with a gradient that is wrong.");
}

}  // namespace outside

SEMFIELD_PLUGIN_MODULE(bent, "0.1", outside::register_into)
