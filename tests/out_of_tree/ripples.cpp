// An encoder from outside with kernels of its own: for every instruction set of CPUs, and for CUDA devices.
#include "plugin/kernels.h"
#include "plugin/module.h"
#include "ripples_kernels.h"

namespace semfield {
void ripples_kernels(KernelTables& tables);
}

namespace outside {

using semfield::View;

struct RipplesParams {
  int bands = 3;
};
void describe(semfield::ParamVisitor& visit, RipplesParams& p) {
  SEMFIELD_PARAM(visit, p, bands, "number of cosine bands", {1, 12});
}
void validate(const RipplesParams&, semfield::Diagnostics&) {}

template <class Real>
class Ripples final : public semfield::Encoder<Real> {
 public:
  Ripples(const RipplesParams& params, const semfield::EncoderBuild& build, const semfield::KernelTables& kernels)
      : kernels_(&kernels.get<RipplesKernels<Real>>(build.device, "encoder 'ripples'")),
        bands_(params.bands),
        in_dims_(build.in_dims) {}
  semfield::EncoderTraits traits() const noexcept override { return {in_dims_, bands_, semfield::Domain::metric}; }

 protected:
  void do_forward(const semfield::StepContext&, const semfield::Tensors<Real>&, View<const double> x,
                  View<Real> y) const override {
    kernels_->forward(x, y);
  }
  void do_backward(const semfield::StepContext&, const semfield::Tensors<Real>&, View<const double> x,
                   View<const Real> dy, View<Real> dx) const override {
    kernels_->backward(x, dy, dx);
  }

 private:
  const RipplesKernels<Real>* kernels_;
  std::int32_t bands_, in_dims_;
};

void register_into(semfield::Registry& registry) {
  semfield::ripples_kernels(registry.kernels());
  registry.add_encoder<Ripples, RipplesParams>("ripples", "Cosines of the sum of coordinates, by kernels.");
}

}  // namespace outside

SEMFIELD_PLUGIN_MODULE(ripples, "0.1", outside::register_into)
