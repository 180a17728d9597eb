// The room, moved; configurations of small networks in it.

#include "rooms.h"

#include "tests/analytic_scene.h"

namespace semfield {

namespace {

struct NoParams {};
void describe(ParamVisitor&, NoParams&) {}
void validate(const NoParams&, Diagnostics&) {}

class ShiftedRoom final : public Dataset {
 public:
  explicit ShiftedRoom(Vec3d shift_m) : shift_m_(shift_m), inner_(testkit::make_analytic_scene()) {}

  SceneInfo open(Diagnostics& diagnostics) override {
    SceneInfo info = inner_->open(diagnostics);
    for (FrameInfo& frame : info.frames) frame.world_from_camera.t = frame.world_from_camera.t + shift_m_;
    info.bounds.lo = Vec3d{-2, -1.5, -1} + shift_m_;
    info.bounds.hi = Vec3d{2, 1.5, 1} + shift_m_;
    return info;
  }
  void read(int frame, FrameBuffer& out) const override { inner_->read(frame, out); }

 private:
  Vec3d shift_m_;
  std::unique_ptr<Dataset> inner_;
};

}  // namespace

}  // namespace semfield

namespace semfield::numerics {

const char* const kHashPass =
    "rendering: {density_activation: softplus, far: background}\n"
    "semantics: {hidden_width: 16, weight: 0.01}\n"
    "passes:\n"
    "  - sampler: {type: occupancy_grid, resolution: 32, warmup_steps: 32, max_samples: 96}\n"
    "    position: {type: hash_grid, levels: 6, log2_entries: 11, finest_resolution: 64}\n"
    "    direction: {type: spherical_harmonics, degree: 2}\n"
    "    field: {type: tiny_mlp, hidden_width: 32, color_width: 32}\n"
    "train: {steps: 200, rays: 192, adam: {learning_rate: 0.02}}\n";

const char* const kFrequencyPass =
    "rendering: {density_activation: softplus, scene_scale: 0}\n"
    "semantics: {hidden_width: 16, weight: 0.04}\n"
    "passes:\n"
    "  - name: coarse\n"
    "    sampler: {type: stratified, samples: 16}\n"
    "    position: {type: frequency, frequencies: 4}\n"
    "    direction: {type: frequency, frequencies: 2}\n"
    "    field: {type: nerf_mlp, depth: 4, width: 32, skip_at: 2, view_width: 16}\n"
    "  - name: fine\n"
    "    sampler: {type: importance, samples: 16}\n"
    "    position: {type: frequency, frequencies: 4}\n"
    "    direction: {type: frequency, frequencies: 2}\n"
    "    field: {type: nerf_mlp, depth: 4, width: 32, skip_at: 2, view_width: 16}\n"
    "train: {steps: 200, rays: 128}\n";

std::unique_ptr<Dataset> shifted_room(Vec3d shift_m) { return std::make_unique<ShiftedRoom>(shift_m); }

Registry with_room(const Registry& known, Vec3d shift_m) {
  Registry registry = known;
  PluginEntry entry{.kind = PluginKind::dataset, .name = "box_room", .summary = "A room of formulas."};
  entry.new_params = [] { return std::unique_ptr<PluginParams>(std::make_unique<ParamsOf<NoParams>>()); };
  entry.dataset = [shift_m](const PluginParams&, const DatasetBuild&) { return shifted_room(shift_m); };
  registry.add(std::move(entry));
  return registry;
}

Session open_room(const std::string& yaml, Registry& registry) {
  Diagnostics diagnostics;
  RunConfig config = read_run_config(parse_config_text(yaml, "case.yaml"), registry, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::config, "");
  // What is measured does not depend on the machine; a case that wants a device names it.
  if (config.runtime.device == "auto") config.runtime.device = "cpu";
  return open_session(std::move(config), registry, {}, diagnostics);
}

std::vector<float> render_room_frame(const Registry& known, const std::string& yaml, Vec3d shift_m) {
  Registry registry = with_room(known, shift_m);
  Session session = open_room(yaml, registry);
  const FrameInfo& frame = session.scene.info.frames.at(0);
  session.pipeline->derive(0);
  return render_frame(*session.pipeline, {frame.camera, frame.world_from_camera, false}, session.limits,
                      session.plan.class_of_logit)
      .rgb;
}

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
    : registry_(with_room(registry)), session_(open_room(yaml, registry_)), trainer_(session_) {}

TrainingBox::~TrainingBox() = default;

StepLosses TrainingBox::gradients(std::int64_t step) {
  trainer_.rays().fill(step, batch_);
  pipeline().store().zero_gradients();
  return pipeline().lanes().gradients(step, batch_.view(pipeline().has_semantics()));
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
