#include "plugin/layer_weights.h"

namespace semfield {

LayerWeight rearranged_weight(std::vector<TensorSpec>& specs, int weight, std::int32_t first, std::int32_t rows,
                              Precision precision) {
  const TensorSpec whole = specs[static_cast<std::size_t>(weight)];
  LayerWeight w;
  w.weight = weight;
  w.first = first;
  w.rows = rows;
  w.cols = whole.cols;
  const std::string part = first > 0 ? "_" + std::to_string(first) : "";
  const auto add = [&](const std::string& name, std::int64_t tensor_rows, std::int32_t cols) {
    specs.push_back({whole.name + name + part, tensor_rows, cols, {}, TensorRole::rearranged});
    return static_cast<int>(specs.size()) - 1;
  };
  if (precision == Precision::bf16) {
    w.forward = add("_packed", packed_weight_words(rows, whole.cols), 1);
    w.backward = add("_t_packed", packed_weight_words(whole.cols, rows), 1);
  } else {
    w.backward = add("_t", whole.cols, rows);
  }
  return w;
}

}  // namespace semfield
