// An encoder from outside: cosines of each coordinate with a learned gain per band.

#include "plugin/module.h"

namespace outside {

using semfield::View;

struct WavesParams {
  int bands = 3;
};
void describe(semfield::ParamVisitor& visit, WavesParams& p) {
  SEMFIELD_PARAM(visit, p, bands, "number of cosine bands", {1, 12});
}
void validate(const WavesParams&, semfield::Diagnostics&) {}

/// y[b] = gain[b] * sum_d cos((b + 1) x[d])
template <class Real>
class Waves final : public semfield::Encoder<Real> {
 public:
  Waves(const WavesParams& params, const semfield::EncoderBuild& build, const semfield::KernelTables&)
      : bands_(params.bands), in_dims_(build.in_dims) {}
  semfield::EncoderTraits traits() const noexcept override { return {in_dims_, bands_, semfield::Domain::metric}; }
  void declare(semfield::ParamDeclarer& declarer) const override {
    declarer.tensor({"gain", bands_, 1, semfield::Init::constant(1.0)});
  }

 protected:
  void do_forward(const semfield::StepContext&, const semfield::Tensors<Real>& tensors, View<const double> x,
                  View<Real> y) const override {
    for (std::int64_t r = 0; r < x.rows; ++r) {
      for (std::int32_t b = 0; b < bands_; ++b)
        y(r, b) = static_cast<Real>(static_cast<double>(tensors.value[0](b, 0)) * sum(x, r, b));
    }
  }
  void do_backward(const semfield::StepContext&, const semfield::Tensors<Real>& tensors, View<const double> x,
                   View<const Real> dy, View<Real> dx) const override {
    for (std::int64_t r = 0; r < x.rows; ++r) {
      for (std::int32_t b = 0; b < bands_; ++b)
        tensors.grad[0](b, 0) += static_cast<Real>(static_cast<double>(dy(r, b)) * sum(x, r, b));
      for (std::int32_t d = 0; d < in_dims_ && !dx.empty(); ++d) {
        double slope = 0;
        for (std::int32_t b = 0; b < bands_; ++b) {
          slope -= static_cast<double>(dy(r, b)) * static_cast<double>(tensors.value[0](b, 0)) * (b + 1) *
                   std::sin((b + 1) * x(r, d));
        }
        dx(r, d) = static_cast<Real>(slope);
      }
    }
  }

 private:
  double sum(View<const double> x, std::int64_t r, std::int32_t b) const {
    double total = 0;
    for (std::int32_t d = 0; d < in_dims_; ++d) total += std::cos((b + 1) * x(r, d));
    return total;
  }
  std::int32_t bands_, in_dims_;
};

void register_into(semfield::Registry& registry) {
  registry.add_encoder<Waves, WavesParams>("waves", "Cosines with a learned gain.");
}

}  // namespace outside

SEMFIELD_PLUGIN_MODULE(waves, "0.1", outside::register_into)
