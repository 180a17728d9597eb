#include "tests/session/train_testing.h"

#include "compute/parallel.h"
#include "core/checksum.h"
#include "eval/report/report.h"
#include "plugin/loader.h"
#include "scene/loading/packed_scene.h"
#include "tests/analytic_scene.h"
#include "train/run_folder.h"

namespace semfield {

struct AnalyticRoomParams {
  int frames = 12;
  int width_px = 48;
  int height_px = 36;
  bool with_labels = true;
  bool with_classes = true;  // a class table
  bool with_depth = true;
  bool with_albedo = false;  // a channel `albedo` [H / 2, W, 3]: the colours of every other row
  int absent_class = -1;     // of the table, but void in every frame
  int masked = 0;            // of 4 checks of a board, beginning with another one in each frame
  bool tracked = false;      // as poses of a phone
  int behind = -1;           // what lies behind the mask in place of the room: grey, class and depth made of it
};
void describe(ParamVisitor& visit, AnalyticRoomParams& p) {
  SEMFIELD_PARAM(visit, p, frames, "frames", {1, 1000});
  SEMFIELD_PARAM(visit, p, width_px, "width", {1, 1000});
  SEMFIELD_PARAM(visit, p, height_px, "height", {1, 1000});
  SEMFIELD_PARAM(visit, p, with_labels, "with labels");
  SEMFIELD_PARAM(visit, p, with_classes, "with a class table");
  SEMFIELD_PARAM(visit, p, with_depth, "with depth");
  SEMFIELD_PARAM(visit, p, with_albedo, "with the channel albedo");
  SEMFIELD_PARAM(visit, p, absent_class, "a class without pixels", {-1, 1000});
  SEMFIELD_PARAM(visit, p, tracked, "poses of a phone");
  SEMFIELD_PARAM(visit, p, masked, "of 4", {0, 4});
  SEMFIELD_PARAM(visit, p, behind, "grey behind the mask", {-1, 255});
}
void validate(const AnalyticRoomParams&, Diagnostics&) {}

class AnalyticRoom final : public Dataset {
 public:
  AnalyticRoom(const AnalyticRoomParams& p, const DatasetBuild&) : room_(p) {
    inner_ = testkit::make_analytic_scene({p.frames, p.width_px, p.height_px, p.with_depth, p.with_labels});
  }
  SceneInfo open(Diagnostics& diagnostics) override {
    SceneInfo info = inner_->open(diagnostics);
    info.tracked = room_.tracked;
    if (!room_.with_classes) info.classes = ClassTable();
    if (!room_.with_depth) {  // as photographs: nothing states the extent
      info.bounds = Box();
      info.near_hint_m = info.far_hint_m = 0;
    }
    for (FrameInfo& frame : info.frames)
      if (room_.with_albedo) frame.channels = {{"albedo", frame.camera.height_px / 2, frame.camera.width_px, 3}};
    return info;
  }
  void read(int frame, FrameBuffer& out) const override {
    const std::vector<std::string> wanted = out.wanted;
    inner_->read(frame, out);
    for (std::int16_t& label : out.label) {
      if (label == room_.absent_class) label = kVoid;
    }
    mask(frame, out);
    for (const std::string& name : wanted) {
      FrameChannel channel{name, out.height_px / 2, out.width_px, 3, {}};
      const std::size_t row = 3 * static_cast<std::size_t>(out.width_px);
      for (std::size_t y = 0; y < static_cast<std::size_t>(channel.height); ++y)
        for (std::size_t i = 0; i < row; ++i)
          channel.values.push_back(static_cast<float>(out.rgb[2 * y * row + i]) / 255.0F);
      out.channels.push_back(std::move(channel));
    }
  }

 private:
  void mask(int frame, FrameBuffer& out) const {
    for (int i = 0; i < out.width_px * out.height_px && room_.masked > 0; ++i) {
      const bool used = (frame + i % out.width_px / 5 + i / out.width_px / 4) % 4 >= room_.masked;
      out.used.push_back(used ? 1 : 0);
      if (used || room_.behind < 0) continue;
      const auto at = static_cast<std::size_t>(i);
      for (std::size_t c = 0; c < 3; ++c) out.rgb[3 * at + c] = static_cast<std::uint8_t>(room_.behind);
      if (!out.label.empty()) out.label[at] = static_cast<std::int16_t>(room_.behind % 3);
      if (!out.depth_m.empty()) out.depth_m[at] = 0.01F * static_cast<float>(room_.behind);
    }
  }

  AnalyticRoomParams room_;
  std::unique_ptr<Dataset> inner_;
};

struct AlbedoParams : LossRule {
  AlbedoParams() { weight = 1; }
};
void describe(ParamVisitor&, AlbedoParams&) {}

/// The squared error of the colour against the channel albedo.
class Albedo final : public LossOf<Albedo, AlbedoParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override { return {.targets = {"albedo"}, .moves = {channel::color}}; }
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const {
    const View<const float> albedo = targets.more["albedo"];
    double sum = 0;
    for (std::int64_t r = 0; r < albedo.rows; ++r) {
      for (std::int32_t c = 0; c < 3; ++c) {
        const double error = static_cast<double>(values.color(r, c)) - static_cast<double>(albedo(r, c));
        sum += error * error;
        gradients.color(r, c) += static_cast<Real>(2 * scale * error);
      }
    }
    return sum;
  }
};

namespace testing_train {

Registry make_channel_registry() {
  Registry registry = make_registry();
  registry.add_loss<Albedo>("albedo", "the squared error against the channel albedo", "a sum per ray");
  return registry;
}

Registry make_registry() {
  Registry registry;
  register_linked_plugins(registry);
  registry.add_dataset<AnalyticRoom, AnalyticRoomParams>("analytic_room", "a room of formulas");
  return registry;
}

Registry& channel_plugins() {
  static Registry all = make_channel_registry();
  return all;
}

Registry& all_plugins() {
  static Registry all = make_registry();
  return all;
}

std::string hash_config(const std::string& more) {
  return "scene: {type: analytic_room}\n"
         "rendering: {density_activation: softplus, far: background}\n"
         "semantics: {hidden_width: 32, weight: 0.002}\n"
         "passes:\n"
         "  - name: main\n"
         "    sampler: {type: occupancy_grid, resolution: 32, warmup_steps: 32, max_samples: 96, keep_last: true}\n"
         "    position: {type: hash_grid, levels: 6, log2_entries: 11, finest_resolution: 64}\n"
         "    direction: {type: spherical_harmonics, degree: 2}\n"
         "    field: {type: tiny_mlp, hidden_width: 32, color_width: 32}\n"
         "train: {steps: 200, rays: 192, adam: {learning_rate: 0.02}}\n" +
         more;
}

std::string two_pass_config(const std::string& more) {
  return "scene: {type: analytic_room}\n"
         "semantics: {hidden_width: 16, weight: 0.3}\n"
         "passes:\n"
         "  - name: coarse\n"
         "    sampler: {type: stratified, samples: 8}\n"
         "    position: {type: frequency, frequencies: 3}\n"
         "    direction: {type: frequency, frequencies: 2}\n"
         "    field: {type: nerf_mlp, depth: 4, width: 24, skip_at: 2, view_width: 12}\n"
         "  - name: fine\n"
         "    sampler: {type: importance, samples: 8}\n"
         "    position: {type: frequency, frequencies: 3}\n"
         "    direction: {type: frequency, frequencies: 2}\n"
         "    field: {type: nerf_mlp, depth: 4, width: 24, skip_at: 2, view_width: 12}\n"
         "train: {steps: 50, rays: 64}\n" +
         more;
}

Session open_text(const std::string& yaml, Registry& registry, const SessionOptions& options,
                  Diagnostics& diagnostics) {
  return open_session(run_config_of(parse_config_text(yaml, "test.yaml"), registry), registry, options, diagnostics);
}
Session open_text(const std::string& yaml, Registry& registry, const std::vector<std::string>& keep, Ranks* ranks) {
  Diagnostics diagnostics;
  return open_text(yaml, registry, SessionOptions{.keep = keep, .ranks = ranks}, diagnostics);
}
Session open_text(const std::string& yaml, const std::vector<std::string>& keep) {
  return open_text(yaml, all_plugins(), keep);
}

RenderedFrame render_frame_of(const Session& session, int frame, const FrameOptions& options) {
  const FrameInfo& info = session.scene.info.frames.at(static_cast<std::size_t>(frame));
  return render_frame(*session.pipeline, {info.camera, info.world_from_camera, session.plan.undistortion},
                      session.limits, session.plan.class_of_logit, {}, options);
}

const LeftOut& left_out_row(const Session& session, const std::string& component) {
  for (const LeftOut& row : session.plan.left_out)
    if (row.component == component) return row;
  throw Error(ErrorKind::failure, "test.error.made", component + " is not left out");
}

std::string replaced(std::string yaml, std::string_view from, const std::string& to) {
  return yaml.replace(yaml.find(from), from.size(), to);  // throws where `from` is not there
}

std::string with_rays(std::string yaml, int rays) {
  const std::size_t at = yaml.find("rays: ") + 6;
  return yaml.replace(at, yaml.find_first_of(",}", at) - at, std::to_string(rays));
}

std::string with_scene(std::string yaml, const std::string& scene) {
  return replaced(std::move(yaml), "{type: analytic_room}", scene);
}

void HookListener::progress(const TrainProgress& p) {
  if (on_progress) on_progress(p);
}
void HookListener::scoring(const ScoreProgress& p) {
  if (on_scoring) on_scoring(p);
}
void HookListener::note(const std::string& text) { on_note ? on_note(text) : void(notes += text + "\n"); }
int HookListener::stop_signal() { return on_stop_signal ? on_stop_signal() : 0; }
bool HookListener::save_request() { return on_save_request && on_save_request(); }
double HookListener::now_s() { return on_now_s ? on_now_s() : RunListener::now_s(); }
double HookListener::step_clock_s() { return on_step_clock_s ? on_step_clock_s() : RunListener::step_clock_s(); }
std::string HookListener::write_report(const RunFolder& folder, const Session& session, const ReportFrames& frames) {
  return reports ? write_run_report(folder, session, frames) : "";
}

std::string stratified_config(const std::string& scene, const std::string& pass_end, const std::string& train,
                              const std::string& more) {
  return "scene: {" + scene + "}\n" +
         "semantics: {hidden_width: 8, weight: 0.5}\n"
         "rendering: {density_activation: softplus, far: background}\n"
         "passes:\n"
         "  - sampler: {type: stratified, samples: 12}\n"
         "    position: {type: hash_grid, levels: 3, log2_entries: 8, finest_resolution: 32}\n"
         "    direction: {type: spherical_harmonics, degree: 2}\n"
         "    field: {type: tiny_mlp, hidden_width: 8, color_width: 8}\n" +
         pass_end + "train: {" + train + "}\n" + more;
}

std::uint32_t train_fingerprint(const std::string& yaml, int threads, std::int64_t steps) {
  TestRun run(yaml, channel_plugins());
  set_thread_count(threads);
  run.to(steps);
  set_thread_count(0);
  return run.bits();
}

StepLosses TestRun::to(std::int64_t step) {
  StepLosses last;
  while (trainer.step() < step) last = trainer.advance(step - trainer.step()).back();
  trainer.collect();
  return last;
}

std::uint32_t TestRun::bits() const { return fingerprint(store()); }

std::uint32_t fingerprint(const ParamStore<float>& store) {
  std::uint32_t crc = 0;
  for (const Tensor<float>& t : store.all()) {
    if (!is_stored(t.spec.role)) continue;  // the others follow from these, in what form the kernels like
    crc = crc32c(std::as_bytes(std::span(t.name)), crc);
    for (const AlignedBuffer<float>* buffer : {&t.value, &t.moment1, &t.moment2}) {
      if (buffer->size() > 0) crc = crc32c(std::as_bytes(std::span(buffer->data(), buffer->size())), crc);
    }
  }
  return crc;
}

std::string write_packed_config(const TempDir& dir, int steps, double checkpoint_every_s) {
  const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene();
  Diagnostics diagnostics;
  const SceneInfo info = scene->open(diagnostics);
  write_packed_scene(dir / "room.sfpack", info, [&](int frame, FrameBuffer& buffer) { scene->read(frame, buffer); });
  std::string yaml = hash_config("report: {eval_every_s: 0, strips: 0, log_every_steps: 5, checkpoint_every_s: " +
                                 std::to_string(checkpoint_every_s) + "}\n");
  yaml =
      replaced(with_scene(yaml, "{type: packed, file: room.sfpack}"), "steps: 200", "steps: " + std::to_string(steps));
  write_file_atomic(dir / "config.yaml", yaml);
  return dir / "config.yaml";
}

std::uint32_t checkpoint_fingerprint(const std::string& run_dir, std::int64_t expected_step) {
  Diagnostics diagnostics;
  const CheckpointStore store = CheckpointStore::read(run_dir + "/checkpoints");
  auto found = store.find_latest(diagnostics);
  EXPECT_TRUE(found.has_value());
  EXPECT_TRUE(diagnostics.all().empty()) << diagnostics.all().front().text();
  if (!found) return 0;
  EXPECT_EQ(found->step, expected_step);
  std::uint32_t crc = 0;
  for (const TensorRef& t : found->file.tensors()) crc = crc32c(t.bytes, crc32c(std::as_bytes(std::span(t.name)), crc));
  return crc;
}

}  // namespace testing_train
}  // namespace semfield
