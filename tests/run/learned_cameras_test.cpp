// Poses that a run has learned, and poses fitted to a field that stays: both come nearer to the true ones.
#include <gtest/gtest.h>

#include <cmath>

#include "run/run_scores.h"
#include "session/trainer.h"
#include "session/training.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

// Of a camera: three numbers of about the size of a radian, and as many of a metre, that add up to zero over frames.
Pose disturbed(const Pose& pose, int number, double size) {
  float numbers[kPoseNumbers];
  for (int i = 0; i < kPoseNumbers; ++i) numbers[i] = static_cast<float>(size * std::sin(2.3 * number + 1.7 * i + 0.4));
  return corrected(pose, numbers, 1);
}

// Root of the mean square of what two sets of poses differ by, in metres at a point a metre before each camera.
double distance(const std::vector<Pose>& a, const std::vector<Pose>& b) {
  double sum = 0;
  for (std::size_t i = 0; i < a.size(); ++i) {
    const Vec3d off = a[i].apply({0, 0, 1}) - b[i].apply({0, 0, 1});
    sum += dot(off, off);
  }
  return std::sqrt(sum / static_cast<double>(a.size()));
}

std::vector<Pose> poses_of(const Session& session, Split split) {
  std::vector<Pose> poses;
  for (const int f : session.scene.frames_of(split))
    poses.push_back(session.scene.info.frames[static_cast<std::size_t>(f)].world_from_camera);
  return poses;
}

TEST(RefinedPoses, ComeBackToThoseOfTheField) {
  Registry registry = make_registry();
  Session session = open_text(hash_config(), registry);
  const std::unique_ptr<RaySource> rays = session.make_ray_source();
  Trainer trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule, 600);
  while (trainer.step() < 600) trainer.advance();
  const std::vector<Pose> right = poses_of(session, Split::train);
  const std::vector<int> frames = session.scene.frames_of(Split::train);
  for (std::size_t i = 0; i < frames.size(); ++i) {
    Pose& pose = session.scene.info.frames[static_cast<std::size_t>(frames[i])].world_from_camera;
    pose = disturbed(pose, static_cast<int>(i), 0.03);
  }
  const std::vector<Pose> wrong = poses_of(session, Split::train);
  const std::vector<Pose> refined = refine_poses(session, registry, frames, {.steps = 200, .rays = 512});
  EXPECT_LT(distance(refined, right), 0.5 * distance(wrong, right));
  EXPECT_EQ(distance(refine_poses(session, registry, frames, {.steps = 200, .rays = 512}), refined), 0);
}

TEST(LearnedPoses, AreThoseOfTrainingFramesWhenARunIsOpenedAgain) {
  Registry registry = make_registry();
  const TempDir dir;
  std::string yaml = hash_config();
  yaml.replace(yaml.find("train: {"), 8, "train: {cameras: {poses: learned, pose_rate: 0.1}, ");
  TrainRequest request;
  request.out_dir = dir / "run";
  const ConfigNode tree = parse_config_text(yaml, "test.yaml");
  (void)run_training(run_config_of(tree, registry), registry, request, {});
  Diagnostics found;
  const OpenedRun opened = open_run(request.out_dir, {}, registry, found, OpenFor::rendering);
  std::string notes;
  for (const Diagnostic& finding : found.all()) notes += finding.text() + "\n";
  EXPECT_HAS(notes, "training frames have the poses that the run has learned");
  const Session given = open_text(hash_config(), registry);
  EXPECT_GT(distance(poses_of(opened.session, Split::train), poses_of(given, Split::train)), 1e-4);
  EXPECT_EQ(distance(poses_of(opened.session, Split::test), poses_of(given, Split::test)), 0);
}

// A file of another scene, or a damaged one: the given poses stay, and nothing is read past what is there.
TEST(LearnedPoses, OfAnotherShapeAreNotUsed) {
  Registry registry = make_registry();
  Session session = open_text(hash_config(), registry);
  const std::vector<Pose> given = poses_of(session, Split::train);
  const TempDir dir;
  for (const auto& [rows, cols] : {std::pair{2, 6}, {static_cast<int>(given.size()), 7}}) {
    const std::vector<float> numbers(static_cast<std::size_t>(rows * cols), 0.3F);
    write_safetensors(dir / "state.safetensors",
                      {tensor_ref("cameras/pose/learned", {rows, cols}, std::span<const float>(numbers))}, {});
    Diagnostics found;
    use_learned_poses(session, TensorFile::read(dir / "state.safetensors"), found);
    ASSERT_EQ(found.all().size(), 1U);
    EXPECT_TRUE(found.all().front().code == "run.poses.other");
    EXPECT_EQ(distance(poses_of(session, Split::train), given), 0);
  }
}

}  // namespace
}  // namespace semfield
