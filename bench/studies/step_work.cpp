#include "studies/step_work.h"

#include "model/param_store.h"

namespace semfield {

double total_flop(const std::vector<LayerWork>& layers) {
  double sum = 0;
  for (const LayerWork& layer : layers) sum += layer.flop();
  return sum;
}

std::vector<LayerWork> field_work(const Field<float>& field, std::int64_t rays, std::int64_t samples,
                                  bool position_learns) {
  std::vector<LayerWork> work;
  for (const LayerShape& layer : field.layers()) {
    const bool gradient =
        layer.input == LayerInput::activation || (layer.input == LayerInput::position && position_learns);
    work.push_back({layer.name, static_cast<double>(layer.rows_of(samples, rays)), static_cast<double>(layer.in),
                    static_cast<double>(layer.out), gradient, layer.per == LayerRows::step});
  }
  return work;
}

std::vector<LayerWork> pass_work(const PassParts<float>& parts, std::int64_t rays, std::int64_t samples,
                                 bool deferred_class_layer) {
  std::vector<LayerWork> work =
      field_work(*parts.field, rays, samples, declared_bytes<float>(*parts.position, 1, true).learns);
  if (parts.head == nullptr) return work;
  double feature = parts.field->traits().feature_dims;
  if (parts.branch != nullptr) {
    for (LayerWork& layer : field_work(*parts.branch->field, rays, samples, false)) work.push_back(std::move(layer));
    feature = parts.branch->field->traits().feature_dims;
  }
  const double hidden = parts.head->hidden_width(), classes = parts.head->width();
  work.push_back({"semantic hidden", static_cast<double>(samples), feature, hidden});
  work.push_back({"semantic class", static_cast<double>(deferred_class_layer ? rays : samples), hidden, classes});
  return work;
}

}  // namespace semfield
