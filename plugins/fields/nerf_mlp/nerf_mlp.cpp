// Parameters, tensors and registration of the NeRF network.
#include "fields/nerf_mlp/nerf_mlp.h"

#include <cmath>
#include <string>

#include "plugin/module.h"
#include "plugin/registry.h"

namespace semfield {

void describe(ParamVisitor& visit, NerfMlpParams& p) {
  SEMFIELD_PARAM(visit, p, depth, "number of trunk layers [Mildenhall20 Fig. 7]", {1, 32});
  SEMFIELD_PARAM(visit, p, width, "width of the trunk and of the feature layer", {1, 4096});
  SEMFIELD_PARAM(visit, p, skip_at, "trunk layer before which the encoded position is concatenated again, 0: none",
                 {0, 31});
  SEMFIELD_PARAM(visit, p, view_width, "width of the layer between feature, direction and colour", {1, 4096});
}

void validate(const NerfMlpParams& p, Diagnostics& diagnostics) {
  if (p.skip_at >= p.depth) {
    diagnostics.error("config.value.range", "skip_at",
                      "layer " + std::to_string(p.skip_at) + " is not one of the layers 1 to " +
                          std::to_string(p.depth - 1) + " of a trunk of depth " + std::to_string(p.depth),
                      "set skip_at below depth, or 0 for no skip connection");
  }
}

namespace {

/// Collects tensor specs in order of declaration.
class LayerList {
 public:
  explicit LayerList(std::vector<TensorSpec>& specs) : specs_(specs) {}

  int tensor(const std::string& name, std::int64_t rows, std::int32_t cols, Init init, TensorRole role) {
    specs_.push_back({name, rows, cols, init, role});
    return static_cast<int>(specs_.size()) - 1;
  }

  /// Learned weight and bias, uniform within 1/sqrt(fan_in).
  NerfMlpLayer learned(const std::string& name, std::int32_t in, std::int32_t out) {
    const Init init = Init::uniform(1.0 / std::sqrt(static_cast<double>(in)));
    NerfMlpLayer layer;
    layer.weight = tensor(name + "/weight", in, out, init, TensorRole::dense);
    layer.bias = tensor(name + "/bias", 1, out, init, TensorRole::dense);
    return layer;
  }

  /// What a CPU reads of rows [first, first + rows) of the layer's weight.
  LayerWeight rearranged(const NerfMlpLayer& layer, std::int32_t first, std::int32_t rows, Precision precision) {
    return rearranged_weight(specs_, layer.weight, first, rows, precision);
  }

 private:
  std::vector<TensorSpec>& specs_;
};

}  // namespace

std::string layer_by_layer(const NerfMlpShape& s) {
  const std::string what = "field 'nerf_mlp' runs layer by layer here, which is slower than its fused kernels: ";
  if (fused_takes(s)) return what + "they need a GPU of compute capability 9.0";
  return what + "they take width: " + std::to_string(kNerfFusedWidth) +
         ", view_width: " + std::to_string(kNerfFusedViewWidth) + ", depth: 2 to " + std::to_string(kNerfFusedDepth) +
         ", encoded positions of up to " + std::to_string(kNerfFusedPosition) +
         ", and runtime.fold_feature_layer and direction_once_per_ray where there is a direction";
}

template <class Real>
NerfMlp<Real>::NerfMlp(const NerfMlpParams& params, const FieldBuild& build, const KernelTables& kernels)
    : kernels_(&kernels.get<NerfMlpKernels<Real>>(build.device, "field 'nerf_mlp'", build.precision)) {
  Diagnostics diagnostics;
  validate(params, diagnostics);
  if (build.position_dims < 1)
    diagnostics.error("config.encoder.empty", "", "field 'nerf_mlp' needs an encoded position of at least one number",
                      {});
  diagnostics.throw_if_errors(ErrorKind::config, "field 'nerf_mlp' cannot be built");
  NerfMlpShape& s = shape_;
  s.position_dims = build.position_dims;
  s.direction_dims = build.direction_dims;
  s.depth = params.depth;
  s.width = params.width;
  s.skip_at = params.skip_at;
  s.view_width = params.view_width;
  s.fold = build.savings.fold_feature_layer;
  s.direction_once = build.savings.direction_once_per_ray;
  s.precision = build.precision;

  LayerList list(specs_);
  for (std::int32_t i = 0; i < s.depth; ++i) {
    const std::int32_t in = i == 0 ? s.position_dims : i == s.skip_at ? s.position_dims + s.width : s.width;
    s.trunk.push_back(list.learned("trunk_" + std::to_string(i), in, s.width));
  }
  s.density = list.learned("density", s.width, 1);
  if (s.has_direction()) s.feature = list.learned("feature", s.width, s.width);
  s.view = list.learned("view", s.width + s.direction_dims, s.view_width);
  s.color = list.learned("color", s.view_width, 3);

  if (s.folds()) {
    s.folded.weight = list.tensor("folded/weight", s.width, s.view_width, {}, TensorRole::derived);
    s.folded.bias = list.tensor("folded/bias", 1, s.view_width, {}, TensorRole::derived);
  }
  if (build.device != Device::cpu) return;
  for (std::int32_t i = 0; i < s.depth; ++i) {
    NerfMlpLayer& layer = s.trunk[static_cast<std::size_t>(i)];
    const std::int32_t of_position = i == 0 || i == s.skip_at ? s.position_dims : 0;
    if (of_position > 0) layer.position = list.rearranged(layer, 0, of_position, s.precision);
    if (i > 0) layer.activation = list.rearranged(layer, of_position, s.width, s.precision);
  }
  for (NerfMlpLayer* layer : {&s.density, &s.feature, &s.folded}) {
    if (layer == &s.feature ? s.has_feature_activation() : layer->weight >= 0)
      layer->activation = list.rearranged(*layer, 0, s.width, s.precision);
  }
  // Of a folded view layer derive_backward alone reads something, in the arithmetic of derive.
  s.view.activation = list.rearranged(s.view, 0, s.width, s.folds() ? Precision::fp32 : s.precision);
  s.color.activation = list.rearranged(s.color, 0, s.view_width, s.precision);
}

template <class Real>
void NerfMlp<Real>::declare(ParamDeclarer& declarer) const {
  for (const TensorSpec& spec : specs_) declarer.tensor(spec);
}

template <class Real>
std::size_t NerfMlp<Real>::saved_bytes(std::int64_t samples, std::int64_t) const noexcept {
  return kernels_->saved_bytes(shape_, samples);
}

template <class Real>
std::size_t NerfMlp<Real>::scratch_bytes(std::int64_t samples, std::int64_t rays) const noexcept {
  return kernels_->scratch_bytes == nullptr ? 0 : kernels_->scratch_bytes(shape_, samples, rays);
}

template <class Real>
std::vector<LayerShape> NerfMlp<Real>::layers() const {
  const NerfMlpShape& s = shape_;
  std::vector<LayerShape> list;
  for (std::int32_t i = 0; i < s.depth; ++i) {
    const std::string name = "trunk_" + std::to_string(i);
    if (i == 0 || i == s.skip_at)
      list.push_back({name, s.position_dims, s.width, LayerRows::sample, LayerInput::position});
    if (i > 0) list.push_back({name, s.width, s.width});
  }
  list.push_back({"density", s.width, 1});
  // The product of the two weights, and of a bias with the second.
  if (s.folds())
    list.push_back({"folded", s.width, s.view_width, LayerRows::step, LayerInput::activation, s.width + 1});
  if (s.has_feature_activation()) list.push_back({"feature", s.width, s.width});
  list.push_back({"view", s.width, s.view_width});
  if (s.has_direction()) {
    list.push_back({"view", s.direction_dims, s.view_width, s.direction_once ? LayerRows::ray : LayerRows::sample,
                    LayerInput::direction});
  }
  list.push_back({"color", s.view_width, 3});
  return list;
}

template <class Real>
void NerfMlp<Real>::derive(const StepContext&, const Tensors<Real>& tensors) const {
  kernels_->derive(shape_, tensors);
}

template <class Real>
void NerfMlp<Real>::derive_backward(const StepContext&, const Tensors<Real>& tensors) const {
  kernels_->derive_backward(shape_, tensors);
}

template <class Real>
void NerfMlp<Real>::do_forward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                               const FieldOut<Real>& out, Saved saved) const {
  kernels_->forward(shape_, ctx, tensors, in, out, saved);
}

template <class Real>
void NerfMlp<Real>::do_backward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                                const FieldOut<Real>& out, const FieldGrad<Real>& grad, Saved saved,
                                View<Real> d_position) const {
  kernels_->backward(shape_, ctx, tensors, in, out, grad, saved, d_position);
}

template class NerfMlp<float>;
template class NerfMlp<double>;

namespace {
void register_into(Registry& registry) {
  nerf_mlp_kernels(registry.kernels());
  registry.add_field<NerfMlp, NerfMlpParams>(
      "nerf_mlp", "Deep network of NeRF: trunk with a skip connection, density, view-dependent colour.");
}
}  // namespace

SEMFIELD_PLUGIN_MODULE(nerf_mlp, "1.0", register_into)

}  // namespace semfield
