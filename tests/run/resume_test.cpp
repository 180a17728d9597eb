// Stopping, saving, loading and going on gives the bits of the run that was never stopped; other checkpoints are
// refused.
#include <fstream>

#include "compute/parallel.h"
#include "eval/final_eval.h"
#include "run/metrics_log.h"
#include "run/run_folder.h"
#include "run/run_loop.h"
#include "run/run_scores.h"
#include "session/trainer.h"
#include "system/files.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

struct Opened {
  Session session;
  std::unique_ptr<RaySource> rays;
  std::unique_ptr<Trainer> trainer;
};

Opened open(const std::string& yaml, Registry& registry) {
  Opened o{open_text(yaml, registry), nullptr, nullptr};
  o.rays = o.session.make_ray_source();
  o.trainer = std::make_unique<Trainer>(*o.session.pipeline, *o.rays, o.session.config.adam, o.session.config.schedule);
  return o;
}

void expect_resume_is_exact(const std::string& yaml, int first, int second) {
  Registry registry = make_registry();
  Opened whole = open(yaml, registry);
  for (int i = 0; i < first + second; ++i) whole.trainer->advance();

  const TempDir dir;
  Opened before = open(yaml, registry);
  for (int i = 0; i < first; ++i) before.trainer->advance();
  CheckpointStore store(dir.path());
  store.save(first, before.trainer->state(), {{"train_s", "1"}});

  Opened after = open(yaml, registry);
  after.trainer->advance();  // a used trainer must not matter
  Diagnostics diagnostics;
  auto found = store.find_latest(diagnostics);
  ASSERT_TRUE(found.has_value());
  set_thread_count(1);  // another thread count too
  after.trainer->load(found->file, found->step);
  EXPECT_EQ(after.trainer->step(), first);
  for (int i = 0; i < second; ++i) after.trainer->advance();
  set_thread_count(0);
  EXPECT_EQ(fingerprint(whole.session.pipeline->store()), fingerprint(after.session.pipeline->store()));
}

TEST(Resume, HashRunIsBitExact) { expect_resume_is_exact(hash_config(), 45, 30); }
TEST(Resume, TwoPassRunIsBitExact) { expect_resume_is_exact(two_pass_config(), 4, 4); }

TEST(Resume, AnotherNetworksCheckpointIsRefusedAndNothingChanges) {
  Registry registry = make_registry();
  const TempDir dir;
  Opened wide = open(hash_config(), registry);
  CheckpointStore store(dir.path());
  store.save(0, wide.trainer->state(), {{"train_s", "0"}});
  std::string narrow_yaml = hash_config();
  narrow_yaml.replace(narrow_yaml.find("color_width: 32"), 15, "color_width: 16");
  Opened narrow = open(narrow_yaml, registry);
  const std::uint32_t before = fingerprint(narrow.session.pipeline->store());
  Diagnostics diagnostics;
  auto found = store.find_latest(diagnostics);
  ASSERT_TRUE(found.has_value());
  EXPECT_HAS(error_of(ErrorKind::data, [&] { narrow.trainer->load(found->file, 0); }), "another network's checkpoint");
  EXPECT_EQ(before, fingerprint(narrow.session.pipeline->store()));
}

RunConfig config_of(const std::string& yaml, Registry& registry) {
  Diagnostics diagnostics;
  RunConfig config = read_run_config(parse_config_text(yaml, "test.yaml"), registry, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::config, "");
  return config;
}

TEST(TrainRun, WritesAWholeRunFolderAndEvaluatesFromIt) {
  Registry registry = make_registry();
  const TempDir dir;
  TrainRequest request{.out_dir = dir / "run"};
  HookListener hooks;
  hooks.reports = true;
  const TrainOutcome outcome = run_training(config_of(hash_config("report: {eval_every_s: 0, strips: 2}\n"), registry),
                                            registry, request, &hooks);
  EXPECT_EQ(outcome.step, 200);
  for (const char* file :
       {"run.yaml", "metrics.jsonl", "environment.json", "left_out.json", "classes.yaml", "report.html"}) {
    EXPECT_TRUE(std::filesystem::exists(request.out_dir + "/" + file)) << file;
  }
  EXPECT_HAS(read_text_file(request.out_dir + "/environment.json"), "\"started\": \"20");
  double psnr = 0;
  for (const auto& [name, value] : outcome.values) {
    if (name == "psnr") psnr = *value;
  }
  {
    Session untrained = open_text(hash_config(), registry);
    const SplitScore start = evaluate(*untrained.pipeline, untrained.eval_job(untrained.scene.frames_of(Split::test)),
                                      untrained.limits, untrained.plan.class_of_logit);
    EXPECT_GT(psnr, *start.color.psnr_db() + 4) << "200 steps teach the field the room's colours";
  }

  // Evaluating the folder gives the run's own last figures, and training from run.yaml repeats the run bit for bit.
  Diagnostics diagnostics;
  OpenedRun opened = open_run(request.out_dir, {}, registry, diagnostics);
  const SplitScore score =
      evaluate(*opened.session.pipeline, opened.session.eval_job(opened.session.scene.frames_of(Split::test)),
               opened.session.limits, opened.session.plan.class_of_logit);
  EXPECT_EQ(*score.color.psnr_db(), psnr);
  // What the run folder tells of its last evaluation is that evaluation.
  const FinalEval stored = parse_final_eval(read_text_file(request.out_dir + "/final_eval.json"), "final_eval.json");
  EXPECT_EQ(stored.step, 200);
  EXPECT_EQ(stored.confusion, final_eval(score, opened.session.scene.info.classes, "test").confusion);
  EXPECT_NEAR(*stored.ece(), *score.calibration.ece(), 1e-12);
  EXPECT_EQ(stored.entropy_auroc->value, score.entropy.detects_wrong()->value);
  ASSERT_EQ(stored.frames.size(), score.frames.size());
  EXPECT_EQ(stored.frames[0].psnr_db, score.frames[0].psnr_db);
  const LabelCounts labels = parse_label_counts(read_text_file(request.out_dir + "/labels.json"), "labels.json");
  EXPECT_EQ(labels.labelled_frames, opened.session.manifest.labelled_frames);
  EXPECT_GT(labels.labelled_px, 0);
  ReportFrames none({}, 0);
  for (const FrameScore& row : score.frames) none.add(row, {});
  EXPECT_TRUE(none.strips().empty() && none.worst().empty());
  ReportFrames frames({score.frames[0].frame}, 2);
  for (const FrameScore& row : score.frames) frames.add(row, {});
  EXPECT_EQ(frames.strips().size(), 1u);
  ASSERT_EQ(frames.worst().size(), std::min<std::size_t>(2, score.frames.size()));
  for (const FrameScore& row : score.frames) EXPECT_FALSE(row.worse_than(frames.worst()[0].first)) << row.name;
  // Rendering reads no pixel: what training knew of the scene stands in the checkpoint.
  OpenedRun blind = open_run(request.out_dir, {}, registry, diagnostics, OpenFor::rendering);
  const int frame = opened.session.scene.frames_of(Split::test).front();
  EXPECT_TRUE(blind.session.scene.frames[frame].rgb.empty());
  const auto render = [frame](Session& s) {
    const FrameInfo& info = s.scene.info.frames[frame];
    return render_frame(*s.pipeline, {info.camera, info.world_from_camera, s.plan.undistortion}, s.limits,
                        s.plan.class_of_logit);
  };
  const RenderedFrame seen = render(opened.session), unseen = render(blind.session);
  EXPECT_EQ(seen.rgb, unseen.rgb);
  EXPECT_EQ(seen.label, unseen.label);
  EXPECT_EQ(seen.depth_m, unseen.depth_m);
  EXPECT_EQ(seen.entropy, unseen.entropy);
  request.out_dir = dir / "again";
  EXPECT_EQ(run_training(load_run_config(dir / "run/run.yaml", {}, registry), registry, request, {}).report_path, "");
  EXPECT_FALSE(std::filesystem::exists(dir / "again/report.html")) << "nobody asked for one";
  CheckpointStore first(dir / "run/checkpoints"), second(dir / "again/checkpoints");
  auto a = first.find_latest(diagnostics), b = second.find_latest(diagnostics);
  ASSERT_TRUE(a && b);
  for (const TensorRef& t : a->file.tensors()) {
    const TensorRef* other = b->file.find(t.name);
    ASSERT_NE(other, nullptr) << t.name;
    EXPECT_TRUE(std::equal(t.bytes.begin(), t.bytes.end(), other->bytes.begin())) << t.name;
  }
}

TEST(TrainRun, AStopSignalSavesAndResumeGoesOn) {
  Registry registry = make_registry();
  const TempDir dir;
  TrainRequest request{.out_dir = dir / "run"};
  int asked = 0;
  HookListener hooks;
  hooks.on_stop_signal = [&] { return ++asked >= 30 ? 15 : 0; };
  const std::string yaml = hash_config("report: {eval_every_s: 0}\n");
  const TrainOutcome stopped = run_training(config_of(yaml, registry), registry, request, &hooks);
  EXPECT_EQ(stopped.signal, 15);
  EXPECT_EQ(stopped.step, 30);
  request.resume = true;
  const TrainOutcome done =
      run_training(load_run_config(request.out_dir + "/run.yaml", {}, registry), registry, request, {});
  EXPECT_EQ(done.step, 200);
  std::int64_t last = 0;
  for (const MetricsRow& row : read_metrics(request.out_dir + "/metrics.jsonl")) {
    if (row.kind != "train") continue;
    EXPECT_GT(row.step, last) << "rows go on without a gap or repeat";
    last = row.step;
  }
  EXPECT_EQ(last, 200);
}

// A class that had no label when the run began has some when it goes on: from the file of clicks, or from other labels
// where every class has a logit.
TEST(TrainRun, LabelsOfAnotherClassMayComeWhereEveryClassHasALogit) {
  Registry registry = make_registry();
  const TempDir dir;
  const std::string log = dir / "clicks.jsonl";
  const auto train = [&](const std::string& yaml, std::int64_t steps, bool resume) {
    TrainRequest request{.out_dir = dir / "run", .resume = resume};
    RunConfig config = config_of(yaml, registry);
    if (resume) config = load_run_config(request.out_dir + "/run.yaml", {}, registry);
    config.train.steps = steps;
    std::string warnings;
    HookListener hooks;
    hooks.on_note = [&](const std::string& text) { warnings += text + "\n"; };
    EXPECT_EQ(run_training(std::move(config), registry, request, &hooks).step, steps);
    EXPECT_LACKS(warnings, "the labels are not as they were");
  };
  std::string yaml = hash_config("report: {eval_every_s: 0}\n");
  yaml.replace(yaml.find("analytic_room}"), 14,
               "analytic_room, labels: {frames: none, class_room: 8, clicks: " + log + "}}");
  train(yaml, 4, false);
  EXPECT_LACKS(read_text_file(dir / "run/classes.yaml"), "sofa");
  const Session session = open_text(hash_config(), registry);
  const std::string frame = session.scene.info.frames[session.drawn_frames().front()].name;
  const std::string click = R"("type":"click","frame":")" + frame + R"(","size":[48,36],"points":[[9,9]],"radius":3,)";
  write_file_atomic(log, R"({"id":"1","type":"class","name":"sofa"})"
                         "\n"
                         R"({"id":"2",)" +
                             click + "\"class\":\"sofa\"}\n" + R"({"id":"3",)" + click + "\"class\":\"wall\"}\n");
  train(yaml, 8, true);
  EXPECT_HAS(read_text_file(dir / "run/classes.yaml"), "sofa");
  write_file_atomic(log, read_text_file(log) + R"({"id":"4","type":"rename","class":"sofa","name":"couch"})" + "\n");
  Diagnostics diagnostics;
  const OpenedRun opened = open_run(dir / "run", {}, registry, diagnostics, OpenFor::evaluation);
  EXPECT_EQ(opened.step, 8);
  EXPECT_EQ(opened.session.plan.class_of_logit.size(), 8u);
  EXPECT_HAS(opened.session.scene.info.classes.to_yaml(), "couch");
}

TEST(TrainRun, LabelsOfAnotherClassAreRefusedWhereItHasNoLogit) {
  Registry registry = make_registry();
  const TempDir dir;
  for (const bool kept : {false, true}) {
    TrainRequest request{.out_dir = dir / (kept ? "kept" : "run")};
    std::string yaml = hash_config("report: {eval_every_s: 0}\n");
    if (kept) yaml += "runtime: {keep: [absent_classes]}\n";
    const auto with = [&](const std::string& scene) {
      std::string out = yaml;
      return out.replace(out.find("analytic_room}"), 14, "analytic_room" + scene + "}");
    };
    RunConfig config = config_of(with(", absent_class: 3"), registry);
    config.train.steps = 3;
    (void)run_training(std::move(config), registry, request, {});
    // The same scene, whose labels hold the class now.
    const CheckpointFacts facts = read_checkpoint_facts(
        CheckpointStore(request.out_dir + "/checkpoints").find_latest(*std::make_unique<Diagnostics>())->file);
    Session now = open_text(with(""), registry);
    Diagnostics diagnostics;
    const std::string said =
        error_of([&] { compare_with_training(facts, scene_inputs(now.scene, now.labels), now, diagnostics); });
    if (kept) {
      EXPECT_EQ(said, "");
      EXPECT_EQ(diagnostics.all().size(), 1u) << "a warning: the labels are others";
    } else {
      EXPECT_HAS(said, "the network has one logit for each class with such pixels");
    }
  }
}

TEST(TrainRun, AFlippedBitIsFoundAndTheOlderCheckpointServes) {
  Registry registry = make_registry();
  const TempDir dir;
  Opened run = open(two_pass_config(), registry);
  CheckpointStore store(dir.path());
  store.save(0, run.trainer->state(), {{"train_s", "0"}});
  run.trainer->advance();
  const std::string newest = store.save(1, run.trainer->state(), {{"train_s", "0"}});
  {
    std::fstream file(newest, std::ios::in | std::ios::out | std::ios::binary);
    file.seekg(-100, std::ios::end);
    const int byte = file.get();
    file.seekp(-100, std::ios::end);
    file.put(static_cast<char>(byte ^ 16));
  }
  Diagnostics diagnostics;
  auto found = store.find_latest(diagnostics);
  ASSERT_TRUE(found.has_value());
  EXPECT_EQ(found->step, 0);
  ASSERT_FALSE(diagnostics.all().empty());
  EXPECT_HAS(diagnostics.all().front().text(), "step_00000001");
}

TEST(TrainRun, ARunFolderInUseIsRefused) {
  Registry registry = make_registry();
  const TempDir dir;
  TrainRequest request{.out_dir = dir / "run"};
  HookListener hooks;
  std::string refusal;
  hooks.on_stop_signal = [&] {
    TrainRequest second = request;
    second.resume = true;
    refusal = error_of(
        [&] { run_training(load_run_config(request.out_dir + "/run.yaml", {}, registry), registry, second, {}); });
    return 2;
  };
  run_training(config_of(hash_config("report: {eval_every_s: 0}\n"), registry), registry, request, &hooks);
  EXPECT_HAS(refusal, "in use");
}

}  // namespace
}  // namespace semfield
