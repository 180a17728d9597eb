#include "model/leave_out.h"

#include <fmt/format.h>

#include <algorithm>

#include "core/error.h"

namespace semfield {

namespace {

// Collects the rules; a rule that fires either leaves its component out or, when named in `keep`, notes it as kept.
class Planner {
 public:
  Planner(BuildPlan& plan, const std::vector<std::string>& keep) : plan_(plan), keep_(keep) {}

  /// True when the component stays out.
  bool leave(LeftOut row) {
    seen_.push_back(row.component);
    if (std::find(keep_.begin(), keep_.end(), row.component) != keep_.end()) {
      plan_.kept.push_back(row.component);
      return false;
    }
    plan_.left_out.push_back(std::move(row));
    return true;
  }
  void refuse_unknown() const {
    for (const std::string& name : keep_) {
      if (std::find(seen_.begin(), seen_.end(), name) != seen_.end()) continue;
      const std::string near = did_you_mean(name, seen_);
      throw Error(ErrorKind::usage,
                  fmt::format("--keep {}: nothing of that name is left out here (left out: {})", name,
                              seen_.empty() ? "nothing" : join(seen_)),
                  near.empty() ? "" : "did you mean '" + near + "'?");
    }
  }

 private:
  BuildPlan& plan_;
  const std::vector<std::string>& keep_;
  std::vector<std::string> seen_;
};

}  // namespace

BuildPlan plan_build(const SceneManifest& manifest, const BuildRequest& request, const std::vector<std::string>& keep) {
  BuildPlan plan;
  Planner planner(plan, keep);
  std::int64_t labelled = 0;
  int present = 0;
  for (const std::int64_t pixels : manifest.train_class_pixels) {
    labelled += pixels;
    present += pixels > 0 ? 1 : 0;
  }

  if (labelled == 0) {
    const bool out = planner.leave({"semantics",
                                    manifest.classes == 0
                                        ? "the scene has no labels"
                                        : fmt::format("0 labelled pixels in {} training frames", manifest.train_frames),
                                    ProofClass::bitwise, "head, class layer, logits and cross-entropy"});
    if (!out && manifest.classes == 0) {
      throw Error(ErrorKind::usage,
                  "--keep semantics: the scene has no class table, so a head has no classes to predict",
                  "give the scene labels and classes.yaml");
    }
    plan.semantics = !out;
  }
  if (plan.semantics) {
    if (present < manifest.classes && labelled > 0 &&
        planner.leave(
            {"absent_classes",
             fmt::format("{} of {} classes have no training pixel", manifest.classes - present, manifest.classes),
             ProofClass::statistical, fmt::format("{} of {} logits", manifest.classes - present, manifest.classes)})) {
      for (int c = 0; c < manifest.classes; ++c) {
        if (manifest.train_class_pixels[static_cast<std::size_t>(c)] > 0) plan.class_of_logit.push_back(c);
      }
    } else {
      for (int c = 0; c < manifest.classes; ++c) plan.class_of_logit.push_back(c);
    }
    if (labelled < manifest.train_pixels) {
      const double share = 100.0 * (1 - static_cast<double>(labelled) / static_cast<double>(manifest.train_pixels));
      plan.head_on_unlabelled_rays = !planner.leave(
          {"unlabelled_rays",
           fmt::format("{:.1f} % of training pixels carry no label; their semantic gradient is exactly 0", share),
           ProofClass::bitwise, fmt::format("{:.0f} % of the head's work in training", share)});
    }
  }
  if (request.passes > 1 && request.last_sampler_single_pass &&
      planner.leave({"coarse_passes", "the last pass's sampler finds the surface by itself", ProofClass::bitwise,
                     fmt::format("{} of {} networks", request.passes - 1, request.passes)})) {
    plan.first_pass = request.passes - 1;
  }
  if (!request.direction_encoder) {
    // Nothing to keep: without a direction encoder there is no input for the branch.
    plan.left_out.push_back({"view_branch", "the config asks for no direction encoder", ProofClass::bitwise,
                             "the colour's direction input"});
    plan.view_branch = false;
  }
  if (!manifest.any_distortion) {
    plan.undistortion = !planner.leave(
        {"undistortion", "every distortion coefficient is 0", ProofClass::bitwise, "Newton iterations a ray"});
  }
  if (!manifest.any_depth) {
    plan.depth_metrics = false;
    plan.left_out.push_back(
        {"depth_metrics", "the scene has no depth maps", ProofClass::bitwise, "depth buffers and their metrics"});
  }
  if (request.density_noise == 0) {
    plan.left_out.push_back(
        {"density_noise", "its deviation is 0", ProofClass::bitwise, "one normal variate a sample"});
  }
  if (!request.device_cuda_available) {
    plan.left_out.push_back({"cuda", "this build has no CUDA kernels", ProofClass::bitwise, "start-up of the device"});
  }
  if (!request.periodic_evaluation) {
    plan.left_out.push_back({"periodic_evaluation", "report.eval_every_s is 0", ProofClass::bitwise,
                             "rendering test frames while training"});
  }
  planner.refuse_unknown();
  return plan;
}

}  // namespace semfield
