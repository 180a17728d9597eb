// Parameters, tensors and registration of the small network.
#include "fields/tiny_mlp/tiny_mlp.h"

#include <cmath>
#include <string>

#include "plugin/module.h"
#include "plugin/registry.h"

namespace semfield {

void describe(ParamVisitor& visit, TinyMlpParams& p) {
  SEMFIELD_PARAM(visit, p, hidden_width, "width of the density network's hidden layers [Mueller22 Sec. 5.4]",
                 {1, 4096});
  SEMFIELD_PARAM(visit, p, hidden_layers, "hidden layers of the density network", {1, 8});
  SEMFIELD_PARAM(visit, p, geometry_features, "numbers that the density network hands to the colour network", {1, 255});
  SEMFIELD_PARAM(visit, p, color_width, "width of the colour network's hidden layers", {1, 4096});
  SEMFIELD_PARAM(visit, p, color_layers, "hidden layers of the colour network", {1, 8});
  SEMFIELD_PARAM(visit, p, feature,
                 "what the semantic head reads: the last hidden activations or the geometry features");
}

// Every combination within the ranges is a network.
void validate(const TinyMlpParams&, Diagnostics&) {}

namespace {

/// Learned weight and bias, uniform within 1/sqrt(fan_in).
TinyMlpLayer learned(std::vector<TensorSpec>& specs, const std::string& name, std::int32_t in, std::int32_t out) {
  const Init init = Init::uniform(1.0 / std::sqrt(static_cast<double>(in)));
  const auto next = static_cast<int>(specs.size());
  specs.push_back({name + "/weight", in, out, init, TensorRole::dense});
  specs.push_back({name + "/bias", 1, out, init, TensorRole::dense});
  return {next, next + 1, {}};
}

}  // namespace

std::string layer_by_layer(const TinyMlpShape& s) {
  const bool fits = fused_takes(s) || fused_takes_feature(s);
  std::string what = "field 'tiny_mlp' runs layer by layer here, which is slower than its fused kernels: ";
  if (fits) return what + "this GPU has too little shared memory for them";
  if (s.feature_only) {
    return what + "as a semantic branch they take feature: hidden, up to " + std::to_string(kTinyFusedFeatureLayers) +
           " hidden layers, and widths and encoded positions of up to " + std::to_string(kTinyFusedFeatureWidth);
  }
  return what + "they take one hidden layer, two colour layers, widths and encoded positions of up to " +
         std::to_string(kTinyFusedWidth) + ", encoded directions of up to " + std::to_string(kTinyFusedDirection) +
         " and up to " + std::to_string(kTinyFusedGeometry) + " geometry features";
}

template <class Real>
TinyMlp<Real>::TinyMlp(const TinyMlpParams& params, const FieldBuild& build, const KernelTables& kernels)
    : kernels_(&kernels.get<TinyMlpKernels<Real>>(build.device, "field 'tiny_mlp'", build.precision)) {
  Diagnostics diagnostics;
  validate(params, diagnostics);
  if (build.position_dims < 1)
    diagnostics.error("config.encoder.empty", "", "field 'tiny_mlp' needs an encoded position of at least one number",
                      {});
  diagnostics.throw_if_errors(ErrorKind::config, "field 'tiny_mlp' cannot be built");
  TinyMlpShape& s = shape_;
  s.position_dims = build.position_dims;
  s.direction_dims = build.direction_dims;
  s.hidden_width = params.hidden_width;
  s.geometry_features = params.geometry_features;
  s.color_width = params.color_width;
  s.feature = params.feature;
  s.direction_once = build.savings.direction_once_per_ray;
  s.precision = build.precision;

  std::int32_t in = s.position_dims;
  for (int i = 0; i < params.hidden_layers; ++i) {
    s.hidden.push_back(learned(specs_, "hidden_" + std::to_string(i), in, s.hidden_width));
    in = s.hidden_width;
  }
  s.feature_only = build.feature_only;
  if (!s.feature_only || s.feature == TinyFeature::geometry)
    s.geometry = learned(specs_, "geometry", s.hidden_width, 1 + s.geometry_features);
  in = s.geometry_features + s.direction_dims;
  for (int i = 0; i < params.color_layers && !s.feature_only; ++i) {
    s.color.push_back(learned(specs_, "color_" + std::to_string(i), in, s.color_width));
    in = s.color_width;
  }
  if (!s.feature_only) s.rgb = learned(specs_, "rgb", s.color_width, 3);
  if (build.device != Device::cpu) return;
  const auto rearrange = [&](TinyMlpLayer& layer, std::int32_t rows) {
    if (layer.weight >= 0) layer.rows = rearranged_weight(specs_, layer.weight, 0, rows, s.precision);
  };
  for (std::size_t i = 0; i < s.hidden.size(); ++i) rearrange(s.hidden[i], i == 0 ? s.position_dims : s.hidden_width);
  rearrange(s.geometry, s.hidden_width);
  for (std::size_t i = 0; i < s.color.size(); ++i) rearrange(s.color[i], i == 0 ? s.geometry_features : s.color_width);
  rearrange(s.rgb, s.color_width);
}

template <class Real>
void TinyMlp<Real>::declare(ParamDeclarer& declarer) const {
  for (const TensorSpec& spec : specs_) declarer.tensor(spec);
}

template <class Real>
std::size_t TinyMlp<Real>::saved_bytes(std::int64_t samples, std::int64_t) const noexcept {
  return kernels_->saved_bytes(shape_, samples);
}

template <class Real>
std::size_t TinyMlp<Real>::scratch_bytes(std::int64_t samples, std::int64_t rays) const noexcept {
  return kernels_->scratch_bytes == nullptr ? 0 : kernels_->scratch_bytes(shape_, samples, rays);
}

template <class Real>
std::vector<LayerShape> TinyMlp<Real>::layers() const {
  const TinyMlpShape& s = shape_;
  std::vector<LayerShape> list;
  for (std::size_t i = 0; i < s.hidden.size(); ++i) {
    list.push_back({"hidden_" + std::to_string(i), i == 0 ? s.position_dims : s.hidden_width, s.hidden_width,
                    LayerRows::sample, i == 0 ? LayerInput::position : LayerInput::activation});
  }
  if (s.has_geometry()) list.push_back({"geometry", s.hidden_width, 1 + s.geometry_features});
  for (std::size_t i = 0; i < s.color.size(); ++i) {
    const std::string name = "color_" + std::to_string(i);
    list.push_back({name, i == 0 ? s.geometry_features : s.color_width, s.color_width});
    if (i > 0 || !s.has_direction()) continue;
    list.push_back({name, s.direction_dims, s.color_width, s.direction_once ? LayerRows::ray : LayerRows::sample,
                    LayerInput::direction});
  }
  if (!s.feature_only) list.push_back({"rgb", s.color_width, 3});
  return list;
}

template <class Real>
void TinyMlp<Real>::derive(const StepContext&, const Tensors<Real>& tensors) const {
  kernels_->derive(shape_, tensors);
}

template <class Real>
void TinyMlp<Real>::do_forward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                               const FieldOut<Real>& out, Saved saved) const {
  kernels_->forward(shape_, ctx, tensors, in, out, saved);
}

template <class Real>
void TinyMlp<Real>::do_backward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                                const FieldOut<Real>& out, const FieldGrad<Real>& grad, Saved saved,
                                View<Real> d_position) const {
  kernels_->backward(shape_, ctx, tensors, in, out, grad, saved, d_position);
}

template class TinyMlp<float>;
template class TinyMlp<double>;

namespace {
void register_into(Registry& registry) {
  tiny_mlp_kernels(registry.kernels());
  registry.add_field<TinyMlp, TinyMlpParams>(
      "tiny_mlp", "Small network behind a learned encoding: density, geometry features, view-dependent colour.");
}
}  // namespace

SEMFIELD_PLUGIN_MODULE(tiny_mlp, "1.0", register_into)

}  // namespace semfield
