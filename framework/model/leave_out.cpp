#include "model/leave_out.h"

#include <fmt/format.h>

#include <algorithm>
#include <numeric>
#include <tuple>

#include "core/error.h"

namespace semfield {

namespace {

// Collects the rules; a rule that fires either leaves its component out or, when named in `keep`, notes it as kept.
class Planner {
 public:
  Planner(BuildPlan& plan, const std::vector<std::string>& keep) : plan_(plan), keep_(keep) {}

  /// True when the component stays out.
  bool leave(bool fires, LeftOut row) {
    const bool named = std::find(keep_.begin(), keep_.end(), row.component) != keep_.end();
    if (named && !row.instead.empty()) {
      throw Error(ErrorKind::usage, "config.keep.unknown",
                  fmt::format("--keep {}: this is not left out by a rule of the scene", row.component), row.instead);
    }
    all_.push_back(row.component);
    if (row.instead.empty()) known_.push_back(row.component);
    if (!fires) return false;
    if (named) {
      plan_.kept.push_back(row.component);
      return false;
    }
    plan_.left_out.push_back(std::move(row));
    return true;
  }
  void refuse_unknown() const {
    for (const std::string& name : keep_) {
      if (std::find(all_.begin(), all_.end(), name) != all_.end()) continue;
      throw Error(
          ErrorKind::usage, "config.keep.unknown",
          fmt::format("--keep {}: no rule leaves out anything of that name (there are: {})", name, join(known_)),
          near_name_remedy(name, known_));
    }
  }

 private:
  BuildPlan& plan_;
  const std::vector<std::string>& keep_;
  std::vector<std::string> known_, all_;
};

void plan_semantics(const SceneManifest& manifest, const BuildRequest& request, Planner& planner, BuildPlan& plan) {
  const std::vector<std::int64_t>& pixels = manifest.train_class_pixels;
  const std::int64_t labelled = std::accumulate(pixels.begin(), pixels.end(), std::int64_t{0});
  const auto absent = static_cast<int>(std::count(pixels.begin(), pixels.end(), 0));
  plan.semantics = !planner.leave(
      labelled == 0,
      {"semantics", "no labelled pixel in the training frames",
       manifest.classes == 0 ? "the scene has no labels"
                             : fmt::format("0 labelled pixels in {} training frames", manifest.train_frames),
       ProofClass::bitwise, "head, class layer, logits and cross-entropy"});
  if (plan.semantics && manifest.classes == 0) {
    throw Error(ErrorKind::usage, "config.keep.classes",
                "--keep semantics: the scene has no class table, so a head has no classes to predict",
                "give the scene labels and classes.yaml");
  }
  const bool absent_out =
      planner.leave(plan.semantics && absent > 0 && labelled > 0,
                    {"absent_classes", "classes without a training pixel get no logit",
                     fmt::format("{} of {} classes have no training pixel", absent, manifest.classes),
                     ProofClass::statistical, fmt::format("{} of {} logits", absent, manifest.classes)});
  for (int c = 0; plan.semantics && c < manifest.classes; ++c) {
    if (!absent_out || pixels[static_cast<std::size_t>(c)] > 0) plan.class_of_logit.push_back(c);
  }
  const double share = 100.0 * (1 - static_cast<double>(labelled) /
                                        static_cast<double>(std::max<std::int64_t>(manifest.train_pixels, 1)));
  const bool some = plan.semantics && labelled < manifest.train_pixels;
  plan.head_on_unlabelled_rays =
      !planner.leave(
          some, {"unlabelled_rays", "the head runs on rays with a label alone",
                 fmt::format("{:.1f} % of training pixels carry no label; their semantic gradient is exactly 0", share),
                 ProofClass::bitwise, fmt::format("{:.0f} % of the head's work in training", share)}) &&
      some;
  planner.leave(plan.semantics && !request.balance_classes,
                {"class_weights", "not asked for", "semantics.balance_classes is false", ProofClass::bitwise,
                 "one factor for each labelled ray", "set semantics.balance_classes: true"});
}

void plan_passes(const SceneManifest& manifest, const BuildRequest& request, Planner& planner, BuildPlan& plan) {
  if (planner.leave(request.passes > 1 && request.last_sampler_single_pass,
                    {"coarse_passes", "the last pass's sampler reads no earlier pass",
                     "the last pass's sampler finds the surface by itself", ProofClass::bitwise,
                     fmt::format("{} of {} networks", request.passes - 1, request.passes)})) {
    plan.first_pass = request.passes - 1;
  }
  const double spread = manifest.direction_spread_deg;
  if (!request.direction_encoder) {
    planner.leave(true,
                  {"view_branch", "not asked for", "the last pass names no direction encoder", ProofClass::bitwise,
                   "the colour's direction input", "name " + request.last_pass + ".direction"});
    plan.view_branch = false;
  } else {
    plan.view_branch = !planner.leave(
        spread < kDirectionSpreadDeg,
        {"view_branch", fmt::format("training rays within {:g} degrees of each other", kDirectionSpreadDeg),
         fmt::format("all training rays lie within {:.3g} degrees", spread),
         spread == 0 ? ProofClass::bitwise : ProofClass::statistical, "the colour's direction input"});
  }
  const bool certified = request.empty_space == EmptySpace::certified;
  planner.leave(
      request.empty_space != EmptySpace::sampled,
      {"empty_space", "the sampler passes over cells that it knows to be empty",
       certified ? "its budget bounds what a ray loses by the grid's densities, estimates that lag behind the field"
                 : "cells below a fixed density count as empty, which bounds no error",
       ProofClass::statistical, "samples in empty space", "set the skip rule of " + request.last_pass + ".sampler"});
  plan.late_samples = !planner.leave(
      request.early_stop > 0,
      {"late_samples", "rendering ends a ray whose transmittance is below rendering.early_stop",
       fmt::format("early_stop is {:g}: colours are off by at most that, {} a quarter of an 8-bit step; logits by at "
                   "most that times the largest of a sample",
                   request.early_stop, request.early_stop <= kEightBitStop ? "below" : "which is MORE than"),
       ProofClass::certified, "samples behind surfaces, when rendering"});
}

// Why the scene leaves a named loss nothing to do; the first text is empty where it does not.
std::pair<std::string, std::string> idle_loss(const LossTraits& traits, const BuildRequest& request,
                                              const BuildPlan& plan) {
  if (traits.reads_target(channel::depth) && request.depth_px == 0)
    return {"no training pixel has a depth",
            request.depth_frames > 0
                ? fmt::format("depth images of {} training frames, without a valid pixel", request.depth_frames)
                : "no training frame has a depth image"};
  const bool semantic = traits.reads_target(channel::label) || traits.reads_target(channel::soft_label) ||
                        traits.reads_head(channel::logits);
  if (semantic && !plan.semantics) return {"there are no semantics", "the semantic head is left out"};
  for (const std::string_view name : traits.targets) {
    const bool known =
        name == channel::color || name == channel::label || name == channel::soft_label || name == channel::depth;
    if (!known && !request.channels.contains(std::string(name)))
      return {"no training frame has a channel that it reads", fmt::format("no training frame has '{}'", name)};
  }
  return {};
}

void plan_losses(const BuildRequest& request, Planner& planner, BuildPlan& plan) {
  for (const LossRequest& loss : request.losses) {
    LeftOut row{"loss_" + loss.name, "not asked for", fmt::format("`losses` names no term of type {}", loss.name),
                ProofClass::bitwise, loss.saves,      fmt::format("add {{type: {}}} to the list `losses`", loss.name)};
    if (!loss.named) {
      planner.leave(true, std::move(row));
      continue;
    }
    std::tie(row.rule, row.evidence) = idle_loss(loss.traits, request, plan);
    const bool idle = !row.rule.empty();
    if (!idle) row.rule = "the scene has nothing that it reads";
    row.instead.clear();
    if (planner.leave(idle, std::move(row))) plan.no_losses.push_back(loss.name);
  }
}

// A head whose channel no loss reads learns nothing.
void plan_heads(const BuildRequest& request, Planner& planner, BuildPlan& plan) {
  const auto reads = [&](const std::string& channel) {
    return std::any_of(request.losses.begin(), request.losses.end(), [&](const LossRequest& loss) {
      const bool built =
          loss.named && std::find(plan.no_losses.begin(), plan.no_losses.end(), loss.name) == plan.no_losses.end();
      return built && loss.traits.reads_head(channel);
    });
  };
  planner.leave(request.heads.empty(),
                {"heads", "not asked for", "the list `heads` is empty", ProofClass::bitwise,
                 "a branch and a head on the samples that weigh", "add a head to the list `heads`"});
  for (const std::string& channel : request.heads) {
    const bool idle = !request.trained && !reads(channel);
    if (planner.leave(idle, {"head_" + channel, "no loss that works reads its channel",
                             fmt::format("no loss of the list `losses` that works reads '{}'", channel),
                             ProofClass::bitwise, "a branch and a head on the samples that weigh"}))
      plan.no_heads.push_back(channel);
  }
}

void plan_cameras(const SceneManifest& manifest, const BuildRequest& request, Planner& planner, BuildPlan& plan) {
  const auto learned = [&](bool asked, const std::string& why, const char* key, const char* saves) {
    const std::string component = fmt::format("camera_{}", key), setting = fmt::format("train.cameras.{}", key);
    LeftOut row{component, "not asked for", setting + " is given", ProofClass::bitwise, saves};
    if (!why.empty()) {
      row.rule = "the scene gives no reason to correct them";
      row.evidence = why;
    }
    return planner.leave(!asked, std::move(row)) ? std::int64_t{0} : manifest.train_frames;
  };
  plan.learned_poses = learned(request.learns_poses, request.poses_why, "poses", "gradients of rays");
  plan.learned_colors = learned(request.learns_colors, request.colors_why, "colors", "a map of colours per camera");
}

// Components that the parts leave out by themselves, where they do; nothing of the scene's brings them in.
std::vector<std::pair<bool, LeftOut>> built_rows(const BuiltParts& built) {
  std::vector<std::pair<bool, LeftOut>> rows;
  const LeftOut size{"table_size",
                     "a size that the configuration leaves open is the least that the scene needs",
                     "",
                     ProofClass::statistical,
                     "memory, and reads that miss the cache",
                     "write the size into the configuration"};
  rows.push_back({false, size});
  for (const std::string& sentence : built.sizes) {
    rows.push_back({true, size});
    rows.back().second.evidence = sentence;
  }
  rows.push_back(
      {built.in_tables > 0,
       {"untouched_rows", "a table's row is updated in the steps that give it a gradient",
        fmt::format("{} of {} parameters are in tables", built.in_tables, built.learned), ProofClass::bitwise,
        "zeroing, checking and updating rows that no ray met", "it is Adam's rule for tables"}});
  rows.push_back({!built.images_loaded,
                  {"image_library", "loaded when the first image other than PNG is met",
                   built.image_library ? "no image of this scene needed it" : "this build has none",
                   ProofClass::bitwise, "about 250 shared libraries, a quarter of a second",
                   "it is loaded by itself, in a build with -DSEMFIELD_WITH_IMAGES=ON"}});
  rows.push_back({built.processes == 1,
                  {"mpi", "loaded when mpirun or srun has started several processes",
                   built.mpi ? "this process was started alone" : "this build has none", ProofClass::bitwise,
                   "MPI's libraries, and waiting for other processes",
                   "mpirun brings it in, in a build with -DSEMFIELD_WITH_MPI=ON"}});
  return rows;
}

}  // namespace

BuildPlan plan_build(const SceneManifest& manifest, const BuildRequest& request, const std::vector<std::string>& keep) {
  BuildPlan plan;
  Planner planner(plan, keep);
  plan_semantics(manifest, request, planner, plan);
  plan_passes(manifest, request, planner, plan);
  plan.undistortion = !planner.leave(!manifest.any_distortion,
                                     {"undistortion", "every distortion coefficient is 0", "0 cameras with distortion",
                                      ProofClass::bitwise, "Newton iterations for each ray"});
  planner.leave(!manifest.any_depth,
                {"depth_metrics", "the scene has no depth maps", "0 frames with depth", ProofClass::bitwise,
                 "depth buffers and their metrics", "give the scene depth maps"});
  const double depth_mb = 2e-6 * static_cast<double>(request.training_depth_px);
  planner.leave(
      request.training_depth_px > 0,
      {kTrainingDepth, "depth of training frames gives bounds and distances and is then dropped",
       fmt::format("no loss reads it: {} training pixels with depth", request.training_depth_px), ProofClass::bitwise,
       fmt::format("2 bytes per pixel: {:.1f} MB", depth_mb), "", fmt::format("{:.1f} MB not held", depth_mb)});
  plan_losses(request, planner, plan);
  plan_heads(request, planner, plan);
  plan_cameras(manifest, request, planner, plan);
  planner.leave(request.density_noise == 0,
                {"density_noise", "its deviation is 0", "rendering.density_noise is 0", ProofClass::bitwise,
                 "one normal variate for each sample", "set rendering.density_noise"});
  planner.leave(!request.mixed_precision,
                {"mixed_precision", "not asked for", "runtime.precision is fp32", ProofClass::bitwise,
                 "weights packed in bf16 once per step", "set runtime.precision: bf16"});
  planner.leave(!request.no_cuda.empty(),
                {"cuda", "the run stays on the CPU", request.no_cuda, ProofClass::bitwise, "start-up of the device",
                 "set runtime.device: cuda, which says what is missing"});
  planner.leave(!request.periodic_evaluation,
                {"periodic_evaluation", "not asked for", "report.eval_every_s is 0", ProofClass::bitwise,
                 "rendering test frames while training", "set report.eval_every_s"});
  for (auto& [fires, row] : built_rows({})) planner.leave(false, std::move(row));
  planner.refuse_unknown();
  return plan;
}

void add_built_rows(const BuiltParts& built, BuildPlan& plan) {
  for (auto& [fires, row] : built_rows(built)) {
    if (fires) plan.left_out.push_back(std::move(row));
  }
}

}  // namespace semfield
