// An encoder of CPUs alone: halves of the coordinates, without kernel tables.
#include "plugin/module.h"

namespace semfield {

struct PlainParams {};
void describe(ParamVisitor&, PlainParams&) {}
void validate(const PlainParams&, Diagnostics&) {}

template <class Real>
class Plain final : public Encoder<Real> {
 public:
  Plain(const PlainParams&, const EncoderBuild& build, const KernelTables&) : dims_(build.in_dims) {}
  EncoderTraits traits() const noexcept override { return {dims_, dims_, Domain::metric}; }

 protected:
  void do_forward(const StepContext&, const Tensors<Real>&, View<const double> x, View<Real> y) const override {
    for (std::int64_t r = 0; r < x.rows; ++r) {
      for (std::int32_t c = 0; c < x.cols; ++c) y(r, c) = static_cast<Real>(0.5 * x(r, c));
    }
  }
  void do_backward(const StepContext&, const Tensors<Real>&, View<const double>, View<const Real> dy,
                   View<Real> dx) const override {
    for (std::int64_t r = 0; r < dx.rows; ++r) {
      for (std::int32_t c = 0; c < dx.cols; ++c) dx(r, c) = dy(r, c) / 2;
    }
  }

 private:
  std::int32_t dims_;
};

namespace {
void register_into(Registry& registry) {
  registry.add_encoder<Plain, PlainParams>("plain", "Halves of the coordinates, on CPUs alone.");
}
}  // namespace

SEMFIELD_PLUGIN_MODULE(plain, "1.0", register_into)

}  // namespace semfield
