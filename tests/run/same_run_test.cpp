// Whether a run that is looked at, resumed or compared is still what was trained: its labels, its run.yaml, its
// plugins.
#include <gtest/gtest.h>

#include <filesystem>

#include "loading/packed_scene.h"
#include "run/checkpoint_store.h"
#include "run/open_run.h"
#include "run/run_compare.h"
#include "run/run_folder.h"
#include "settings/run_identity.h"
#include "system/files.h"
#include "testkit/analytic_scene.h"
#include "tests/scene/tiny_scene.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;
using testing_room::error_of;

Registry& registry() {
  static Registry all = make_registry();
  return all;
}

std::string texts(const Diagnostics& diagnostics) {
  std::string out;
  for (const Diagnostic& d : diagnostics.all()) out += d.text() + "\n";
  return out;
}

// A run of a few steps on a packed room, in DIR/run.
struct Trained {
  TempDir dir;
  std::string run = dir / "run";
  explicit Trained(const std::string& labels = "") {
    const std::string config = write_packed_config(dir, 4, 0);
    std::string yaml = read_text_file(config);
    yaml.replace(yaml.find("room.sfpack}"), 12, "room.sfpack" + labels + "}");
    write_file_atomic(config, yaml);
    train(config, run, 4, false);
  }
  static std::string train(const std::string& config, const std::string& folder, std::int64_t steps, bool resume) {
    std::string notes;
    HookListener hooks;
    hooks.on_note = [&](const std::string& text) { notes += text + "\n"; };
    TrainRequest request;
    request.out_dir = folder;
    request.resume = resume;
    RunConfig read = load_run_config(config, {}, registry());
    read.train.steps = steps;
    run_training(std::move(read), registry(), request, &hooks);
    return notes;
  }
  std::string resume(std::int64_t steps) const { return train(run + "/run.yaml", run, steps, true); }
  /// What looking at the run says.
  std::string open(const std::vector<std::string>& overrides = {}, OpenFor purpose = OpenFor::evaluation) const {
    Diagnostics diagnostics;
    (void)open_run(run, overrides, registry(), diagnostics, purpose);
    return texts(diagnostics);
  }
  void edit(const std::string& from, const std::string& to) const {
    std::string yaml = read_text_file(run + "/run.yaml");
    ASSERT_NE(yaml.find(from), std::string::npos) << yaml;
    yaml.replace(yaml.find(from), from.size(), to);
    write_file_atomic(run + "/run.yaml", yaml);
  }
  /// The scene again, with the labels of the two frames exchanged.
  void exchange_labels(int first, int second) const {
    const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene();
    Diagnostics ignored;
    const SceneInfo info = scene->open(ignored);
    write_packed_scene(dir / "room.sfpack", info, [&](int frame, FrameBuffer& buffer) {
      scene->read(frame, buffer);
      if (frame != first && frame != second) return;
      FrameBuffer other;
      scene->read(frame == first ? second : first, other);
      buffer.label = other.label;
    });
  }
  /// A checkpoint as an earlier version wrote it.
  void drop_metadata(const std::string& key, const std::string& within = "") const {
    Diagnostics ignored;
    auto found = CheckpointStore::read(run + "/checkpoints").find_latest(ignored);
    TensorMetadata metadata = found->file.metadata();
    std::erase_if(metadata, [](const auto& entry) { return entry.first.starts_with("semfield.crc32c"); });
    if (within.empty()) {
      metadata.erase(key);
    } else {
      std::string& text = metadata.at(key);
      const std::size_t at = text.find(",\"" + within);
      text.erase(at, text.find_first_of(",}", at + 1) - at);
    }
    write_safetensors(found->path, found->file.tensors(), metadata);
  }
};

constexpr const char* kOtherLabels =
    "scene: it is not as it was when the run was trained: other labels; restore the data, or train anew";

// Of two training frames and of two test frames: every count of pixels stays as it was.
TEST(SameRun, ExchangedLabelsAreToldByEvalAndResume) {
  const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene();
  Diagnostics ignored;
  const SceneInfo info = scene->open(ignored);
  std::vector<int> of[2];
  for (std::size_t f = 0; f < info.frames.size(); ++f)
    of[info.frames[f].split == Split::train ? 0 : 1].push_back(static_cast<int>(f));
  for (const std::vector<int>& frames : of) {
    const Trained trained;
    EXPECT_EQ(trained.open(), "");
    EXPECT_EQ(trained.open({}, OpenFor::evaluation_of_training_frames), "");
    EXPECT_EQ(trained.resume(5).find("it is not as it was"), std::string::npos);
    trained.exchange_labels(frames.at(0), frames.at(1));
    EXPECT_NE(trained.open().find(kOtherLabels), std::string::npos) << trained.open();
    EXPECT_EQ(trained.open({}, OpenFor::rendering), "") << "no label is read";
    EXPECT_NE(trained.resume(6).find(kOtherLabels), std::string::npos);
  }
}

TEST(SameRun, LabelsThatTheSettingsChooseAreNoOtherLabels) {
  const Trained trained(", labels: {frames: 50%}");
  EXPECT_EQ(trained.open({}, OpenFor::evaluation_of_training_frames), "");
  std::string said = trained.open({"scene.labels.frames=all"}, OpenFor::evaluation_of_training_frames);
  std::erase(said, '"');  // which some versions of yaml-cpp put around the value
  EXPECT_EQ(said, "settings: other ones than the run was trained with: scene.labels.frames: 50% -> all\n");
}

TEST(SameRun, ACheckpointOfAnEarlierVersionOpensAndSaysThatLabelsWereNotCompared) {
  const Trained trained;
  trained.drop_metadata("inputs", "training_labels");
  trained.drop_metadata("inputs", "labels");
  trained.exchange_labels(0, 1);
  const std::string said = trained.open();
  EXPECT_NE(said.find("scene: the checkpoint is of an earlier version, which kept no checksum of labels: whether they "
                      "are still the same was not compared"),
            std::string::npos)
      << said;
  EXPECT_EQ(said.find("other labels"), std::string::npos) << said;
}

TEST(SameRun, AnEditedRunYamlIsRefusedWithBothWaysOut) {
  const Trained trained;
  const std::string file = trained.run + "/run.yaml";
  Diagnostics ignored;
  const RunConfig before = load_run_config(file, {}, registry());
  trained.edit("density_activation: softplus", "density_activation: trunc_exp");
  for (const OpenFor purpose : {OpenFor::evaluation, OpenFor::rendering, OpenFor::evaluation_of_training_frames}) {
    EXPECT_EQ(error_of([&] { (void)trained.open({}, purpose); }),
              "'" + file +
                  "' is not as the run was trained: rendering.density_activation: softplus -> trunc_exp; for "
                  "the settings of training add --set rendering.density_activation=softplus, or restore the "
                  "file; for the file's add --set rendering.density_activation=trunc_exp");
  }
  EXPECT_EQ(trained.open({"rendering.density_activation=softplus"}), "");
  EXPECT_EQ(trained.open({"rendering.density_activation=trunc_exp"}),
            "settings: other ones than the run was trained with: rendering.density_activation: softplus -> "
            "trunc_exp\n");
  // What is no part of the run's identity may be edited.
  const Trained other;
  other.edit("steps: 4", "steps: 9");
  other.edit("strips: 0", "strips: 3");
  EXPECT_EQ(other.open(), "");
}

TEST(SameRun, ComparingTellsOfAnEditedRunYaml) {
  const Trained trained;
  std::filesystem::copy(trained.run, trained.dir / "copy", std::filesystem::copy_options::recursive);
  Diagnostics none, told;
  EXPECT_EQ(compare_runs(trained.run, trained.dir / "copy", registry(), none).difference, "");
  EXPECT_EQ(texts(none), "");
  trained.edit("density_activation: softplus", "density_activation: trunc_exp");
  EXPECT_EQ(compare_runs(trained.run, trained.dir / "copy", registry(), told).difference, "");
  EXPECT_EQ(texts(told), trained.run +
                             "/run.yaml: it is not as the run was trained: rendering.density_activation: "
                             "softplus -> trunc_exp; restore it; the settings in the checkpoints are "
                             "compared\n");
}

TEST(SameRun, AChangedFileOfAPluginIsTold) {
  const TempDir dir;
  const std::string module = dir / "waves.so", config = write_packed_config(dir, 4, 0), run = dir / "run";
  write_file_atomic(module, "one");
  Registry with_module = make_registry();
  with_module.add_module_file(module);
  TrainRequest request;
  request.out_dir = run;
  run_training(load_run_config(config, {}, with_module), with_module, request, nullptr);
  const auto open = [&] {
    Diagnostics diagnostics;
    (void)open_run(run, {}, with_module, diagnostics);
    return texts(diagnostics);
  };
  EXPECT_EQ(open(), "");
  write_file_atomic(module, "another");
  EXPECT_NE(open().find("waves.so: the file of this plugin is not the one that the run was trained with: its CRC-32C "
                        "is "),
            std::string::npos)
      << open();
  request.resume = true;
  std::string notes;
  HookListener hooks;
  hooks.on_note = [&](const std::string& text) { notes += text + "\n"; };
  RunConfig again = load_run_config(run + "/run.yaml", {}, with_module);
  again.train.steps = 5;
  run_training(std::move(again), with_module, request, &hooks);
  EXPECT_NE(notes.find("waves.so: the file of this plugin is not the one"), std::string::npos) << notes;
  EXPECT_EQ(open(), "") << "it is the file of the newest checkpoint now";
}

}  // namespace
}  // namespace semfield
