// Bad numbers that a dataset states or delivers: refused at reading, or of no effect where the conventions say so; and
// bad rays and labels that reach a batch all the same: named with frame and pixel.
#include "testkit/analytic_scene.h"
#include "tests/guards/poison.h"

namespace semfield {

namespace testing_guards {
// What the dataset below changes in frame 3 (a test frame of the analytic room is every fourth) or in the manifest.
std::function<void(SceneInfo&)>& spoil_manifest() {
  static std::function<void(SceneInfo&)> f;
  return f;
}
std::function<void(FrameBuffer&)>& spoil_pixels() {
  static std::function<void(FrameBuffer&)> f;
  return f;
}
}  // namespace testing_guards

struct SpoiledRoomParams {
  int frames = 6;
};
void describe(ParamVisitor& visit, SpoiledRoomParams& p) { SEMFIELD_PARAM(visit, p, frames, "frames", {1, 1000}); }
void validate(const SpoiledRoomParams&, Diagnostics&) {}

class SpoiledRoom final : public Dataset {
 public:
  SpoiledRoom(const SpoiledRoomParams& p, const DatasetBuild&) {
    testkit::AnalyticSceneOptions options{.frames = p.frames, .width_px = 16, .height_px = 12};
    inner_ = testkit::make_analytic_scene(options);
  }
  SceneInfo open(Diagnostics& diagnostics) override {
    SceneInfo info = inner_->open(diagnostics);
    if (testing_guards::spoil_manifest()) testing_guards::spoil_manifest()(info);
    return info;
  }
  void read(int frame, FrameBuffer& out) const override {
    inner_->read(frame, out);
    if (frame == kFrame && testing_guards::spoil_pixels()) testing_guards::spoil_pixels()(out);
  }
  static constexpr int kFrame = 2;

 private:
  std::unique_ptr<Dataset> inner_;
};

namespace {

using namespace testing_guards;

const double kBad[] = {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity(),
                       -std::numeric_limits<double>::infinity()};

Registry make_spoiled_registry() {
  Registry registry = testing_train::make_registry();
  registry.add_dataset<SpoiledRoom, SpoiledRoomParams>("spoiled_room", "a room of formulas with a fault");
  return registry;
}

std::string spoiled_yaml(const std::string& more = "") {
  std::string yaml = testing_train::two_pass_config();
  yaml.replace(yaml.find("analytic_room"), 13, "spoiled_room" + more);
  return yaml;
}

std::string message_of_opening(const std::string& yaml, Registry& registry) {
  const std::string message = error_of([&] { testing_train::open_text(yaml, registry); });
  spoil_manifest() = nullptr;
  spoil_pixels() = nullptr;
  return message;
}

void expect_refused(const std::string& kind, const std::string& site, const std::vector<std::string>& words,
                    Registry& registry) {
  const std::string message = message_of_opening(spoiled_yaml(), registry);
  bool caught = !message.empty();
  for (const std::string& word : words) caught = caught && message.find(word) != std::string::npos;
  EXPECT_TRUE(caught) << site << ": " << message;
  tally().add(kind, caught);
}

TEST(ReadingInjection, PosesAndIntrinsics) {
  Registry registry = make_spoiled_registry();
  for (const double bad : kBad) {
    for (std::size_t i = 0; i < 12; ++i) {
      spoil_manifest() = [=](SceneInfo& info) {
        Pose& pose = info.frames[SpoiledRoom::kFrame].world_from_camera;
        (i < 9 ? pose.r[i / 3][i % 3] : pose.t[static_cast<int>(i - 9)]) = bad;
      };
      expect_refused("pose", "pose entry " + std::to_string(i), {"pose", "not finite", "frame '"}, registry);
    }
    for (double Camera::*const member : {&Camera::fx, &Camera::fy, &Camera::cx, &Camera::cy, &Camera::k1, &Camera::k2,
                                         &Camera::k3, &Camera::k4, &Camera::p1, &Camera::p2}) {
      spoil_manifest() = [=](SceneInfo& info) { info.frames[SpoiledRoom::kFrame].camera.*member = bad; };
      expect_refused("intrinsics", "intrinsic", {"intrinsic", "not finite", "frame '"}, registry);
    }
    spoil_manifest() = [=](SceneInfo& info) { info.near_hint_m = bad; };
    expect_refused("near and far", "near", {"near and far"}, registry);
    spoil_manifest() = [=](SceneInfo& info) { info.far_hint_m = bad; };
    expect_refused("near and far", "far", {"near and far"}, registry);
    for (int a = 0; a < 6; ++a) {
      spoil_manifest() = [=](SceneInfo& info) {
        info.bounds = {{-2, -2, -2}, {2, 2, 2}};
        (a < 3 ? info.bounds.lo : info.bounds.hi)[a % 3] = bad;
      };
      expect_refused("bounds", "bounds", {"bounds are not finite"}, registry);
    }
  }
  for (const double bad : {0.0, -4.0}) {
    spoil_manifest() = [=](SceneInfo& info) { info.frames[SpoiledRoom::kFrame].camera.fx = bad; };
    expect_refused("intrinsics", "focal length", {"focal length", "must be positive", "frame '"}, registry);
  }
}

TEST(ReadingInjection, LabelsOutsideTheClasses) {
  Registry registry = make_spoiled_registry();
  for (const int bad : {5, -2, 255, 32767, -32768}) {
    spoil_pixels() = [=](FrameBuffer& b) { b.label[16 * 7 + 3] = static_cast<std::int16_t>(bad); };
    expect_refused("label", "label " + std::to_string(bad),
                   {"label " + std::to_string(bad) + " at x 3, y 7", "classes are 0 to 4", "frame '"}, registry);
  }
}

// By convention a depth that is no distance is no measurement: no effect, in bits.
TEST(ReadingInjection, DepthPixelsWithoutADistance) {
  Registry registry = make_spoiled_registry();
  const auto extent = [&](float depth) {
    spoil_pixels() = [=](FrameBuffer& b) { b.depth_m[50] = depth; };
    const Session s = testing_train::open_text(spoiled_yaml(), registry);
    spoil_pixels() = nullptr;
    return std::vector<double>{s.scene.near_m,      s.scene.far_m,       s.scene.bounds.lo.x,      s.scene.bounds.hi.y,
                               s.scene.bounds.lo.z, s.scene.bounds.hi.x, s.scene.pixel_footprint_m};
  };
  const std::vector<double> none = extent(0);
  for (const double bad : {kBad[0], kBad[1], kBad[2], -1.0}) {
    const bool caught = extent(static_cast<float>(bad)) == none;
    EXPECT_TRUE(caught) << bad;
    tally().add("depth pixel", caught);
  }
}

TEST(ReadingInjection, ScalesAndDistancesOfTheConfiguration) {
  Registry registry = make_spoiled_registry();
  for (const char* bad : {".nan", ".inf", "-.inf", "1e400"}) {
    for (const char* key : {"rendering: {scene_scale: ", "rendering: {density_bias: ", "rendering: {early_stop: ",
                            "semantics: {weight: ", "train: {adam: {learning_rate: "}) {
      std::string yaml = testing_train::hash_config();
      const std::string section = std::string(key).substr(0, std::string(key).find(':'));
      const std::size_t line = yaml.find(section + ":");
      yaml.erase(line, yaml.find('\n', line) + 1 - line);
      yaml += std::string(key) + bad + (section == "train" ? "}}\n" : "}\n");
      const std::string message = message_of_opening(yaml, registry);
      const bool caught = message.find("test.yaml:") != std::string::npos;
      EXPECT_TRUE(caught) << key << bad << ": " << message;
      tally().add("number of the configuration", caught);
    }
    const std::string message = message_of_opening(spoiled_yaml(std::string(", near_m: ") + bad), registry);
    EXPECT_FALSE(message.empty()) << bad;
    tally().add("number of the configuration", !message.empty());
  }
}

// Rays: cameras that became bad behind the reader's back.
struct BadRays {
  FrameBuffer buffer;
  StoredFrame stored;
  TrainingLabels::Frame labels;
  RayLimits limits;

  BadRays() {
    buffer.width_px = 8;
    buffer.height_px = 4;
    buffer.rgb.assign(96, 128);
  }
  RaySource make(const RayCamera& camera, const Subject& subject) {
    RaySourceOptions options{.train = {.rays = 12}, .tile_rays = subject.session.pipeline->tile_rays()};
    stored = StoredFrame(buffer);
    return RaySource({{camera, &stored, labels.empty() ? nullptr : &labels, "bad_one"}}, {0, 1, 2, 3, 4},
                     subject.session.limits, options);
  }
  static RayCamera camera() {
    return RayCamera{.camera = {.width_px = 8, .height_px = 4, .fx = 4, .fy = 4, .cx = 4, .cy = 2}};
  }
};

TEST(ReadingInjection, RaysOfABadCamera) {
  Registry registry = testing_train::make_registry();
  Subject subject(testing_train::two_pass_config(), registry, 1);
  const auto expect_named = [&](const std::string& site, const RayCamera& camera) {
    BadRays bad;
    const RaySource source = bad.make(camera, subject);
    subject.trainer = std::make_unique<Trainer>(*subject.session.pipeline, source, subject.session.config.adam,
                                                subject.session.config.schedule);
    expect_caught(subject, "ray of a batch", site, {"frame 'bad_one', pixel x ", " of ray ", "nothing was changed"});
  };
  for (const double bad : kBad) {
    for (std::size_t i = 0; i < 12; ++i) {
      RayCamera c = BadRays::camera();
      (i < 9 ? c.world_from_camera.r[i / 3][i % 3] : c.world_from_camera.t[static_cast<int>(i - 9)]) = bad;
      expect_named("pose entry " + std::to_string(i), c);
    }
    for (double Camera::*const member : {&Camera::cx, &Camera::cy}) {
      RayCamera c = BadRays::camera();
      c.camera.*member = bad;
      expect_named("principal point", c);
    }
  }
}

TEST(ReadingInjection, LabelsOfABatch) {
  Registry registry = testing_train::make_registry();
  Subject subject(testing_train::two_pass_config(), registry, 1);
  for (const int bad : {5, -2, 255, 32767}) {
    BadRays rays;
    rays.labels.hard = LabelMap(std::vector<std::int16_t>(32, static_cast<std::int16_t>(bad)));
    std::string message;
    try {
      const RaySource source = rays.make(BadRays::camera(), subject);
      subject.trainer = std::make_unique<Trainer>(*subject.session.pipeline, source, subject.session.config.adam,
                                                  subject.session.config.schedule);
      expect_caught(subject, "label of a batch", "label " + std::to_string(bad),
                    {"frame 'bad_one', pixel x ", "label " + std::to_string(bad) + " is not a class"});
    } catch (const Error& error) {
      ADD_FAILURE() << error.what();
    }
  }
}

// What only a caller of the pipeline can do: colours and soft labels of a batch. The ray is named.
TEST(ReadingInjection, ColoursAndSoftLabelsOfABatch) {
  Registry registry = testing_train::make_registry();
  Subject subject(testing_train::two_pass_config(), registry, 1);
  const auto classes = static_cast<std::int32_t>(subject.session.plan.class_of_logit.size());
  for (const bool soft : {false, true}) {
    for (const double bad : {kBad[0], kBad[1], kBad[2], -0.5}) {
      if (!soft && bad == -0.5) continue;  // a colour may be any number
      BatchBuffers batch;
      subject.rays->fill(1, batch);
      const std::int64_t rays = std::ssize(batch.label);
      std::vector<float> rows(static_cast<std::size_t>(rays * classes), 1.0F / static_cast<float>(classes));
      RayBatch view = batch.view(true);
      if (soft) {
        rows[7 * classes + 1] = static_cast<float>(bad);
        view.targets.more.set(channel::soft_label, {rows.data(), rays, classes});
      } else {
        batch.target[3 * 7 + 1] = static_cast<float>(bad);
      }
      const std::string message = error_of([&] { subject.session.pipeline->gradients(1, view); });
      const std::optional<RayFault> fault = subject.session.pipeline->find_fault(1, view);
      const bool caught = message.find("ray 7") != std::string::npos && (!soft || (fault && fault->ray() == 7));
      EXPECT_TRUE(caught) << soft << ' ' << bad << ": " << message;
      tally().add(soft ? "soft label" : "true colour", caught);
    }
  }
}

}  // namespace
}  // namespace semfield
