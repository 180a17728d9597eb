// What is left out changes no bit of what is kept: pairs of runs, one with the component forced back in.

#include <cstring>
#include <nlohmann/json.hpp>

#include "config/settings/choices.h"
#include "datasets/obj_room/obj_room.h"
#include "execution/lane_executor.h"
#include "tests/session/train_testing.h"
#include "tests/threads.h"
#include "train/assembly.h"
#include "train/opened_run.h"
#include "train/run_folder.h"

namespace semfield {
namespace {

using namespace testing_train;

struct Trained : TestRun {
  Trained(const std::string& yaml, const std::vector<std::string>& keep, int steps)
      : TestRun(yaml, all_plugins(), keep) {
    trainer.train(steps);
  }
};

bool same_bits(const AlignedBuffer<float>& a, const AlignedBuffer<float>& b) {
  return a.size() == b.size() && std::memcmp(a.data(), b.data(), sizeof(float) * a.size()) == 0;
}

bool left_out(const Session& s, const std::string& component) {
  for (const LeftOut& row : s.plan.left_out) {
    EXPECT_FALSE(row.rule.empty() || row.evidence.empty() || row.saving.empty()) << row.component;
    if (row.component == component) return true;
  }
  return false;
}

// Every tensor that both runs have is bitwise the same.
void expect_shared_tensors_equal(Session& a, Session& b) {
  int shared = 0;
  for (const Tensor<float>& t : a.pipeline->store().all()) {
    const Tensor<float>* other = b.pipeline->store().find(t.name);
    if (other == nullptr || !t.learned()) continue;
    EXPECT_TRUE(same_bits(t.value, other->value) && same_bits(t.moment2, other->moment2)) << t.name;
    ++shared;
  }
  EXPECT_GT(shared, 8);
}

TEST(LeaveOut, WhatNoTensorNeedsIsLeftOutBitwise) {
  const std::tuple<const char*, std::string, int> cases[] = {
      {"unlabelled_rays", with_scene(hash_config(), "{type: analytic_room, labels: {frames: 2}}"), 40},
      {"undistortion", hash_config(), 20},
      {"semantics", with_scene(hash_config(), "{type: analytic_room, labels: {frames: none}}"), 40}};
  for (const auto& [component, yaml, steps] : cases) {
    SCOPED_TRACE(component);
    Trained out(yaml, {}, steps), kept(yaml, {component}, steps);
    ASSERT_TRUE(left_out(out.session, component));
    ASSERT_FALSE(left_out(kept.session, component));
    expect_shared_tensors_equal(out.session, kept.session);
    if (component != std::string("semantics")) continue;
    EXPECT_FALSE(out.session.pipeline->has_semantics());
    EXPECT_TRUE(kept.session.pipeline->has_semantics());
    EXPECT_EQ(out.trainer.losses().color, kept.trainer.losses().color);
  }
}

// The reason is that of this run: what was requested, or what the build, the machine or a part lacks.
TEST(LeaveOut, ADeviceIsLeftOutForTheReasonThatItIs) {
  const auto reason_of = [](const std::string& more) {
    return left_out_row(open_text(hash_config() + more), "cuda").evidence;
  };
  EXPECT_EQ(reason_of("runtime: {device: cpu}\n"), "runtime.device is cpu");
  std::string why_not = "it is there";
  (void)cuda_available(&why_not);
  EXPECT_EQ(reason_of("runtime: {device: auto}\n"), why_not);
}

TEST(LeaveOut, CoarsePassBeforeASinglePassSamplerIsBitwise) {
  std::string yaml = hash_config();
  yaml.insert(yaml.find("  - name: main\n"),
              "  - name: coarse\n    sampler: {type: stratified, samples: 4}\n"
              "    position: {type: frequency, frequencies: 2}\n    direction: {type: spherical_harmonics, degree: 2}\n"
              "    field: {type: tiny_mlp, hidden_width: 16, color_width: 16}\n");
  Trained out(yaml, {}, 20);
  ASSERT_TRUE(left_out(out.session, "coarse_passes"));
  EXPECT_EQ(out.session.pipeline->passes().size(), 1U);
  Trained kept(yaml, {"coarse_passes"}, 20);
  EXPECT_EQ(kept.session.pipeline->passes().size(), 2U);
  // The tile of rays must be the same for the pair, or the sums have another order.
  ASSERT_EQ(out.session.pipeline->tile_rays(), kept.session.pipeline->tile_rays());
  expect_shared_tensors_equal(out.session, kept.session);
}

const std::string kAbsentClass = "{type: analytic_room, frames: 4, absent_class: 1, labels: {frames: 1}}";

// The other model of the same claim: all classes, those without a pixel masked by a bias that no exponential survives.
TEST(LeaveOut, AbsentClassesAreBitwiseTheModelThatMasksThem) {
  const std::string yaml = with_scene(hash_config(), kAbsentClass);
  Trained out(yaml, {}, 0), kept(yaml, {"absent_classes"}, 0);
  const std::vector<int>& present = out.session.plan.class_of_logit;
  const std::size_t all = kept.session.plan.class_of_logit.size();
  ASSERT_LT(present.size(), all);
  const std::vector<std::int64_t>& pixels = out.session.manifest.train_class_pixels;
  EXPECT_EQ(std::ssize(pixels) - std::count(pixels.begin(), pixels.end(), 0), std::ssize(present));
  EXPECT_EQ(out.session.pipeline->passes().back().parts().head->width(), std::ssize(present));
  const auto tensor = [](Trained& run, const char* name) -> Tensor<float>& {
    return *run.session.pipeline->store().find(std::string("main/semantic/class/") + name);
  };
  const auto masked_from = [&](const char* name, float absent) {
    Tensor<float>&narrow = tensor(out, name), &wide = tensor(kept, name);
    for (std::int64_t r = 0; r < wide.spec.rows; ++r) {
      float* row = wide.value.data() + r * wide.spec.cols;
      std::fill_n(row, wide.spec.cols, absent);
      for (std::size_t l = 0; l < present.size(); ++l)
        row[present[l]] = narrow.value.data()[r * narrow.spec.cols + static_cast<std::int64_t>(l)];
    }
  };
  masked_from("weight", 0);
  masked_from("bias", -1e18F);  // large, and below the magnitude that a step refuses
  kept.session.pipeline->derive(0);
  for (int i = 0; i < 30; ++i) {
    const StepLosses a = out.trainer.advance().back(), b = kept.trainer.advance().back();
    ASSERT_EQ(a.semantic, b.semantic) << "step " << i;
  }
  for (const Tensor<float>& t : out.session.pipeline->store().all()) {
    if (!t.learned() || t.name.find("semantic/class") != std::string::npos) continue;
    const Tensor<float>& other = *kept.session.pipeline->store().find(t.name);
    EXPECT_TRUE(same_bits(t.value, other.value)) << t.name;
  }
  for (const char* name : {"weight", "bias"}) {
    const Tensor<float>&narrow = tensor(out, name), &wide = tensor(kept, name);
    for (std::int64_t r = 0; r < wide.spec.rows; ++r) {
      for (std::size_t l = 0; l < present.size(); ++l)
        EXPECT_EQ(narrow.value.data()[r * narrow.spec.cols + static_cast<std::int64_t>(l)],
                  wide.value.data()[r * wide.spec.cols + present[l]])
            << name << " " << r << " " << l;
    }
  }
}

BuildPlan plan_of(const SceneManifest& manifest, const BuildRequest& request,
                  const std::vector<std::string>& keep = {}) {
  return plan_build(manifest, request, keep);
}

// How it is proven that the component may go; nothing where it stays.
std::optional<ProofClass> proof_of(const BuildPlan& plan, const std::string& component) {
  for (const LeftOut& row : plan.left_out)
    if (row.component == component) return row.proof;
  return {};
}

TEST(LeaveOut, TheViewBranchGoesWhereAllRaysAreAlmostParallel) {
  SceneManifest manifest{.direction_spread_deg = 4.9};
  EXPECT_EQ(proof_of(plan_of(manifest, {}), "view_branch"), ProofClass::statistical);
  EXPECT_FALSE(plan_of(manifest, {}).view_branch);
  EXPECT_TRUE(plan_of(manifest, {}, {"view_branch"}).view_branch);
  manifest.direction_spread_deg = 0;
  EXPECT_EQ(proof_of(plan_of(manifest, {}), "view_branch"), ProofClass::bitwise);
  manifest.direction_spread_deg = 5.1;
  EXPECT_TRUE(plan_of(manifest, {}).view_branch);

  const Session s = open_text(hash_config());
  EXPECT_GT(s.manifest.direction_spread_deg, 60) << "cameras inside a room look around";
  EXPECT_LE(s.manifest.direction_spread_deg, 360);
  EXPECT_TRUE(s.plan.view_branch);
}

TEST(LeaveOut, RowsOfSamplerAndEarlyStopNameTheirProof) {
  BuildRequest request{.empty_space = EmptySpace::certified, .early_stop = 1e-4};
  EXPECT_EQ(proof_of(plan_of({}, request), "late_samples"), ProofClass::certified);
  EXPECT_EQ(proof_of(plan_of({}, request), "empty_space"), ProofClass::statistical) << "its densities are estimates";
  EXPECT_FALSE(plan_of({}, request).late_samples);
  EXPECT_TRUE(plan_of({}, request, {"late_samples"}).late_samples);
  request.empty_space = EmptySpace::threshold;
  EXPECT_EQ(proof_of(plan_of({}, request), "empty_space"), ProofClass::statistical);
  request.empty_space = EmptySpace::sampled;
  request.early_stop = 0;
  for (const char* stays : {"empty_space", "late_samples"}) EXPECT_FALSE(proof_of(plan_of({}, request), stays));

  EXPECT_GT(open_text(hash_config()).pipeline->options().rules.rendering.early_stop, 0);
  EXPECT_EQ(open_text(hash_config(), {"late_samples"}).pipeline->options().rules.rendering.early_stop, 0);
}

TEST(LeaveOut, KeepTakesWhatIsNeededAnywayAndRefusesSettings) {
  BuildRequest request{.training_depth_px = 10};
  EXPECT_EQ(plan_of({}, request, {"training_depth"}).kept, std::vector<std::string>{"training_depth"});
  request.training_depth_px = 0;  // the labels need it: one list of names fits several scenes
  EXPECT_TRUE(plan_of({}, request, {"training_depth"}).kept.empty());
  EXPECT_HAS(error_of(ErrorKind::usage, [&] { plan_of({}, request, {"mixed_precision"}); }), "runtime.precision: bf16");
}

// One place decides: whatever a run's list names, --keep knows, and takes or says what brings it in.
TEST(LeaveOut, KeepKnowsEveryRowOfARunsList) {
  const Session s = open_text(hash_config());
  BuildRequest request;
  const SamplerTraits sampler = make_last_sampler(s.config, all_plugins(), s.extent)->traits();
  request.losses = build_request(s.config, all_plugins(), sampler).losses;
  std::set<std::string> listed;
  for (const LeftOut& row : s.plan.left_out) {
    listed.insert(row.component);
    EXPECT_FALSE(row.evidence.empty()) << row.component;
    try {
      plan_of(s.manifest, request, {row.component});
      EXPECT_EQ(row.instead, "") << row.component << " is kept, so nothing else brings it in";
    } catch (const Error& error) {
      EXPECT_EQ(error.kind(), ErrorKind::usage) << error.what();
      EXPECT_EQ(error.remedy(), row.instead) << error.what();
    }
  }
  EXPECT_TRUE(listed.contains("untouched_rows"));
}

TEST(LeaveOut, WhatPartsLeaveOutHasTheReasonThatItIs) {
  const auto evidence = [](const BuiltParts& built, const std::string& component) {
    BuildPlan plan;
    add_built_rows(built, plan);
    for (const LeftOut& row : plan.left_out) {
      if (row.component == component) return row.evidence;
    }
    return std::string("not left out");
  };
  BuiltParts built;
  EXPECT_EQ(evidence(built, "table_size"), "not left out");
  EXPECT_EQ(evidence(built, "untouched_rows"), "not left out");
  EXPECT_HAS(evidence(built, "image_library"), "this build has none");
  built.image_library = true;
  EXPECT_HAS(evidence(built, "image_library"), "no image of this scene");
  built = {{"a size"}, 100, 80, true, true};
  EXPECT_EQ(evidence(built, "table_size"), "a size");
  EXPECT_HAS(evidence(built, "untouched_rows"), "80 of 100");
  EXPECT_EQ(evidence(built, "image_library"), "not left out");
  EXPECT_EQ(evidence(built, "mpi"), "this build has none");
  built.mpi = true;
  EXPECT_EQ(evidence(built, "mpi"), "this process was started alone");
  built.processes = 2;
  EXPECT_EQ(evidence(built, "mpi"), "not left out");
}

TEST(LeaveOut, DepthOfTrainingFramesIsNotHeldUnlessKept) {
  const auto open_for_training = [&](const std::vector<std::string>& keep) {
    Diagnostics diagnostics;
    return open_text(hash_config(), all_plugins(), SessionOptions{.keep = keep, .depth = DepthKept::test}, diagnostics);
  };
  const Session out = open_for_training({}), kept = open_for_training({"training_depth"});
  ASSERT_TRUE(left_out(out, "training_depth"));
  EXPECT_FALSE(left_out(kept, "training_depth"));
  const int frame = out.scene.frames_of(Split::train).front();
  EXPECT_TRUE(out.scene.frames[frame].depth_m.empty());
  EXPECT_FALSE(kept.scene.frames[frame].depth_m.empty());
}

// What is kept belongs to the run: it is in run.yaml, and whoever opens the run builds the same network.
TEST(LeaveOut, ARunIsOpenedWithWhatItKept) {
  const TempDir dir;
  const std::string yaml = replaced(with_scene(hash_config("report: {eval_every_s: 0, strips: 0}\n"), kAbsentClass),
                                    "steps: 200", "steps: 4");
  Diagnostics diagnostics;
  TrainRequest request{.out_dir = dir / "run", .keep = {"absent_classes", "late_samples"}};
  run_training(run_config_of(parse_config_text(yaml, "test.yaml"), all_plugins()), all_plugins(), request, {});
  const OpenedRun opened = open_run(request.out_dir, {}, all_plugins(), diagnostics);
  EXPECT_EQ(opened.step, 4);
  EXPECT_EQ(opened.session.plan.kept, (std::vector<std::string>{"absent_classes", "late_samples"}));

  request.resume = true;
  request.keep = {};
  RunConfig again = load_run_config(RunFolder::read(request.out_dir).config_path(), {"train.steps=6"}, all_plugins());
  EXPECT_EQ(run_training(std::move(again), all_plugins(), request, {}).step, 6);

  // Its own list: a rule and evidence per row, and a measured saving or none, never an empty text.
  const std::string text = read_text_file(RunFolder::read(request.out_dir).left_out_path());
  EXPECT_LACKS(text, "\"saving_measured\": \"\"");
  bool undistortion = false;
  for (const nlohmann::json& row : nlohmann::json::parse(text)) {
    EXPECT_NE(row["rule"], row["component"]);
    if (row["component"] == "undistortion") {
      undistortion = true;
      EXPECT_EQ(row["saving_measured"], shipped_saving("undistortion"));
    }
    EXPECT_NE(row["component"], "absent_classes");
  }
  EXPECT_TRUE(undistortion);
}

TEST(LeaveOut, KeepRefusesAnUnknownName) {
  EXPECT_HAS(error_of(ErrorKind::usage, [&] { open_text(hash_config(), {"undistorsion"}); }),
             "did you mean 'undistortion'?");
}

// How many gradient lanes a run gets, the units of work that threads share, and the memory that they take.

// Of a shipped configuration with labels on every frame, without its scene.
int lanes_of_preset(const std::string& name, const std::vector<std::string>& set = {}) {
  Registry& registry = all_plugins();
  RunConfig config = load_run_config(SEMFIELD_SOURCE_DIR "/configs/" + name, set, registry);
  config.runtime.precision = Precision::fp32;
  (void)choose_for_device(config, Device::cpu);
  SceneExtent extent{.bounds = {{-3, -3, -1}, {3, 3, 2}}, .near_m = 0.1, .far_m = 10, .pixel_footprint_m = 0.01};
  SceneManifest manifest{.classes = 13, .train_pixels = 1'000'000, .train_frames = 100, .labelled_frames = 100};
  manifest.train_class_pixels.assign(13, 70'000);
  std::unique_ptr<Sampler<float>> last = make_last_sampler(config, registry, extent);
  const BuildPlan plan = plan_build(manifest, build_request(config, registry, last->traits()), {});
  return make_parts<float>(config, registry, plan, extent, std::move(last)).options.lanes;
}

TEST(Lanes, AStepOf1024RaysHasWorkFor32AndMoreWhateverTheThreads) {
  for (const char* preset : {"paper.yaml", "quickstart.yaml", "bench/hash_step.yaml"}) {
    const int lanes = lanes_of_preset(preset);
    EXPECT_GE(lanes, 32) << preset;
    EXPECT_LE(lanes, 48) << preset;
    for (const int count : {1, 3, 16}) {
      const ThreadScope threads(count);
      EXPECT_EQ(lanes_of_preset(preset), lanes) << preset << ", " << count << " threads";
    }
  }
}

TEST(Lanes, AreFewForFewRays) {
  EXPECT_EQ(lanes_of_preset("paper.yaml", {"train.rays=5"}), 1);
  EXPECT_LE(lanes_of_preset("quickstart.yaml", {"train.rays=128"}), 8);
  EXPECT_LE(lanes_of_preset("quickstart.yaml", {"train.rays=1024", "runtime.tile_rays=1"}), 48);
}

TEST(Lanes, AreFewerWhereTheirGradientsWouldFillTheMemory) {
  const int wide = lanes_of_preset("paper.yaml", {"passes.0.field.width=1024", "passes.1.field.width=1024"});
  EXPECT_LT(wide, 8);
  EXPECT_GE(wide, 1);
}

TEST(Lanes, TheChosenNumberIsThatOfTheRunAndItsIdentity) {
  const Session s = open_text(hash_config());
  const int lanes = s.pipeline->options().lanes;
  EXPECT_GT(lanes, 0);
  EXPECT_EQ(s.config.runtime.lanes, lanes);
  EXPECT_HAS(write_config(resolved_config(s.config)), "lanes: " + std::to_string(lanes));
  const Session same = open_text(hash_config("runtime: {lanes: " + std::to_string(lanes) + "}\n"));
  EXPECT_EQ(identity_hash(same.config), identity_hash(s.config));
  EXPECT_HAS(describe_session(s), std::to_string(lanes) + " lanes");
  EXPECT_EQ(open_text(hash_config("runtime: {lanes: 8}\n")).pipeline->options().lanes, 8) << "what is named stays";
}

std::size_t scratch_of(const std::string& yaml) {
  Session s = open_text(yaml);
  Trainer trainer(s);
  for (int i = 0; i < 2; ++i) trainer.advance();
  return s.pipeline->lanes().workspace_bytes();
}

TEST(Lanes, ScratchGrowsWithThreadsAndNotWithLanes) {
  const std::string rays = "train: {rays: 512}\nruntime: {threads: 2, tile_rays: 8, lanes: ";
  const auto text = [&](const std::string& lanes) {
    std::string yaml = two_pass_config();
    yaml.replace(yaml.find("train:"), std::string::npos, rays + lanes + "}\n");
    return yaml;
  };
  const std::size_t few = scratch_of(text("2"));
  EXPECT_EQ(scratch_of(text("64")), few);
}

TEST(ThreadArenas, EveryThreadGetsRoomForTheUnitThatTakesMost) {
  const ThreadScope threads(4);
  constexpr std::size_t kLarge = std::size_t{8} << 20;
  ThreadArenas arenas;
  const auto round = [&](std::int64_t dearest) {
    arenas.for_units(64, [&](Workspace& arena, std::int64_t i) {
      const Workspace::Scope scope(arena);
      arena.take_bytes(i == dearest ? kLarge : 64);
    });
  };
  round(63);
  EXPECT_EQ(arenas.bytes(), 4 * kLarge) << "whichever thread met it";
  const std::int64_t growths = arenas.growths();
  for (std::int64_t i = 0; i < 64; ++i) round(i);
  EXPECT_EQ(arenas.growths(), growths);
}

TEST(ThreadArenas, EveryUnitIsDoneOnceInAnArenaThatNoOtherThreadHas) {
  for (const int count : {1, 2, 7}) {
    const ThreadScope threads(count);
    ThreadArenas arenas;
    std::vector<std::atomic<int>> done(1000);
    arenas.for_units(1000, [&](Workspace& arena, std::int64_t i) {
      const Workspace::Scope scope(arena);
      const View<std::int64_t> mine = arena.take<std::int64_t>(64, 1);
      for (std::int64_t k = 0; k < 64; ++k) mine(k, 0) = i;
      for (std::int64_t k = 0; k < 64; ++k) done[i] += mine(k, 0) == i ? 1 : 0;
    });
    for (const auto& times : done) EXPECT_EQ(times, 64);
  }
}

TEST(Determinism, ChosenLanesGiveTheSameBitsFor1And2And3And7ThreadsAndOddRays) {
  for (const std::string& yaml : {with_rays(hash_config(), 1021), with_rays(two_pass_config(), 333)}) {
    const std::uint32_t one = train_fingerprint(yaml, 1, 4);
    for (const int threads : {2, 3, 7}) EXPECT_EQ(train_fingerprint(yaml, threads, 4), one) << threads << " threads";
  }
}

}  // namespace
}  // namespace semfield
