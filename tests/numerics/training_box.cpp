#include "training_box.h"

#include "box_room.h"

namespace semfield::numerics {

std::string small_config(const std::string& more) {
  const std::string network =
      "    position: {type: frequency, frequencies: 3}\n"
      "    direction: {type: frequency, frequencies: 2}\n"
      "    field: {type: nerf_mlp, depth: 4, width: 24, skip_at: 2, view_width: 12}\n";
  return "passes:\n  - name: coarse\n    sampler: {type: stratified, samples: 8}\n" + network +
         "  - name: fine\n    sampler: {type: importance, samples: 8}\n" + network + more +
         (more.find("scene:") == std::string::npos ? "scene: {type: box_room}\n" : "") +
         (more.find("train:") == std::string::npos ? "train: {steps: 50, rays: 64}\n" : "");
}

std::string grid_config(const std::string& more) {
  return "scene: {type: box_room}\n"
         "rendering: {density_activation: softplus, far: background}\n"
         "semantics: {hidden_width: 16, weight: 0.1}\n"
         "passes:\n"
         "  - name: main\n"
         "    sampler: {type: occupancy_grid, resolution: 32, warmup_steps: 4, max_samples: 32, keep_last: true}\n"
         "    position: {type: hash_grid, levels: 4, log2_entries: 10, finest_resolution: 48}\n"
         "    direction: {type: spherical_harmonics, degree: 2}\n"
         "    field: {type: tiny_mlp, hidden_width: 32, color_width: 32}\n"
         "train: {steps: 50, rays: 64}\n" +
         more;
}

TrainingBox::TrainingBox(const Registry& registry, const std::string& yaml)
    : registry_(with_room(registry)),
      session_(open_room(yaml, registry_)),
      rays_(session_.make_ray_source()),
      trainer_(std::make_unique<Trainer>(*session_.pipeline, *rays_, session_.config.adam, session_.config.schedule)) {}

TrainingBox::~TrainingBox() = default;

StepLosses TrainingBox::gradients(std::int64_t step) {
  rays_->fill(step, batch_);
  pipeline().store().zero_gradients();
  return pipeline().gradients(step, batch_.view(pipeline().has_semantics()));
}

std::vector<TrainingBox::Kept> TrainingBox::state() {
  std::vector<Kept> out;
  for (const Tensor<float>& t : pipeline().store().all()) {
    Kept kept{t.name, {t.value.data(), t.value.data() + t.value.size()}, {}};
    for (const AlignedBuffer<float>* moments : {&t.moment1, &t.moment2})
      kept.moments.insert(kept.moments.end(), moments->data(), moments->data() + moments->size());
    out.push_back(std::move(kept));
  }
  return out;
}

}  // namespace semfield::numerics
