// Whether a run that is looked at, resumed or compared is still what was trained: its labels, its run.yaml, its
// plugins.

#include <functional>

#include "config/settings/choices.h"
#include "core/process.h"
#include "eval/final_eval.h"
#include "scene/loading/packed_scene.h"
#include "tests/analytic_scene.h"
#include "tests/scene/tiny_scene.h"
#include "tests/session/train_testing.h"
#include "train/opened_run.h"
#include "train/run_folder.h"
#include "train/self_training.h"

namespace semfield {
namespace {

using namespace testing_train;

// A run of a few steps on a packed room, in DIR/run.
struct Trained {
  TempDir dir;
  std::string run = dir / "run";
  explicit Trained(const std::string& labels = "", const std::string& rendering = "") {
    const std::string config = write_packed_config(dir, 4, 0);
    std::string yaml = replaced(replaced(read_text_file(config), "room.sfpack}", "room.sfpack" + labels + "}"),
                                "far: background}", "far: background" + rendering + "}");
    write_file_atomic(config, yaml);
    train(config, run, 4, false);
  }
  static std::string train(const std::string& config, const std::string& folder, std::int64_t steps, bool resume) {
    HookListener hooks;
    TrainRequest request{.out_dir = folder, .resume = resume};
    RunConfig read = load_run_config(config, {}, all_plugins());
    read.train.steps = steps;
    run_training(std::move(read), all_plugins(), request, &hooks);
    return hooks.notes;
  }
  std::string resume(std::int64_t steps) const { return train(run + "/run.yaml", run, steps, true); }
  /// What looking at the run says.
  std::string open(const std::vector<std::string>& overrides = {}, OpenFor purpose = OpenFor::evaluation) const {
    Diagnostics diagnostics;
    (void)open_run(run, overrides, all_plugins(), diagnostics, purpose);
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
  /// The newest checkpoint with other metadata, without checksums.
  void rewrite_checkpoint(const std::function<void(TensorMetadata&)>& change) const {
    Diagnostics ignored;
    auto found = CheckpointStore::read(run + "/checkpoints").find_latest(ignored);
    TensorMetadata metadata = found->file.metadata();
    std::erase_if(metadata, [](const auto& entry) { return entry.first.starts_with("semfield.crc32c"); });
    change(metadata);
    write_safetensors(found->path, found->file.tensors(), metadata);
  }
  /// A checkpoint as an earlier version wrote it.
  void drop_metadata(const std::string& key, const std::string& within) const {
    rewrite_checkpoint([&](TensorMetadata& metadata) {
      std::string& text = metadata.at(key);
      const std::size_t at = text.find(",\"" + within);
      text.erase(at, text.find_first_of(",}", at + 1) - at);
    });
  }
  /// As 1.0 wrote it, whose density was per metre.
  void drop_unit() const {
    const auto without_unit = [](const std::string& text) {
      const ConfigNode tree = parse_config_text(text, "run.yaml");
      EXPECT_NE(tree.find("rendering")->find("unit_m"), nullptr);
      return write_config(tree.with("rendering", tree.find("rendering")->without("unit_m")));
    };
    write_file_atomic(run + "/run.yaml", without_unit(read_text_file(run + "/run.yaml")));
    rewrite_checkpoint([&](TensorMetadata& metadata) { metadata.at("config") = without_unit(metadata.at("config")); });
  }
};

TEST(SameRun, ARunOf1_0OpensAndGoesOnWithDensityPerMetre) {
  const Trained other(", load: {bounds: [-1, -1, -1, 1, 1, 1]}");
  EXPECT_LACKS(read_text_file(other.run + "/run.yaml"), "unit_m: 1.0\n") << "the scene asks for another unit";
  const Trained now("", ", unit_m: 1"), then("", ", unit_m: 1");
  then.drop_unit();
  EXPECT_EQ(then.open(), "");
  EXPECT_EQ(then.open({}, OpenFor::rendering), "");
  const auto first_line = [](const std::string& notes) { return notes.substr(0, notes.find('\n')); };
  EXPECT_EQ(first_line(then.resume(6)), first_line(now.resume(6)));
  EXPECT_EQ(checkpoint_fingerprint(then.run, 6), checkpoint_fingerprint(now.run, 6));
}

constexpr const char* kOtherLabels =
    "scene: it has changed since the run was trained: other labels; restore the data, or train again";

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
    EXPECT_LACKS(trained.resume(5), "it is not as it was");
    trained.exchange_labels(frames.at(0), frames.at(1));
    EXPECT_HAS(trained.open(), kOtherLabels);
    EXPECT_EQ(trained.open({}, OpenFor::rendering), "") << "no label is read";
    EXPECT_HAS(trained.resume(6), kOtherLabels);
  }
}

TEST(SameRun, LabelsThatTheSettingsChooseAreNoOtherLabels) {
  const Trained trained(", labels: {frames: 50%}");
  EXPECT_EQ(trained.open({}, OpenFor::evaluation_of_training_frames), "");
  std::string said = trained.open({"scene.labels.frames=all"}, OpenFor::evaluation_of_training_frames);
  std::erase(said, '"');  // which some versions of yaml-cpp put around the value
  EXPECT_EQ(said, "settings: they differ from those that the run was trained with: scene.labels.frames: 50% -> all\n");
}

TEST(SameRun, ACheckpointOfAnEarlierVersionOpensAndSaysThatLabelsWereNotCompared) {
  const Trained trained;
  trained.drop_metadata("inputs", "training_labels");
  trained.drop_metadata("inputs", "labels");
  trained.exchange_labels(0, 1);
  const std::string said = trained.open();
  EXPECT_HAS(said,
             "scene: the checkpoint is of an older version, which kept no checksum of labels: whether they "
             "are still the same was not compared");
  EXPECT_LACKS(said, "other labels");
}

TEST(SameRun, AnEditedRunYamlIsRefusedWithBothWaysOut) {
  const Trained trained;
  const std::string file = trained.run + "/run.yaml";
  Diagnostics ignored;
  const RunConfig before = load_run_config(file, {}, all_plugins());
  trained.edit("density_activation: softplus", "density_activation: trunc_exp");
  for (const OpenFor purpose : {OpenFor::evaluation, OpenFor::rendering, OpenFor::evaluation_of_training_frames})
    EXPECT_HAS(error_of([&] { (void)trained.open({}, purpose); }), file, "-> trunc_exp");
  EXPECT_EQ(trained.open({"rendering.density_activation=softplus"}), "");
  EXPECT_EQ(trained.open({"rendering.density_activation=trunc_exp"}),
            "settings: they differ from those that the run was trained with: rendering.density_activation: softplus -> "
            "trunc_exp\n");
  // What is no part of the run's identity may be edited.
  const Trained other(", load: {bounds: [-1, -1, -1, 1, 1, 1]}");
  other.edit("steps: 4", "steps: 9");
  other.edit("strips: 0", "strips: 3");
  EXPECT_EQ(other.open(), "");
}

TEST(SameRun, AChangedFileOfAPluginIsTold) {
  const TempDir dir;
  const std::string module = dir / "waves.so", config = write_packed_config(dir, 4, 0), run = dir / "run";
  write_file_atomic(module, "one");
  Registry with_module = make_registry();
  with_module.add_module_file(module);
  TrainRequest request{.out_dir = run};
  run_training(load_run_config(config, {}, with_module), with_module, request, nullptr);
  const auto open = [&] {
    Diagnostics diagnostics;
    (void)open_run(run, {}, with_module, diagnostics);
    return texts(diagnostics);
  };
  EXPECT_EQ(open(), "");
  write_file_atomic(module, "another");
  EXPECT_HAS(open(),
             "waves.so: the file of this plugin is not the one that the run was trained with: its CRC-32C "
             "is ");
  request.resume = true;
  HookListener hooks;
  RunConfig again = load_run_config(run + "/run.yaml", {}, with_module);
  again.train.steps = 5;
  run_training(std::move(again), with_module, request, &hooks);
  EXPECT_HAS(hooks.notes, "waves.so: the file of this plugin is not the one");
  EXPECT_EQ(open(), "") << "it is the file of the newest checkpoint now";
}

// A run driven step by step: the bits and the folder of the whole run, saved here and there, gone on with.

constexpr int kSteps = 20;

struct DrivenRun : ::testing::Test {
  DrivenRun() { write_packed_config(dir_, kSteps, 0); }
  RunConfig config(const std::vector<std::string>& set = {}) {
    return load_run_config(dir_ / "config.yaml", set, registry_);
  }
  static void drive(semfield::Run& run, std::int64_t until) {
    while (run.training().step() < until) run.advance(until - run.training().step());
  }
  std::uint32_t whole_run(const std::vector<std::string>& set = {}) {
    TrainRequest request{.out_dir = dir_ / "whole"};
    run_training(config(set), registry_, request);
    return checkpoint_fingerprint(request.out_dir, kSteps);
  }

  TempDir dir_;
  Registry registry_ = make_registry();
  struct Listener final : RunListener {
    int stop_signal() override { return stops ? 15 : 0; }
    void row(const MetricsRow&) override { ++rows; }
    bool stops = false;
    int rows = 0;
  } nobody_;
};

TEST_F(DrivenRun, HasTheBitsAndTheRowsOfTheWholeRun) {
  const std::uint32_t bits = whole_run();
  semfield::Run run(config(), registry_, {}, &nobody_);
  drive(run, 7);
  drive(run, kSteps);
  EXPECT_EQ(run.run_dir(), "");
  run.save(dir_ / "driven");
  EXPECT_EQ(checkpoint_fingerprint(dir_ / "driven", kSteps), bits);
  std::vector<MetricsRow> theirs = read_metrics(dir_ / "whole/metrics.jsonl");
  std::erase_if(theirs, [](const MetricsRow& row) { return row.kind != "train"; });
  const std::vector<MetricsRow> mine = read_metrics(dir_ / "driven/metrics.jsonl");
  ASSERT_EQ(mine.size(), theirs.size());
  EXPECT_EQ(std::ssize(mine), nobody_.rows);
  for (std::size_t i = 0; i < mine.size(); ++i) {
    EXPECT_EQ(mine[i].step, theirs[i].step);
    EXPECT_EQ(mine[i].get("loss"), theirs[i].get("loss"));
    EXPECT_EQ(mine[i].get("psnr"), theirs[i].get("psnr"));
  }
  // A verb goes on with it where it is; a row past the checkpoint, as a kill leaves one, does not stay.
  MetricsRow past = mine.back();
  past.step = kSteps + 1;
  past.set("loss", 77);
  MetricsLog::resume(dir_ / "driven/metrics.jsonl", kSteps).append(past);
  TrainRequest request{.out_dir = dir_ / "driven", .resume = true};
  EXPECT_EQ(
      run_training(load_run_config(dir_ / "driven/run.yaml", {"train.steps=25"}, registry_), registry_, request).step,
      25);
  for (const MetricsRow& row : read_metrics(dir_ / "driven/metrics.jsonl")) EXPECT_NE(row.get("loss"), 77) << row.step;
  EXPECT_HAS(error_of([&] { run.save(""); }), "somebody continued the run");
}

// Whoever drives it.
TEST_F(DrivenRun, EndsWhereItsFirstStepsTakeMoreMemoryThanIsAllowed) {
  const double most_gb = static_cast<double>(resident_bytes() + 64'000'000) / (1 << 30);  // enough to open it
  // A GPU's driver takes memory of its own.
  semfield::Run run(config({"runtime.memory_gb=" + std::to_string(most_gb), "runtime.device=cpu"}), registry_, {},
                    &nobody_);
  const std::vector<char> held(192'000'000, 1);  // whatever the steps themselves take
  EXPECT_ERROR(run.advance(1), "memory.training.size", "runtime.memory_gb");
  EXPECT_EQ(held[static_cast<std::size_t>(run.training().step())], 1);
}

TEST_F(DrivenRun, RoundsOfSelfTrainingNeedAFolderAndHaveTheBitsOfTheWholeRun) {
  const std::vector<std::string> set{"scene.labels.degrade=[{type: propagation}]", "train.self_training.at=[0.5]",
                                     "train.self_training.confidence=0.3", "train.ray_source=label_balanced"};
  EXPECT_HAS(error_of([&] { semfield::Run(config(set), registry_, {}, &nobody_); }), "train.self_training");
  const std::uint32_t bits = whole_run(set);
  semfield::Run run(config(set), registry_, {dir_ / "driven", false, {}}, &nobody_);
  drive(run, 3);
  // A stop before the round leaves it due.
  while (run.training().step() < 10) run.advance(10 - run.training().step());
  nobody_.stops = true;
  EXPECT_TRUE(run.advance(5).empty());
  nobody_.stops = false;
  EXPECT_EQ(run.training().step(), 10);
  drive(run, kSteps);
  run.save("");
  EXPECT_EQ(checkpoint_fingerprint(dir_ / "driven", kSteps), bits);
  EXPECT_EQ(check_label_counts(read_text_file(dir_ / "driven/labels.json"), "labels.json").size(), 1U);
}

// What may happen between steps is the driver's to say: who waits for a disk writes rows and checkpoints on request.
TEST_F(DrivenRun, ADriverSaysWhatHappensBetweenSteps) {
  const auto advanced = [&](const std::string& folder, Driver driver) {
    semfield::Run run(config({"report.checkpoint_every_s=1e-9", "report.eval_every_s=1e-9"}), registry_,
                      {.out_dir = dir_ / folder, .driver = driver}, &nobody_);
    while (run.training().step() < kSteps) run.advance(kSteps);
    EXPECT_EQ(run.saved(), driver == Driver::command);
    const std::vector<MetricsRow> before = read_metrics(dir_ / folder + "/metrics.jsonl");
    run.save();
    return std::pair(before, read_metrics(dir_ / folder + "/metrics.jsonl"));
  };
  const auto is_eval = [](const MetricsRow& row) { return row.kind == "eval"; };
  const auto [waiting, saved] = advanced("waits", Driver::page);
  EXPECT_TRUE(waiting.empty());
  EXPECT_FALSE(saved.empty());
  EXPECT_FALSE(fs::exists(dir_ / "waits/labels.json"));
  EXPECT_EQ(std::ranges::count_if(saved, is_eval), 0);
  const auto [scored, ended] = advanced("scores", Driver::command);
  EXPECT_EQ(ended.size(), scored.size());
  EXPECT_GT(std::ranges::count_if(scored, is_eval), 0);
  EXPECT_EQ(checkpoint_fingerprint(dir_ / "scores", kSteps), checkpoint_fingerprint(dir_ / "waits", kSteps));
  EXPECT_EQ(std::ssize(scored) - std::ranges::count_if(scored, is_eval), std::ssize(saved));
}

TEST_F(DrivenRun, ClicksAreInTheFolderBeforeTheyCount) {
  LabelEvent click{.id = "c1", .points = {{5.5, 5.5}}, .class_name = "lamp"};
  LabelEvent lamp{.id = "c0", .kind = LabelEventKind::add_class};
  lamp.class_name = "lamp";
  semfield::Run bare(config(), registry_, {}, &nobody_);
  EXPECT_HAS(error_of([&] { bare.apply(lamp); }), "no file of clicks");
  const std::vector<std::string> room{"scene.labels.class_room=12"};
  std::uint32_t bits = 0;
  {
    semfield::Run run(config(room), registry_, {dir_ / "a", false, {}}, &nobody_);
    drive(run, 4);
    const FrameInfo& frame = run.session().scene.info.frames[run.session().drawn_frames().front()];
    click.frame = frame.name;
    click.width_px = frame.camera.width_px;
    click.height_px = frame.camera.height_px;
    EXPECT_TRUE(run.apply(lamp));
    EXPECT_TRUE(run.apply(click));
    EXPECT_FALSE(run.apply(click));
    EXPECT_EQ(std::ranges::count(read_text_file(dir_ / "a/clicks.jsonl"), '\n'), 2);
    EXPECT_HAS(read_text_file(dir_ / "a/classes.yaml"), "lamp");
    LabelEvent wrong = click;
    wrong.id = "c2";
    wrong.class_name = "lampe";
    EXPECT_NE(error_of([&] { run.apply(wrong); }), "");
    EXPECT_EQ(run.annotations()->marks().size(), 1U);
    EXPECT_EQ(std::ranges::count(read_text_file(dir_ / "a/clicks.jsonl"), '\n'), 2);
    drive(run, 8);
    run.save("");
    EXPECT_ERROR(run.save(dir_ / "b"), "run.folder.own", "cannot be saved in");
    EXPECT_FALSE(fs::exists(dir_ / "b"));
    drive(run, 12);
    bits = fingerprint(run.session().pipeline->store());
  }
  semfield::Run again(load_run_config(dir_ / "a/run.yaml", {}, registry_), registry_, {dir_ / "a", true, {}}, &nobody_);
  EXPECT_EQ(again.annotations()->marks().size(), 1U);
  drive(again, 12);
  EXPECT_EQ(fingerprint(again.session().pipeline->store()), bits);
}

// Self-training: when rounds come, what they label, and that a run killed around one ends in the same bits.

// Clicks in the analytic room, saved after every step, labelled by the field at steps 30 and 45 of 60.
constexpr const char* kSettings[] = {"scene.labels.degrade=[{type: propagation}]", "train.self_training.at=[0.5, 0.75]",
                                     "train.self_training.confidence=0.4", "train.ray_source=label_balanced",
                                     "semantics.weight=0.5"};
constexpr int kSelfTrainingSteps = 60;
constexpr const char* kFirstRound = "/self_labels/round_00000030.safetensors";
constexpr const char* kSecondRound = "/self_labels/round_00000045.safetensors";

RunConfig config_in(const TempDir& dir, std::vector<std::string> more = {}) {
  std::vector<std::string> set(std::begin(kSettings), std::end(kSettings));
  set.insert(set.end(), more.begin(), more.end());
  return load_run_config(dir / "config.yaml", set, all_plugins());
}

TrainOutcome train(const TempDir& dir, const std::string& out, RunListener* listener = nullptr,
                   const std::vector<std::string>& more = {}) {
  TrainRequest request{.out_dir = dir / out};
  return run_training(config_in(dir, more), all_plugins(), request, listener);
}

TrainOutcome resume(const std::string& folder) {
  TrainRequest request{.out_dir = folder, .resume = true};
  return run_training(load_run_config(folder + "/run.yaml", {"report.checkpoint_every_s=0"}, all_plugins()),
                      all_plugins(), request, {});
}

void copy_run(const std::string& from, const std::string& to) {
  fs::copy(from, to, fs::copy_options::recursive);
  fs::remove(to + "/.lock");
}

std::vector<SelfTrainingRound> rounds_of(const std::string& run) {
  return check_label_counts(read_text_file(run + "/labels.json"), "labels.json");
}

TEST(SelfTraining, RoundsComeAtSharesOfTheSteps) {
  RunConfig config;
  const auto rounds = [&](std::int64_t steps) {
    config.train.steps = steps;
    return round_steps(config);
  };
  EXPECT_TRUE(rounds(1000).empty());
  config.self_training.at = {0.001, 0.5, 0.5004, 0.75};
  EXPECT_EQ(rounds(1000), (std::vector<std::int64_t>{1, 500, 750}));
  EXPECT_EQ(rounds(4), (std::vector<std::int64_t>{1, 2, 3}));
  EXPECT_TRUE(rounds(0).empty()) << "the number of steps is not settled";
  config.schedule.hold_steps = 100;
  EXPECT_EQ(rounds(1000), (std::vector<std::int64_t>{100, 500, 750})) << "before step 100 nobody knew it";
  const TempDir dir;
  write_packed_config(dir, kSelfTrainingSteps, 0);
  EXPECT_HAS(error_of([&] { (void)config_in(dir, {"train.self_training.at=[0.5, 0.5]"}); }),
             "train.self_training.at: the shares do not ascend");
}

TEST(SelfTraining, ARoundLabelsWhatTheFieldIsSureOfAndNothingElse) {
  const TempDir dir;
  write_packed_config(dir, kSelfTrainingSteps, 0);
  Diagnostics diagnostics;
  Session s = open_session(config_in(dir), all_plugins(), {}, diagnostics);
  Trainer trainer(s);
  for (int i = 0; i < 30; ++i) trainer.advance();
  SelfTraining self(s, trainer.rays(), dir / "labels");
  EXPECT_FALSE(self.due(29));
  ASSERT_TRUE(self.due(30));
  EXPECT_EQ(self.steps_until_due(28, 20), 2);
  EXPECT_EQ(self.steps_until_due(30, 20), 15);
  EXPECT_EQ(self.steps_until_due(45, 20), 20);
  EXPECT_FALSE(self.make_round(30, {{}, [] { return true; }})) << "stopped before the first frame";
  EXPECT_TRUE(self.due(30));
  ASSERT_TRUE(self.make_round(30, {}));
  EXPECT_FALSE(self.due(30));

  // What the file holds is what the field says where nobody else does.
  const TensorFile file = TensorFile::read(dir / "labels/round_00000030.safetensors");
  const std::vector<int> frames = s.drawn_frames();
  ASSERT_EQ(file.tensors().size(), frames.size());
  SelfTrainingRound round{.step = 30};
  std::int64_t unsure = 0;
  for (std::size_t k = 0; k < frames.size(); ++k) {
    const auto f = static_cast<std::size_t>(frames[k]);
    const FrameInfo& info = s.scene.info.frames[f];
    const RenderedFrame seen = render_frame(*s.pipeline, {info.camera, info.world_from_camera, s.plan.undistortion},
                                            s.limits, s.plan.class_of_logit);
    const std::span<const std::byte> given = file.find("00000" + std::to_string(k) + "/" + info.name)->bytes;
    ASSERT_EQ(given.size(), seen.label.size());
    for (std::size_t p = 0; p < given.size(); ++p) {
      const bool own = s.labels.frames[f][p] != kVoid;
      const bool sure = seen.confidence[p] >= 0.4F && seen.opacity[p] >= 0.5F;
      ASSERT_EQ(std::to_integer<int>(given[p]), !own && sure ? seen.label[p] : 255) << info.name << ", pixel " << p;
      round.unlabelled_px += own ? 0 : 1;
      unsure += sure ? 0 : 1;
      if (own || !sure) continue;
      ++round.added_px;
      ++round.scored_px;
      round.right_px += seen.label[p] == s.scene.frames[f].label[p] ? 1 : 0;
    }
  }
  EXPECT_GT(unsure, 0);
  EXPECT_GT(round.added_px, 1000);
  ASSERT_EQ(self.rounds().size(), 1u);
  EXPECT_EQ(self.rounds()[0], round);
  EXPECT_EQ(parse_rounds(file.metadata().at("rounds"), "file"), self.rounds());
  EXPECT_HAS(round.text(), "self-training at step 30: " + std::to_string(round.added_px) + " pixels labelled, ");

  // The rays of the next steps carry them.
  BatchBuffers batch;
  trainer.rays().fill(30, batch);
  const std::unique_ptr<RaySource> plain = s.make_ray_source();
  BatchBuffers before;
  plain->fill(30, before);
  const auto labelled = [](const BatchBuffers& b) {
    return std::count_if(b.label.begin(), b.label.end(), [](std::int16_t c) { return c != kVoid; });
  };
  EXPECT_GT(labelled(batch), labelled(before));
}

TEST(SelfTraining, KilledAroundARoundARunEndsInTheSameBits) {
  const TempDir dir;
  write_packed_config(dir, kSelfTrainingSteps, 1e-6);
  // Copies of the folder as a kill at these moments would leave it.
  int notes = 0;
  HookListener hooks;
  hooks.on_scoring = [&](const ScoreProgress& p) {
    if (std::string(p.split) == "train" && p.done > 4 && !fs::exists(dir / "within"))
      copy_run(dir / "whole", dir / "within");
  };
  hooks.on_note = [&](const std::string& text) {
    if (text.rfind("self-training at step", 0) == 0)
      copy_run(dir / "whole", dir / (++notes == 1 ? "after_first" : "after_second"));
  };
  bool copied = false;
  hooks.on_save_request = [&] {
    if (notes == 1 && !copied) copy_run(dir / "whole", dir / "step_after");
    copied = copied || notes == 1;
    return false;
  };
  hooks.reports = true;
  train(dir, "whole", &hooks);
  ASSERT_EQ(notes, 2);
  const std::uint32_t bits = checkpoint_fingerprint(dir / "whole", kSelfTrainingSteps);
  EXPECT_TRUE(fs::exists((dir / "after_first") + kFirstRound));
  EXPECT_FALSE(fs::exists((dir / "within") + kFirstRound));
  const std::pair<const char*, int> kills[] = {
      {"within", 30}, {"after_first", 30}, {"step_after", 31}, {"after_second", 45}};
  for (const auto& [killed, step] : kills) {
    EXPECT_EQ(read_text_file((dir / killed) + "/checkpoints/latest"), CheckpointStore::file_name(step) + "\n");
    resume(dir / killed);
    EXPECT_EQ(checkpoint_fingerprint(dir / killed, kSelfTrainingSteps), bits) << killed;
    EXPECT_EQ(rounds_of(dir / killed), rounds_of(dir / "whole")) << killed;
    for (const char* file : {kFirstRound, kSecondRound})
      EXPECT_TRUE(read_text_file((dir / killed) + file) == read_text_file((dir / "whole") + file)) << killed << file;
  }
  EXPECT_EQ(rounds_of(dir / "whole").size(), 2u);
  EXPECT_GT(rounds_of(dir / "whole")[1].added_px, 0);
  EXPECT_HAS(read_text_file(dir / "whole/report.html"), "self-training at step 45: ");

  // It is the rounds that make the difference, and threads do not.
  train(dir, "without", {}, {"train.self_training.at=[]"});
  EXPECT_NE(checkpoint_fingerprint(dir / "without", kSelfTrainingSteps), bits);
  EXPECT_FALSE(fs::exists(dir / "without/self_labels"));
  train(dir, "threads", {}, {"runtime.threads=3"});
  EXPECT_EQ(checkpoint_fingerprint(dir / "threads", kSelfTrainingSteps), bits);
}

TEST(SelfTraining, ARoundThatIsLostOrDamagedIsRefusedAndTheRemedyWorks) {
  const TempDir dir;
  write_packed_config(dir, kSelfTrainingSteps, 1e-6);
  train(dir, "whole", {}, {"report.keep_checkpoints=21"});
  const auto refusal = [&](const std::string& run) { return error_of([&] { resume(run); }); };
  copy_run(dir / "whole", dir / "lost");
  fs::remove((dir / "lost") + kSecondRound);
  EXPECT_HAS(refusal(dir / "lost"), "the checkpoint was trained on the labels in it");
  copy_run(dir / "whole", dir / "damaged");
  std::string bytes = read_text_file((dir / "damaged") + kSecondRound);
  bytes[bytes.size() - 40] = static_cast<char>(bytes[bytes.size() - 40] ^ 1);
  write_file_atomic((dir / "damaged") + kSecondRound, bytes);
  EXPECT_HAS(refusal(dir / "damaged"), "round_00000045");
  // Sound files of labels that are no class, and of a frame less.
  const TensorFile second = TensorFile::read((dir / "whole") + kSecondRound);
  const auto rewritten = [&](const std::string& run, const std::function<void(std::vector<TensorRef>&)>& change) {
    copy_run(dir / "whole", dir / run);
    std::vector<TensorRef> tensors = second.tensors();
    change(tensors);
    write_safetensors((dir / run) + kSecondRound, tensors, second.metadata());
    return refusal(dir / run);
  };
  const std::vector<std::byte> no_class(48 * 36, std::byte{77});
  EXPECT_HAS(rewritten("no_class", [&](auto& t) { t[2].bytes = no_class; }), "label 77 is not a class; there are 5");
  EXPECT_HAS(rewritten("fewer", [](auto& t) { t.pop_back(); }), "is missing, or of another size");
  // A sound file of other labels: that of the first round under the second's name.
  copy_run(dir / "whole", dir / "other");
  write_file_atomic((dir / "other") + kSecondRound, read_text_file((dir / "other") + kFirstRound));
  EXPECT_HAS(refusal(dir / "other"), "not those that the checkpoint was trained on",
             "move the later ones out of the folder checkpoints");

  // Without the checkpoints of later steps the round is made again, and what is left of the old course goes.
  for (int step = 41; step <= kSelfTrainingSteps; ++step)
    fs::remove(dir / "other/checkpoints/" + CheckpointStore::file_name(step));
  const std::string stale = dir / "other/self_labels/round_00000050.safetensors";  // of other train.steps
  write_file_atomic(stale, read_text_file((dir / "other") + kFirstRound));
  resume(dir / "other");
  EXPECT_FALSE(fs::exists(stale));
  EXPECT_EQ(checkpoint_fingerprint(dir / "other", kSelfTrainingSteps),
            checkpoint_fingerprint(dir / "whole", kSelfTrainingSteps));
  EXPECT_TRUE(read_text_file((dir / "other") + kSecondRound) == read_text_file((dir / "whole") + kSecondRound));
}

TEST(SelfTraining, WithoutLabelsNothingIsDueAndThatIsSaid) {
  const TempDir dir;
  write_packed_config(dir, 8, 0);
  HookListener hooks;
  train(dir, "run", &hooks, {"scene.labels.frames=none", "scene.labels.degrade=[]", "train.ray_source=all_images"});
  EXPECT_HAS(hooks.notes, "there are no labels to begin with");
  EXPECT_FALSE(fs::exists(dir / "run/self_labels"));
}

}  // namespace
}  // namespace semfield
