// Parameters, tensors and registration of the NeRF network.
#include "fields/nerf_mlp/nerf_mlp.h"

#include <string>

#include "plugin/module.h"

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
    diagnostics.error("skip_at",
                      "layer " + std::to_string(p.skip_at) + " is not one of the layers 1 to " +
                          std::to_string(p.depth - 1) + " of a trunk of depth " + std::to_string(p.depth),
                      "set skip_at below depth, or 0 for no skip connection");
  }
}

std::string layer_by_layer(const NerfMlpShape& s) {
  const std::string what = "field 'nerf_mlp' runs layer by layer here, which is slower than its fused kernels: ";
  if (fused_takes(s)) return what + "they need a GPU of compute capability 9.0";
  return what + "they take width: " + std::to_string(kNerfFusedWidth) +
         ", view_width: " + std::to_string(kNerfFusedViewWidth) + ", depth: 2 to " + std::to_string(kNerfFusedDepth) +
         ", encoded positions of up to " + std::to_string(kNerfFusedPosition) +
         ", and runtime.fold_feature_layer and direction_once_per_ray where there is a direction";
}

namespace {
// The fused kernels have all layers, whatever is asked for.
FieldBuild of_all_layers(FieldBuild build) {
  build.feature_only = false;
  return build;
}
}  // namespace

template <class Real>
NerfMlp<Real>::NerfMlp(const NerfMlpParams& p, const FieldBuild& build, const KernelTables& kernels)
    : FusedMlpField<Real, NerfMlpShape>(of_all_layers(build), kernels, "field 'nerf_mlp'") {
  using enum LayerActivation;
  Diagnostics diagnostics;
  validate(p, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::config, "field 'nerf_mlp' cannot be built");
  Mlp<Real>& net = this->net();
  const Rows direction = this->direction();
  const Rows h = net.chain({"trunk", {this->position()}, p.width}, p.depth, p.skip_at);
  const Rows sigma = net.layer({"density", {h}, 1, none});
  const Rows f = direction.empty() ? h : net.layer({"feature", {h}, p.width, none});
  const Rows v = net.layer({"view", {f, direction}, p.view_width});
  this->give(sigma, net.layer({"color", {v}, 3, sigmoid}), h);

  const auto tensors = [&](const std::string& name) {
    const MlpLayer* layer = net.find(name);
    return layer == nullptr ? NerfMlpLayer() : NerfMlpLayer{layer->weight, layer->bias};
  };
  NerfMlpShape& s = this->shape_;
  s.position_dims = build.position_dims;
  s.direction_dims = build.direction_dims;
  s.depth = p.depth;
  s.width = p.width;
  s.skip_at = p.skip_at;
  s.view_width = p.view_width;
  s.fold = build.savings.fold_feature_layer;
  s.direction_once = build.savings.direction_once_per_ray;
  s.precision = build.precision;
  for (int i = 0; i < p.depth; ++i) s.trunk.push_back(tensors("trunk_" + std::to_string(i)));
  s.density = tensors("density");
  s.feature = tensors("feature");
  s.view = tensors("view");
  s.color = tensors("color");
  if (const MlpFold* fold = net.fold()) {
    s.view.bias = fold->second_bias;
    s.folded = {fold->weight, fold->bias};
  }
}

template class NerfMlp<float>;
template class NerfMlp<double>;

SEMFIELD_PLUGIN_MODULE(nerf_mlp, "1.0", [](Registry& registry) {
  registry.add_field<NerfMlp, NerfMlpParams>(
      "nerf_mlp", "Deep network of NeRF: trunk with a skip connection, density, view-dependent colour.");
})

}  // namespace semfield
