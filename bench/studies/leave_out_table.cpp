// The list of leave-out pairs: what is left out, what keeps it, and how both are compared.
#include "studies/leave_out_pairs.h"

namespace semfield {

namespace {

// Both sides must walk the same lattice of steps: a ray with more than max_samples of them takes longer ones.
const std::vector<std::string> kCoarseSteps{"passes.0.sampler.step_m=0.05", "passes.0.sampler.max_samples=256",
                                            "passes.0.sampler.warmup_steps=32"};

std::vector<std::string> with(std::vector<std::string> a, const std::vector<std::string>& b) {
  a.insert(a.end(), b.begin(), b.end());
  return a;
}

LeaveOutPair pair_of(std::string name, std::string component, std::string rule, ProofClass proof, PairKind kind) {
  LeaveOutPair pair;
  pair.name = std::move(name);
  pair.component = std::move(component);
  pair.rule = std::move(rule);
  pair.proof = proof;
  pair.kind = kind;
  pair.kept_by = "`--keep " + pair.component + "`";
  pair.kept = {"runtime.keep=[" + pair.component + "]"};
  return pair;
}

std::vector<LeaveOutPair> semantics_pairs() {
  std::vector<LeaveOutPair> all;
  LeaveOutPair p = pair_of("semantics", "semantics", "no labelled pixel in the training frames", ProofClass::bitwise,
                           PairKind::training);
  p.both = {"scene.labels.frames=none", "train.ray_source=all_images"};
  // With the rows of rays that have no label, or there would be no work to save.
  p.kept = {"runtime.keep=[semantics, unlabelled_rays]"};
  all.push_back(p);

  p = pair_of("unlabelled_rays", "unlabelled_rays", "the head runs on rays with a label alone", ProofClass::bitwise,
              PairKind::training);
  p.both = {"train.ray_source=all_images"};
  all.push_back(p);

  p = pair_of("absent_classes", "absent_classes", "classes without a training pixel get no logit",
              ProofClass::statistical, PairKind::quality);
  all.push_back(p);

  p = pair_of("semantic_outputs", "", "a picture of which no label, entropy or probability is asked for runs no head",
              ProofClass::bitwise, PairKind::outputs);
  p.kept = {};
  p.kept_by = "ask for them";
  all.push_back(p);
  return all;
}

std::vector<LeaveOutPair> sampling_pairs() {
  std::vector<LeaveOutPair> all;
  LeaveOutPair p = pair_of("coarse_passes", "coarse_passes", "the last pass's sampler reads no earlier pass",
                           ProofClass::bitwise, PairKind::training);
  p.config = "configs/quickstart_frequency.yaml";
  p.both = {"passes.1.sampler={type: occupancy_grid, resolution: 32, max_samples: 24, keep_last: true}",
            "runtime.tile_rays=32"};
  all.push_back(p);

  p = pair_of("late_samples", "late_samples",
              "rendering ends a ray whose transmittance is below `rendering.early_stop`", ProofClass::certified,
              PairKind::rendering);
  p.both = {"rendering.early_stop=1e-4", "rendering.density_bias=20"};  // thick fog: every ray ends early
  p.bound = 1e-4;
  p.steps = 5;  // before it has learned to be air
  all.push_back(p);

  p = pair_of("late_samples_deep", "late_samples", "the same, stratified and importance samples", ProofClass::certified,
              PairKind::rendering);
  p.config = "configs/quickstart_frequency.yaml";
  p.both = {"rendering.early_stop=1e-4", "rendering.density_bias=6"};
  p.bound = 1e-4;
  all.push_back(p);

  p = pair_of("late_samples_room", "late_samples", "the same in the room as it is learned", ProofClass::certified,
              PairKind::rendering);
  p.both = {"rendering.early_stop=1e-4"};
  p.bound = 1e-4;
  p.steps = 1000;
  all.push_back(p);

  p = pair_of("empty_space_certified", "empty_space",
              "cells whose optical depth fits a ray's budget of 1e-3, by a grid that is updated every step",
              ProofClass::certified, PairKind::rendering);
  p.both = with(kCoarseSteps, {"rendering.early_stop=0", "rendering.density_bias=-9"});
  p.out = {"passes.0.sampler.skip=certified", "passes.0.sampler.skip_budget=1e-3"};
  p.kept = {"passes.0.sampler.skip=never"};
  p.kept_by = "`passes.N.sampler.skip: never`";
  p.bound = 1e-3;
  all.push_back(p);
  all.back().both.insert(all.back().both.end(), {"passes.0.sampler.update_every=1", "passes.0.sampler.update_share=1"});

  p.name = "empty_space_lagging";
  p.rule = "the same by a grid of which an eighth is updated every 16 steps (the default)";
  p.but =
      "its densities are estimates and lag behind a field that changes fast: then the budget bounds nothing, so that "
      "a run's list says S";
  all.push_back(p);

  p = pair_of("empty_space_threshold", "empty_space", "cells below a fixed density, whatever their number",
              ProofClass::statistical, PairKind::quality);
  p.both = kCoarseSteps;
  p.out = {"passes.0.sampler.skip=threshold"};
  p.kept = {"passes.0.sampler.skip=never"};
  p.kept_by = "`passes.N.sampler.skip: never`";
  all.push_back(p);
  return all;
}

std::vector<LeaveOutPair> network_pairs() {
  std::vector<LeaveOutPair> all;
  LeaveOutPair p = pair_of("table_size", "table_size", "sizes of the hash grid from the scene's extent and pixels",
                           ProofClass::statistical, PairKind::quality);
  p.kept = {"passes.0.position.log2_entries=19", "passes.0.position.finest_resolution=512"};
  p.kept_by = "numbers in `passes.N.position`";
  all.push_back(p);

  p = pair_of("untouched_rows", "untouched_rows", "a table's row is updated in the steps that give it a gradient",
              ProofClass::bitwise, PairKind::rows);
  p.kept = {};
  p.kept_by = "Adam's rule for tables";
  all.push_back(p);

  p = pair_of("view_branch", "view_branch", "training rays within 5 degrees of each other", ProofClass::statistical,
              PairKind::quality);
  p.out = {"passes.0.direction=null"};
  p.kept = {};
  p.but = "a scene seen from several sides keeps it: its direction part is computed once per ray already";
  all.push_back(p);

  p = pair_of("frequency_bands", "", "bands finer than a pixel", ProofClass::statistical, PairKind::cost);
  p.config = "configs/quickstart_frequency.yaml";
  p.both = {"passes.1.sampler.keep_previous=true"};
  p.out = {"passes.0.position.frequencies=4"};
  p.kept = {"passes.0.position.frequencies=8"};
  p.kept_by = "`passes.N.position.frequencies`";
  p.but = "who writes a number of bands asks for them; half of them cost";
  all.push_back(p);

  p = pair_of("class_weights", "class_weights", "`semantics.balance_classes` is false", ProofClass::bitwise,
              PairKind::cost);
  p.kept = {"semantics.balance_classes=true"};
  p.kept_by = "`semantics.balance_classes: true`";
  p.but = "built when asked for, however alike the classes' frequencies are: they cost";
  all.push_back(p);
  return all;
}

std::vector<LeaveOutPair> data_pairs() {
  std::vector<LeaveOutPair> all;
  LeaveOutPair p = pair_of("undistortion", "undistortion", "every distortion coefficient is 0", ProofClass::bitwise,
                           PairKind::training);
  all.push_back(p);

  p = pair_of("training_depth", "training_depth", "depth of training frames gives the bounds and is then dropped",
              ProofClass::bitwise, PairKind::training);
  all.push_back(p);

  p = pair_of("instances", "", "instances are kept for `semfield objects`, and for label steps that read them",
              ProofClass::bitwise, PairKind::training);
  p.both = {"scene.instances=pieces", "scene.labels.frames=all"};
  p.kept = {"scene.labels.degrade=[{type: region_noise, ratio: 0, min_frames: 1}]"};
  p.kept_by = "ask for one of them";
  all.push_back(p);

  p = pair_of("periodic_evaluation", "periodic_evaluation", "`report.eval_every_s` is 0", ProofClass::bitwise,
              PairKind::evaluation);
  p.kept = {};
  p.kept_by = "`report.eval_every_s`";
  all.push_back(p);

  p = pair_of("finite_checks", "", "gradients and losses are looked at before every update", ProofClass::bitwise,
              PairKind::checks);
  p.kept = {};
  p.kept_by = "always";
  p.but = "a step that is not finite must change nothing";
  all.push_back(p);

  p = pair_of("image_library", "image_library", "loaded when the first image other than PNG is met",
              ProofClass::bitwise, PairKind::library);
  p.kept = {};
  p.kept_by = "it is loaded by itself";
  all.push_back(p);
  return all;
}

}  // namespace

const std::vector<LeaveOutPair>& leave_out_pairs() {
  static const std::vector<LeaveOutPair> all = [] {
    std::vector<LeaveOutPair> list = semantics_pairs();
    for (const std::vector<LeaveOutPair>& part : {sampling_pairs(), network_pairs(), data_pairs()})
      list.insert(list.end(), part.begin(), part.end());
    return list;
  }();
  return all;
}

}  // namespace semfield
