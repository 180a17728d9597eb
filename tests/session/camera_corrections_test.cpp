// Corrections of training cameras: formulas and gradients against finite differences, the mean that stays, and poses
// and colours that are found again.
#include "model/camera_corrections.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "model/render_rules.h"
#include "session/settings/choices.h"
#include "session/trainer.h"
#include "tests/plugin/toy_encoder.h"
#include "tests/session/oracle.h"

namespace semfield {
namespace {

using namespace testing_train;

const std::string kLearned =
    "cameras: {poses: learned, colors: learned, pose_rate: 0.5, color_rate: 0.5, from_step: 0}, ";

std::string learned(std::string yaml, const std::string& cameras = kLearned) {
  return yaml.replace(yaml.find("train: {"), 8, "train: {" + cameras);
}

void expect_near(Vec3d a, Vec3d b, double tolerance) {
  for (int i = 0; i < 3; ++i) EXPECT_NEAR(a[i], b[i], tolerance) << "axis " << i;
}

// A quarter turn about z, and a small angle by its series.
TEST(CameraMath, RotatesByTheVectorsLength) {
  expect_near(rotated({0, 0, std::acos(0.0)}, {1, 0, 0}), {0, 1, 0}, 1e-15);
  const Vec3d small{3e-5, -2e-5, 1e-5}, v{0.3, -0.5, 0.81};
  expect_near(rotated(small, v), v + cross(small, v) + cross(small, cross(small, v)) * 0.5, 1e-13);
  EXPECT_NEAR(length(rotated({1.2, -2, 0.4}, v)), length(v), 1e-14);
}

TEST(CameraMath, GradientsOfARotationAreThoseOfFiniteDifferences) {
  const Vec3d v{0.3, -0.5, 0.81}, d{1.3, 0.2, -0.7};
  for (const double size : {0.0, 1e-4, 9e-4, 1.1e-3, 0.3, 2.5}) {
    const Vec3d w = Vec3d{0.48, -0.6, 0.64} * size;
    const Vec3d found = rotation_gradient(w, rotated(w, v), d);
    for (int axis = 0; axis < 3; ++axis) {
      Vec3d up = w, down = w;
      up[axis] += 1e-6, down[axis] -= 1e-6;
      EXPECT_NEAR(found[axis], dot(rotated(up, v) - rotated(down, v), d) / 2e-6, 1e-8) << size << " axis " << axis;
    }
  }
}

TEST(CameraMath, GradientsOfTheDomainMapAreThoseOfFiniteDifferences) {
  const Box bounds{{-1, -2, 0}, {2, 1, 2}};
  const Vec3d d{1.3, 0.2, -0.7};
  for (const bool contracted : {false, true}) {
    const DomainMap map = DomainMap::make(Domain::unit_cube, bounds, 0, contracted);
    for (const Vec3d p : {Vec3d{0.4, 0.1, 1.2}, Vec3d{9, -3, 4}, Vec3d{-3, 0.5, 70}, Vec3d{1, -8, 2}}) {
      const Vec3d found = map.gradient(p, d);
      for (int axis = 0; axis < 3; ++axis) {
        Vec3d up = p, down = p;
        up[axis] += 1e-5, down[axis] -= 1e-5;
        EXPECT_NEAR(found[axis], dot(map(up) - map(down), d) / 2e-5, 1e-9) << contracted << " axis " << axis;
      }
    }
  }
}

// A table's encoder, and one that learns nothing. Positions alone: what the view direction says of colours teaches no
// pose, so that neither field sees one here.
TEST(CameraCorrections, GradientsAreThoseOfFiniteDifferences) {
  Registry registry = make_registry();
  std::string tables = stratified_config("type: analytic_room", "", kLearned + "rays: 24"), frequencies = tables;
  const std::size_t direction = tables.find("    direction:");
  if (direction != std::string::npos) tables.erase(direction, tables.find('\n', direction) + 1 - direction);
  const std::size_t position = tables.find("    position:");
  ASSERT_NE(position, std::string::npos);
  frequencies = tables;
  frequencies.replace(position, frequencies.find('\n', position) - position,
                      "    position: {type: frequency, frequencies: 3}");
  for (const std::string& yaml : {tables, frequencies}) {
    SCOPED_TRACE(yaml);
    Oracle oracle(yaml, registry);
    ASSERT_NE(oracle.pipeline->cameras(), nullptr);
    for (const char* name : {"cameras/pose/learned", "cameras/color/learned"}) {
      Tensor<double>* table = oracle.pipeline->store().find(name);
      ASSERT_NE(table, nullptr) << name;
      for (std::int64_t i = 0; i < table->size(); ++i)
        table->value.data()[i] = 0.02 * std::sin(static_cast<double>(i + 1));
    }
    expect_finite_differences(oracle, 2e-3, "cameras/", 6);
  }
}

TEST(CameraCorrections, TilesAndLanesChangeNoGradient) {
  Registry registry = make_registry();
  const std::string yaml = stratified_config("type: analytic_room", "", kLearned + "rays: 24");
  Oracle one(yaml + "runtime: {lanes: 1, tile_rays: 24}\n", registry);
  Oracle many(yaml + "runtime: {lanes: 3, tile_rays: 4}\n", registry);
  EXPECT_NEAR(one.gradients().total, many.gradients().total, 1e-12);
  for (const Tensor<double>& t : one.pipeline->store().all()) {
    if (!t.learned()) continue;
    const Tensor<double>* other = many.pipeline->store().find(t.name);
    for (std::int64_t i = 0; i < t.size(); ++i) ASSERT_NEAR(t.grad.data()[i], other->grad.data()[i], 1e-10) << t.name;
  }
}

TEST(CameraCorrections, KeepTheMeanAndAreAbsentWhereNobodyAsks) {
  Registry registry = make_registry();
  Session session = open_text(learned(hash_config()), registry);
  const std::unique_ptr<RaySource> rays = session.make_ray_source();
  Trainer trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule, session.config.train.steps);
  while (trainer.step() < 20) trainer.advance();
  for (const char* name : {"cameras/pose/used", "cameras/color/used"}) {
    const Tensor<float>* used = session.pipeline->store().find(name);
    ASSERT_NE(used, nullptr) << name;
    double largest = 0;
    for (std::int32_t c = 0; c < used->spec.cols; ++c) {
      double sum = 0;
      for (std::int64_t r = 0; r < used->spec.rows; ++r) {
        const double value = used->value.data()[r * used->spec.cols + c];
        sum += value;
        largest = std::max(largest, std::abs(value));
      }
      EXPECT_NEAR(sum, 0, 1e-5) << name << " column " << c;
    }
    EXPECT_GT(largest, 1e-4) << name;
  }
  Session plain = open_text(hash_config(), registry);
  EXPECT_EQ(plain.pipeline->cameras(), nullptr);
  EXPECT_EQ(plain.pipeline->store().find("cameras/pose/learned"), nullptr);
}

// Until then the field is fog, whose gradients would move right poses.
TEST(CameraCorrections, MoveAfterTheirShareOfTheRun) {
  Registry registry = make_registry();
  Session session = open_text(learned(hash_config(), "cameras: {poses: learned, from_step: 0.1}, "), registry);
  const std::unique_ptr<RaySource> rays = session.make_ray_source();
  Trainer trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule, session.config.train.steps);
  const Tensor<float>* pose = session.pipeline->store().find("cameras/pose/learned");
  ASSERT_NE(pose, nullptr);
  const auto moved = [&] {
    return std::any_of(pose->value.data(), pose->value.data() + pose->size(), [](float x) { return x != 0; });
  };
  while (trainer.step() < session.config.train.steps / 10) trainer.advance();
  EXPECT_FALSE(moved());
  while (trainer.step() < session.config.train.steps / 10 + 2) trainer.advance();
  EXPECT_TRUE(moved());
}

const char* const kAuto = "cameras: {poses: auto, colors: auto}, ";

TEST(CameraChoices, FollowTheEvidence) {
  const auto chosen = [](CameraTrust asked, bool tracked, std::optional<double> exposure,
                         std::optional<bool> fits = {}) {
    CameraParams cameras;
    cameras.poses = cameras.colors = asked;
    const CameraReasons why = choose_cameras(cameras, {tracked, exposure, fits});
    EXPECT_EQ(why.poses.empty() || why.colors.empty(), asked != CameraTrust::automatic);
    return std::pair{cameras.poses == CameraTrust::learned, cameras.colors == CameraTrust::learned};
  };
  using Both = std::pair<bool, bool>;
  EXPECT_EQ(chosen(CameraTrust::automatic, true, 1.02), (Both{true, false}));
  EXPECT_EQ(chosen(CameraTrust::automatic, false, 1.12), (Both{false, true}));
  EXPECT_EQ(chosen(CameraTrust::automatic, true, 1.02, true), (Both{false, false})) << "photographs fit its poses";
  EXPECT_EQ(chosen(CameraTrust::automatic, true, 1.02, false), (Both{true, false}));
  EXPECT_EQ(chosen(CameraTrust::automatic, false, 1.02, false), (Both{false, false})) << "for prepare to fix";
  EXPECT_EQ(chosen(CameraTrust::automatic, false, {}), (Both{false, false})) << "nothing known";
  EXPECT_EQ(chosen(CameraTrust::given, true, 1.12), (Both{false, false})) << "what is asked for stands";
  EXPECT_EQ(chosen(CameraTrust::learned, false, {}), (Both{true, true}));
}

// What the scene decides is written out, with its reason; --keep brings in what it leaves out.
TEST(CameraChoices, AreSettledWhenASceneIsOpened) {
  Registry registry = make_registry();
  const Session phone =
      open_text(with_scene(learned(hash_config(), kAuto), "{type: analytic_room, tracked: true}"), registry);
  EXPECT_EQ(phone.config.cameras.poses, CameraTrust::learned);
  EXPECT_EQ(phone.config.cameras.colors, CameraTrust::given);
  EXPECT_FALSE(phone.eval_job({}).fit_colors);
  EXPECT_NE(phone.pipeline->store().find("cameras/pose/learned"), nullptr);
  EXPECT_EQ(phone.pipeline->store().find("cameras/color/learned"), nullptr);
  const std::vector<std::string> said = phone.choices();
  EXPECT_EQ(std::count(said.begin(), said.end(),
                       "train.cameras.poses: learned, because poses are a phone's, whose tracker drifts"),
            1);
  const Session exposed = open_text(learned(hash_config(), "cameras: {colors: learned}, "), registry);
  EXPECT_TRUE(exposed.eval_job({}).fit_colors) << "scores have a second PSNR";
  const Session other = open_text(learned(hash_config(), kAuto), registry);
  EXPECT_EQ(other.pipeline->cameras(), nullptr);
  const auto row = std::find_if(other.plan.left_out.begin(), other.plan.left_out.end(),
                                [](const LeftOut& one) { return one.component == "camera_poses"; });
  ASSERT_NE(row, other.plan.left_out.end());
  EXPECT_EQ(row->evidence, "poses are not those of a phone's tracker");
  const Session kept = open_text(learned(hash_config(), kAuto), registry, {"camera_poses"});
  EXPECT_NE(kept.pipeline->store().find("cameras/pose/learned"), nullptr);
  EXPECT_EQ(kept.plan.kept, std::vector<std::string>{"camera_poses"});
}

// An encoder whose tables learn must say that it gives gradients of positions alone: another would write into
// gradients that are not there.
TEST(CameraCorrections, AnEncoderThatCannotIsRefusedByName) {
  Registry registry = make_registry();
  toy::register_into(registry);
  std::string yaml = stratified_config("type: analytic_room", "", kLearned + "rays: 24");
  const std::size_t position = yaml.find("    position:");
  yaml.replace(position, yaml.find('\n', position) - position, "    position: {type: toy}");
  EXPECT_HAS(error_of(ErrorKind::config, [&] { (void)open_text(yaml, registry); }),
             "encoder 'toy' has learned tensors and gives no gradient of positions by itself");
}

TEST(CameraCorrections, ARunHasTheSameBitsOnAnyThreads) {
  const std::string yaml = learned(hash_config());
  EXPECT_EQ(train_fingerprint(yaml, 1, 12), train_fingerprint(yaml, 3, 12));
}

}  // namespace
}  // namespace semfield
