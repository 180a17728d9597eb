// Self-training: when rounds come, what they label, and that a run killed around one ends in the same bits.
#include "session/self_training.h"

#include "run/run_folder.h"
#include "run/run_loop.h"
#include "session/trainer.h"
#include "system/files.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using namespace testing_train;

// Clicks in the analytic room, saved after every step, labelled by the field at steps 30 and 45 of 60.
constexpr const char* kSettings[] = {"scene.labels.degrade=[{type: propagation}]", "train.self_training.at=[0.5, 0.75]",
                                     "train.self_training.confidence=0.4", "train.ray_source=label_balanced",
                                     "semantics.weight=0.5"};
constexpr int kSteps = 60;
constexpr const char* kFirstRound = "/self_labels/round_00000030.safetensors";
constexpr const char* kSecondRound = "/self_labels/round_00000045.safetensors";

RunConfig config_in(const TempDir& dir, Registry& registry, std::vector<std::string> more = {}) {
  std::vector<std::string> set(std::begin(kSettings), std::end(kSettings));
  set.insert(set.end(), more.begin(), more.end());
  return load_run_config(dir / "config.yaml", set, registry);
}

TrainOutcome train(const TempDir& dir, Registry& registry, const std::string& out, RunListener* listener = nullptr,
                   const std::vector<std::string>& more = {}) {
  TrainRequest request{.out_dir = dir / out};
  return run_training(config_in(dir, registry, more), registry, request, listener);
}

TrainOutcome resume(const std::string& folder, Registry& registry) {
  TrainRequest request{.out_dir = folder, .resume = true};
  return run_training(load_run_config(folder + "/run.yaml", {"report.checkpoint_every_s=0"}, registry), registry,
                      request, {});
}

void copy_run(const std::string& from, const std::string& to) {
  fs::copy(from, to, fs::copy_options::recursive);
  fs::remove(to + "/.lock");
}

std::vector<SelfTrainingRound> rounds_of(const std::string& run) {
  return parse_label_counts(read_text_file(run + "/labels.json"), "labels.json").rounds;
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
  Registry registry = make_registry();
  const TempDir dir;
  write_packed_config(dir, kSteps, 0);
  EXPECT_HAS(error_of([&] { (void)config_in(dir, registry, {"train.self_training.at=[0.5, 0.5]"}); }),
             "train.self_training.at: the shares do not ascend");
}

TEST(SelfTraining, ARoundLabelsWhatTheFieldIsSureOfAndNothingElse) {
  Registry registry = make_registry();
  const TempDir dir;
  write_packed_config(dir, kSteps, 0);
  Diagnostics diagnostics;
  const Session s = open_session(config_in(dir, registry), registry, {}, diagnostics);
  const auto rays = s.make_ray_source();
  Trainer trainer(*s.pipeline, *rays, s.config.adam, s.config.schedule);
  for (int i = 0; i < 30; ++i) trainer.advance();
  SelfTraining self(s, *rays, dir / "labels");
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
  rays->fill(30, batch);
  const std::unique_ptr<RaySource> plain = s.make_ray_source();
  BatchBuffers before;
  plain->fill(30, before);
  const auto labelled = [](const BatchBuffers& b) {
    return std::count_if(b.label.begin(), b.label.end(), [](std::int16_t c) { return c != kVoid; });
  };
  EXPECT_GT(labelled(batch), labelled(before));
}

TEST(SelfTraining, KilledAroundARoundARunEndsInTheSameBits) {
  Registry registry = make_registry();
  const TempDir dir;
  write_packed_config(dir, kSteps, 1e-6);
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
  train(dir, registry, "whole", &hooks);
  ASSERT_EQ(notes, 2);
  const std::uint32_t bits = checkpoint_fingerprint(dir / "whole", kSteps);
  EXPECT_TRUE(fs::exists((dir / "after_first") + kFirstRound));
  EXPECT_FALSE(fs::exists((dir / "within") + kFirstRound));
  const std::pair<const char*, int> kills[] = {
      {"within", 30}, {"after_first", 30}, {"step_after", 31}, {"after_second", 45}};
  for (const auto& [killed, step] : kills) {
    EXPECT_EQ(read_text_file((dir / killed) + "/checkpoints/latest"), CheckpointStore::file_name(step) + "\n");
    resume(dir / killed, registry);
    EXPECT_EQ(checkpoint_fingerprint(dir / killed, kSteps), bits) << killed;
    EXPECT_EQ(rounds_of(dir / killed), rounds_of(dir / "whole")) << killed;
    for (const char* file : {kFirstRound, kSecondRound})
      EXPECT_TRUE(read_text_file((dir / killed) + file) == read_text_file((dir / "whole") + file)) << killed << file;
  }
  EXPECT_EQ(rounds_of(dir / "whole").size(), 2u);
  EXPECT_GT(rounds_of(dir / "whole")[1].added_px, 0);
  EXPECT_HAS(read_text_file(dir / "whole/report.html"), "self-training at step 45: ");

  // It is the rounds that make the difference, and threads do not.
  train(dir, registry, "without", {}, {"train.self_training.at=[]"});
  EXPECT_NE(checkpoint_fingerprint(dir / "without", kSteps), bits);
  EXPECT_FALSE(fs::exists(dir / "without/self_labels"));
  train(dir, registry, "threads", {}, {"runtime.threads=3"});
  EXPECT_EQ(checkpoint_fingerprint(dir / "threads", kSteps), bits);
}

TEST(SelfTraining, AStopWithinARoundIsAnsweredAndTheRoundMadeAfterwards) {
  Registry registry = make_registry();
  const TempDir dir;
  write_packed_config(dir, kSteps, 0);
  train(dir, registry, "whole");
  bool rendering = false;
  HookListener hooks;
  hooks.on_scoring = [&](const ScoreProgress& p) { rendering = rendering || p.done > 2; };
  hooks.on_stop_signal = [&] { return rendering ? 15 : 0; };
  const TrainOutcome stopped = train(dir, registry, "run", &hooks);
  EXPECT_EQ(stopped.signal, 15);
  EXPECT_EQ(stopped.step, 30);
  EXPECT_FALSE(fs::exists((dir / "run") + kFirstRound));
  resume(dir / "run", registry);
  EXPECT_EQ(checkpoint_fingerprint(dir / "run", kSteps), checkpoint_fingerprint(dir / "whole", kSteps));
}

TEST(SelfTraining, ARoundThatIsLostOrDamagedIsRefusedAndTheRemedyWorks) {
  Registry registry = make_registry();
  const TempDir dir;
  write_packed_config(dir, kSteps, 1e-6);
  train(dir, registry, "whole", {}, {"report.keep_checkpoints=21"});
  const auto refusal = [&](const std::string& run) { return error_of([&] { resume(run, registry); }); };
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
  for (int step = 41; step <= kSteps; ++step) fs::remove(dir / "other/checkpoints/" + CheckpointStore::file_name(step));
  const std::string stale = dir / "other/self_labels/round_00000050.safetensors";  // of other train.steps
  write_file_atomic(stale, read_text_file((dir / "other") + kFirstRound));
  resume(dir / "other", registry);
  EXPECT_FALSE(fs::exists(stale));
  EXPECT_EQ(checkpoint_fingerprint(dir / "other", kSteps), checkpoint_fingerprint(dir / "whole", kSteps));
  EXPECT_TRUE(read_text_file((dir / "other") + kSecondRound) == read_text_file((dir / "whole") + kSecondRound));
}

TEST(SelfTraining, MemoryIsPlanned) {
  Registry registry = make_registry();
  const TempDir dir;
  write_packed_config(dir, kSteps, 0);
  Diagnostics diagnostics;
  const auto plan_of = [&](const std::vector<std::string>& more) {
    return open_session(config_in(dir, registry, more), registry, {}, diagnostics).memory;
  };
  const auto bytes_of = [](const std::vector<MemoryItem>& items, const std::string& name) {
    std::size_t bytes = 0;
    for (const MemoryItem& item : items) bytes += item.name == name ? item.bytes : 0;
    return bytes;
  };
  const MemoryPlan with = plan_of({}), without = plan_of({"train.self_training.at=[]"});
  EXPECT_EQ(bytes_of(with.held, "labels of self-training"), 9u * 48 * 36);
  EXPECT_GT(bytes_of(with.turns, "round of self-training"), 4u * 9 * 48 * 36);
  EXPECT_EQ(bytes_of(without.held, "labels of self-training") + bytes_of(without.turns, "round of self-training"), 0u);
  EXPECT_EQ(self_label_bytes(10, 254), 10u);
  EXPECT_EQ(self_label_bytes(10, 255), 20u);
}

TEST(SelfTraining, WithoutLabelsNothingIsDueAndThatIsSaid) {
  Registry registry = make_registry();
  const TempDir dir;
  write_packed_config(dir, 8, 0);
  std::string notes;
  HookListener hooks;
  hooks.on_note = [&](const std::string& text) { notes += text + "\n"; };
  train(dir, registry, "run", &hooks,
        {"scene.labels.frames=none", "scene.labels.degrade=[]", "train.ray_source=all_images"});
  EXPECT_HAS(notes, "there are no labels to begin with");
  EXPECT_FALSE(fs::exists(dir / "run/self_labels"));
}

}  // namespace
}  // namespace semfield
