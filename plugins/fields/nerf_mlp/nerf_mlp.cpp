// Parameters, tensors and registration of the NeRF network.
#include "fields/nerf_mlp/nerf_mlp.h"

#include <utility>

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
    diagnostics.error("config.value.range", "skip_at",
                      "layer " + std::to_string(p.skip_at) + " is not one of the layers 1 to " +
                          std::to_string(p.depth - 1) + " of a trunk of depth " + std::to_string(p.depth),
                      "set skip_at below depth, or 0 for no skip connection");
  }
}

std::string layer_by_layer(const NerfMlpShape& s) {
  const std::string what = "field 'nerf_mlp' runs layer by layer here, which is slower than its fused kernels: ";
  if (s.feature_only) return what + "they do not take a semantic branch";
  if (fused_takes(s)) return what + "they need a GPU of compute capability 9.0";
  return what + "they take width: " + std::to_string(kNerfFusedWidth) +
         ", view_width: " + std::to_string(kNerfFusedViewWidth) + ", depth: 2 to " + std::to_string(kNerfFusedDepth) +
         ", encoded positions of up to " + std::to_string(kNerfFusedPosition) +
         ", and runtime.fold_feature_layer and direction_once_per_ray where there is a direction";
}

template <class Real>
NerfMlp<Real>::NerfMlp(const NerfMlpParams& params, const FieldBuild& build, const KernelTables& kernels)
    : FusedMlpField<Real, NerfMlpShape>(build, kernels, "field 'nerf_mlp'") {
  Diagnostics diagnostics;
  validate(params, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::config, "field 'nerf_mlp' cannot be built");
  using enum LayerActivation;
  const Rows h = this->net().chain({"trunk", {this->position()}, params.width, relu}, params.depth, params.skip_at);
  const Rows sigma = this->layer({"density", {h}, 1, none});
  const bool has_direction = !this->direction().empty();
  const Rows f = has_direction ? this->layer({"feature", {h}, params.width, none}) : h;
  const Rows v = this->layer({"view", {f, this->direction()}, params.view_width, relu});
  this->give(sigma, this->layer({"color", {v}, 3, sigmoid}), h);

  NerfMlpShape s{.position_dims = build.position_dims,
                 .direction_dims = build.direction_dims,
                 .depth = params.depth,
                 .width = params.width,
                 .skip_at = params.skip_at,
                 .view_width = params.view_width,
                 .feature_only = build.feature_only,
                 .fold = build.savings.fold_feature_layer,
                 .direction_once = build.savings.direction_once_per_ray,
                 .precision = build.precision};
  for (int i = 0; i < params.depth; ++i) s.trunk.push_back(this->tensors_of("trunk_" + std::to_string(i)));
  s.density = this->tensors_of("density");
  s.view = this->tensors_of("view");
  s.color = this->tensors_of("color");
  if (const MlpFold* const fold = this->net().fold(); fold != nullptr) {
    s.view.bias = fold->second_bias;
    s.folded = {fold->weight, fold->bias};
  }
  this->fuse(build, kernels, std::move(s));
}

template class NerfMlp<float>;
template class NerfMlp<double>;

SEMFIELD_PLUGIN_MODULE(nerf_mlp, "1.0", [](Registry& registry) {
  registry.add_field<NerfMlp, NerfMlpParams>(
      "nerf_mlp", "Deep network of NeRF: trunk with a skip connection, density, view-dependent colour.");
})

}  // namespace semfield
