// Multiply-adds of a training step, from what its networks say of themselves.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "model/pass.h"

namespace semfield {

/// A matrix product of a step: `rows` rows through a weight [in, out]. Backward costs as much again for the weight's
/// gradient, and once more for the input's where that is wanted.
struct LayerWork {
  std::string layer;
  double rows = 0;
  double in = 0, out = 0;
  bool input_gradient = true;
  bool once_a_step = false;
  /// Floating-point operations of forward and backward; a multiply-add counts 2.
  double flop() const { return 2 * rows * in * out * (input_gradient ? 3 : 2); }
};
double total_flop(const std::vector<LayerWork>& layers);

/// The products of a field; of an encoded position that is learned a gradient is wanted.
std::vector<LayerWork> field_work(const Field<float>& field, std::int64_t rays, std::int64_t samples,
                                  bool position_learns);

/// The products of a pass in which every ray has a label: field, semantic branch as if it kept every sample, and head.
/// An encoding's own arithmetic is not counted.
std::vector<LayerWork> pass_work(const PassParts<float>& parts, std::int64_t rays, std::int64_t samples,
                                 bool deferred_class_layer);

}  // namespace semfield
