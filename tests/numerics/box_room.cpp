// The room, moved; configurations of small networks in it.
#include "box_room.h"

#include "testkit/analytic_scene.h"

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

namespace numerics {

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

}  // namespace numerics
}  // namespace semfield
