#include "studies/step_work.h"

namespace semfield {

namespace {

// The semantic head on a feature of `in` numbers: hidden layer a sample, class layer a ray or a sample.
void add_semantics(std::vector<LayerWork>& layers, int in, int width, double rays, double samples,
                   const WorkRules& rules) {
  if (rules.classes == 0) return;
  const auto hidden = static_cast<double>(width);
  layers.push_back({"semantic_hidden", samples, static_cast<double>(in), hidden, true});
  layers.push_back(
      {"semantic_class", rules.savings ? rays : samples, hidden, static_cast<double>(rules.classes), true});
}

}  // namespace

double total_flop(const std::vector<LayerWork>& layers) {
  double sum = 0;
  for (const LayerWork& layer : layers) sum += layer.flop();
  return sum;
}

std::vector<LayerWork> deep_network_work(const DeepNetwork& n, double rays, double samples, const WorkRules& rules) {
  const double w = n.width, view = n.view_width;
  std::vector<LayerWork> layers;
  for (int i = 0; i < n.depth; ++i) {
    const std::string name = "trunk_" + std::to_string(i);
    if (i == 0 || i == n.skip_at) layers.push_back({name + " of x", samples, double(n.position), w, false});
    if (i > 0) layers.push_back({name, samples, w, w, true});
  }
  layers.push_back({"density", samples, w, 1, true});
  if (rules.savings) {
    // h W_f W_v: the product of the two weights once a step, with both its gradients.
    layers.push_back({"feature x view", w, w, view, true});
  } else {
    layers.push_back({"feature", samples, w, w, true});
  }
  layers.push_back({"view", samples, w, view, true});
  layers.push_back({"view of direction", rules.savings ? rays : samples, double(n.direction), view, false});
  layers.push_back({"color", samples, view, 3, true});
  add_semantics(layers, n.width, n.semantic_width, rays, samples, rules);
  return layers;
}

std::vector<LayerWork> small_network_work(const SmallNetwork& n, double rays, double samples, const WorkRules& rules) {
  const double w = n.width, c = n.color_width;
  std::vector<LayerWork> layers{
      {"hidden_0", samples, double(n.position), w, true},  // the encoding learns
      {"geometry", samples, w, 1.0 + n.geometry_features, true},
      {"color_0", samples, double(n.geometry_features), c, true},
      {"color_0 of direction", rules.savings ? rays : samples, double(n.direction), c, false},
      {"color_1", samples, c, c, true},
      {"rgb", samples, c, 3, true},
  };
  add_semantics(layers, n.width, n.semantic_width, rays, samples, rules);
  return layers;
}

}  // namespace semfield
