// A channel of any width by one hidden layer: feature maps of another model, learned so that all views agree.
#include "plugin/head.h"
#include "plugin/module.h"

namespace semfield {

struct FeatureMapParams {
  int hidden_width = 64;
};

void describe(ParamVisitor& visit, FeatureMapParams& p) {
  SEMFIELD_PARAM(visit, p, hidden_width, "width of the layer between the branch's feature and the channel", {1, 4096});
}

/// h = relu(feature W + b); row = sum_k w_k h_k V + opacity c.
template <class Real>
class FeatureMap final : public OneLayerHead<Real> {
 public:
  FeatureMap(const FeatureMapParams& p, const HeadBuild& build, const KernelTables& kernels)
      : OneLayerHead<Real>(
            {.feature = build.feature_dims, .hidden = p.hidden_width, .width = build.width, .output = "output"},
            kernels.get<HeadKernels<Real>>(build.device, "head 'feature_map'")) {}
};

SEMFIELD_PLUGIN_MODULE(feature_map, "1.0", [](Registry& registry) {
  registry.add_head<FeatureMap, FeatureMapParams>(
      "feature_map", "A channel of any width by one hidden layer, such as feature maps of another model.");
})

}  // namespace semfield
