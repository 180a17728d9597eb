// Parameters, tensors and registration of the small network.
#include "fields/tiny_mlp/tiny_mlp.h"

#include <utility>

#include "plugin/module.h"

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
    : FusedMlpField<Real, TinyMlpShape>(build, kernels, "field 'tiny_mlp'") {
  using enum LayerActivation;
  const bool reads_hidden = params.feature == TinyFeature::hidden;
  const Rows h = this->net().chain({"hidden", {this->position()}, params.hidden_width, relu}, params.hidden_layers);
  const Rows geometry = this->layer({"geometry", {h}, 1 + params.geometry_features, none});
  const Rows g = geometry.columns(1, params.geometry_features);
  const Rows c = this->net().chain({"color", {g, this->direction()}, params.color_width, relu}, params.color_layers);
  this->give(geometry.columns(0, 1), this->layer({"rgb", {c}, 3, sigmoid}), reads_hidden ? h : g);

  TinyMlpShape s{.position_dims = build.position_dims,
                 .direction_dims = build.direction_dims,
                 .hidden_width = params.hidden_width,
                 .geometry_features = params.geometry_features,
                 .color_width = params.color_width,
                 .feature = params.feature,
                 .feature_only = build.feature_only,
                 .precision = build.precision};
  for (int i = 0; i < params.hidden_layers; ++i) s.hidden.push_back(this->tensors_of("hidden_" + std::to_string(i)));
  for (int i = 0; i < params.color_layers && !s.feature_only; ++i)
    s.color.push_back(this->tensors_of("color_" + std::to_string(i)));
  s.geometry = this->tensors_of("geometry");
  s.rgb = this->tensors_of("rgb");
  this->fuse(build, kernels, std::move(s));
}

template class TinyMlp<float>;
template class TinyMlp<double>;

SEMFIELD_PLUGIN_MODULE(tiny_mlp, "1.0", [](Registry& registry) {
  registry.add_field<TinyMlp, TinyMlpParams>(
      "tiny_mlp", "Small network behind a learned encoding: density, geometry features, view-dependent colour.");
})

}  // namespace semfield
