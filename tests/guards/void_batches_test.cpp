// Batches without a label: loss 0, gradients of the head bitwise 0, its tensors and moments untouched.
#include <gtest/gtest.h>

#include <cmath>
#include <fstream>

#include "plugin/linked_plugins.h"
#include "run/train_run.h"
#include "tests/guards/poison.h"

namespace semfield {
namespace {

using namespace testing_guards;

bool is_head(const std::string& name) { return name.find("/semantic/") != std::string::npos; }

class VoidBatches : public ::testing::TestWithParam<const char*> {};

TEST_P(VoidBatches, LeaveTheHeadAlone) {
  const std::string normalisation = GetParam();
  Registry registry = testing_train::make_registry();
  std::string yaml = testing_train::two_pass_config();
  yaml.replace(yaml.find("weight: 0.3"), 11, "weight: 0.3, normalisation: " + normalisation);
  Subject subject(yaml, registry, 5);  // with labels: the head has moments
  const Snapshot before(subject);
  bool head_has_moments = false;
  for (const auto& [name, bits] : before.bits) {
    if (!is_head(name) || name.back() != 'm') continue;
    for (const std::uint32_t b : bits) head_has_moments = head_has_moments || b != 0;
  }
  ASSERT_TRUE(head_has_moments);

  // The same scene, every pixel void.
  std::vector<TrainFrame> frames;
  std::vector<TrainingLabels::Frame> labels(subject.session.scene.frames.size());
  for (const int f : subject.session.scene.frames_of(Split::train)) {
    const auto i = static_cast<std::size_t>(f);
    const FrameInfo& info = subject.session.scene.info.frames[i];
    const auto pixels =
        static_cast<std::size_t>(info.camera.width_px) * static_cast<std::size_t>(info.camera.height_px);
    labels[i].hard = LabelMap(std::vector<std::int16_t>(pixels, kVoid));
    frames.push_back({{info.camera, info.world_from_camera, false}, &subject.session.scene.frames[i], &labels[i], ""});
  }
  RaySourceOptions options;
  options.train.rays = 64;
  options.tile_rays = subject.session.pipeline->tile_rays();
  const RaySource source(std::move(frames), {0, 1, 2, 3, 4}, subject.session.limits, options);

  BatchBuffers batch;
  source.fill(5, batch);
  subject.store().zero_gradients();
  const StepLosses losses = subject.session.pipeline->gradients(5, batch.view(true));
  EXPECT_EQ(losses.semantic, 0);
  EXPECT_EQ(losses.labelled, 0);
  EXPECT_EQ(losses.total, losses.color);
  for (const Tensor<float>& t : subject.store().all()) {
    for (std::size_t i = 0; i < t.grad.size() && is_head(t.name); ++i) ASSERT_EQ(t.grad.data()[i], 0) << t.name;
  }
  subject.store().clear_gradients();

  Trainer trainer(*subject.session.pipeline, source, subject.session.config.adam, subject.session.config.schedule);
  for (int i = 0; i < 4; ++i) {
    const StepLosses step = trainer.advance();
    EXPECT_EQ(step.semantic, 0);
    EXPECT_TRUE(std::isfinite(step.total));
  }
  bool field_moved = false;
  for (const auto& [name, bits] : Snapshot(subject).bits) {
    if (is_head(name)) {
      EXPECT_EQ(bits, before.bits.at(name)) << name;
    } else {
      field_moved = field_moved || bits != before.bits.at(name);
    }
  }
  EXPECT_TRUE(field_moved);
}

INSTANTIATE_TEST_SUITE_P(Normalisations, VoidBatches, ::testing::Values("mean_labelled", "sum", "mean_rays"),
                         [](const auto& test) { return std::string(test.param); });

// A run in which most batches have no label writes numbers and nulls.
TEST(VoidBatchesRun, NoNanInTheLogs) {
  Registry registry = testing_train::make_registry();
  const testing_train::TempDir folder;
  std::string yaml = testing_train::two_pass_config("report: {log_every_steps: 1, eval_every_s: 0}\n");
  yaml.replace(yaml.find("{type: analytic_room}"), 21, "{type: analytic_room, labels: {frames: 1}}");
  yaml.replace(yaml.find("steps: 50, rays: 64"), 19, "steps: 12, rays: 4");
  Diagnostics diagnostics;
  RunConfig config = read_run_config(parse_config_text(yaml, "test.yaml"), registry, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::config, "");
  TrainRequest request;
  request.out_dir = folder / "run";
  run_training(std::move(config), registry, request, {});
  int rows = 0, without_label = 0;
  for (const char* name : {"/metrics.jsonl", "/final_eval.json"}) {
    std::ifstream file(request.out_dir + name);
    ASSERT_TRUE(file) << name;
    for (std::string line; std::getline(file, line); ++rows) {
      EXPECT_EQ(line.find("nan"), std::string::npos) << line;
      without_label += line.find("\"loss_semantic\":0,") != std::string::npos ||
                               line.find("\"loss_semantic\": 0,") != std::string::npos ||
                               line.find("\"loss_semantic\":0.0,") != std::string::npos
                           ? 1
                           : 0;
    }
  }
  EXPECT_GE(rows, 13);
  EXPECT_GT(without_label, 0);
}

}  // namespace
}  // namespace semfield
