// Fields as networks: what a pass wants of a field, as outputs of its network.
#include "plugin/mlp/field.h"

#include <array>

#include "core/error.h"

namespace semfield {

namespace {

MlpBuild network_build(const FieldBuild& build, std::string_view owner) {
  if (build.position_dims < 1) {
    throw Error(ErrorKind::config, "config.encoder.empty",
                std::string(owner) + " needs an encoded position of at least one number", "choose a position encoder");
  }
  return {build.device,
          build.precision,
          build.position_dims,
          build.direction_dims,
          build.savings.fold_feature_layer,
          build.savings.direction_once_per_ray};
}

template <class Real>
MlpIn<Real> inputs(const FieldIn<Real>& in) {
  return {in.position, in.direction, in.ray_of_sample};
}
template <class Real>
std::array<MlpOut<Real>, 3> outputs(const FieldOut<Real>& out) {
  return {{{out.sigma, {}}, {out.rgb, {}}, {out.feature, out.fused.feature}}};
}

}  // namespace

template <class Real>
MlpField<Real>::MlpField(const FieldBuild& build, const KernelTables& kernels, std::string_view owner)
    : net_(network_build(build, owner), kernels, owner), feature_only_(build.feature_only) {}

template <class Real>
void MlpField<Real>::do_forward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                                const FieldOut<Real>& out, Saved saved) const {
  SEMFIELD_CHECK(ctx.workspace != nullptr, "a field needs a workspace");
  SEMFIELD_CHECK(!feature_only_ || (out.sigma.empty() && out.rgb.empty()), "this network has its feature alone");
  net_.forward(*ctx.workspace, tensors, inputs(in), outputs(out), saved);
}

template <class Real>
void MlpField<Real>::do_backward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                                 const FieldOut<Real>& out, const FieldGrad<Real>& grad, Saved saved,
                                 View<Real> d_position) const {
  SEMFIELD_CHECK(ctx.workspace != nullptr, "a field needs a workspace");
  SEMFIELD_CHECK(grad.rgb.empty() || !out.rgb.empty(), "a colour gradient needs the colour that forward gave");
  const std::array<MlpGrad<Real>, 3> grads{{{grad.sigma, {}}, {grad.rgb, {}}, {grad.feature, grad.fused.feature}}};
  net_.backward(*ctx.workspace, tensors, inputs(in), outputs(out), grads, saved, d_position);
}

template class MlpField<float>;
template class MlpField<double>;

}  // namespace semfield
