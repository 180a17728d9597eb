// Parameters, tensors and registration of the small network.
#include "fields/tiny_mlp/tiny_mlp.h"

#include <string>
#include <vector>

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
TinyMlp<Real>::TinyMlp(const TinyMlpParams& p, const FieldBuild& build, const KernelTables& kernels)
    : FusedMlpField<Real, TinyMlpShape>(build, kernels, "field 'tiny_mlp'") {
  using enum LayerActivation;
  Mlp<Real>& net = this->net();
  const Rows h = net.chain({"hidden", {this->position()}, p.hidden_width}, p.hidden_layers);
  const Rows out = net.layer({"geometry", {h}, 1 + p.geometry_features, none});
  const Rows sigma = out.columns(0, 1), g = out.columns(1, p.geometry_features);
  const Rows c = net.chain({"color", {g, this->direction()}, p.color_width}, p.color_layers);
  this->give(sigma, net.layer({"rgb", {c}, 3, sigmoid}), p.feature == TinyFeature::hidden ? h : g);

  const auto tensors = [&](const std::string& name) {
    const MlpLayer* layer = net.find(name);
    return layer == nullptr ? TinyMlpLayer() : TinyMlpLayer{layer->weight, layer->bias};
  };
  const auto numbered = [&](const std::string& name, int count) {
    std::vector<TinyMlpLayer> layers;
    for (int i = 0; i < count; ++i) layers.push_back(tensors(name + "_" + std::to_string(i)));
    return layers;
  };
  TinyMlpShape& s = this->shape_;
  s.position_dims = build.position_dims;
  s.direction_dims = build.direction_dims;
  s.hidden_width = p.hidden_width;
  s.geometry_features = p.geometry_features;
  s.color_width = p.color_width;
  s.feature = p.feature;
  s.feature_only = build.feature_only;
  s.direction_once = build.savings.direction_once_per_ray;
  s.precision = build.precision;
  s.hidden = numbered("hidden", p.hidden_layers);
  s.geometry = tensors("geometry");
  s.color = numbered("color", build.feature_only ? 0 : p.color_layers);
  s.rgb = tensors("rgb");
}

template class TinyMlp<float>;
template class TinyMlp<double>;

SEMFIELD_PLUGIN_MODULE(tiny_mlp, "1.0", [](Registry& registry) {
  registry.add_field<TinyMlp, TinyMlpParams>(
      "tiny_mlp", "Small network behind a learned encoding: density, geometry features, view-dependent colour.");
})

}  // namespace semfield
