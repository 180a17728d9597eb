// Multiply-adds of a training step, counted from the shapes of its networks.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace semfield {

/// A matrix product of a step: `rows` rows through a weight [in, out]. Backward costs as much again for the weight's
/// gradient, and once more for the input's where that is wanted.
struct LayerWork {
  std::string layer;
  double rows = 0;
  double in = 0, out = 0;
  bool input_gradient = true;
  /// Floating-point operations of forward and backward; a multiply-add counts 2.
  double flop() const { return 2 * rows * in * out * (input_gradient ? 3 : 2); }
};
double total_flop(const std::vector<LayerWork>& layers);

/// How a step is counted.
struct WorkRules {
  int classes = 0;      ///< C; 0: no semantics
  bool savings = true;  ///< with the exact savings (feature layer folded, direction term and class layer once a ray)
};

/// The deep network of NeRF with a skip connection [Mildenhall20, Zhi21]. Positions are not learned.
struct DeepNetwork {
  int position = 63, direction = 27;
  int depth = 8, width = 256, skip_at = 5;
  int view_width = 128, semantic_width = 128;
};
/// One pass of `rays` rays and `samples` samples in all. The product of the two folded layers, once a step, is counted.
std::vector<LayerWork> deep_network_work(const DeepNetwork& network, double rays, double samples,
                                         const WorkRules& rules);

/// The small network behind a learned encoding [Mueller22]: one hidden layer, two colour layers. The encoding's own
/// arithmetic is not counted.
struct SmallNetwork {
  int position = 32, direction = 16;
  int width = 64, geometry_features = 15, color_width = 64, semantic_width = 64;
};
std::vector<LayerWork> small_network_work(const SmallNetwork& network, double rays, double samples,
                                          const WorkRules& rules);

}  // namespace semfield
