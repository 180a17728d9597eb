// The one place that decides what a scene does not need, from its manifest and the config; each decision has its
// reason.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace semfield {

/// What is known of the scene before anything is built.
struct SceneManifest {
  int classes = 0;  ///< valid classes of the table
  std::vector<std::int64_t>
      train_class_pixels;  ///< [classes] labelled pixels of the training split, after label selection
  std::int64_t train_pixels = 0;
  std::int64_t train_frames = 0;
  std::int64_t labelled_frames = 0;
  bool any_depth = false;
  bool any_distortion = false;
};

/// What the config asks for, as far as it can be left out.
struct BuildRequest {
  int passes = 1;
  bool last_sampler_single_pass = false;
  bool direction_encoder = true;  ///< the last pass names one
  double density_noise = 0;
  double early_stop = 0;
  bool periodic_evaluation = true;
  bool device_cuda_available = false;
};

/// How "same result" is shown: bitwise equal, within a bound that is printed, or statistically over seeds.
enum class ProofClass : char { bitwise = 'B', certified = 'C', statistical = 'S' };

struct LeftOut {
  std::string component;  ///< the NAME of --keep
  std::string reason;     ///< the evidence, with numbers
  ProofClass proof = ProofClass::bitwise;
  std::string saving;  ///< estimate, in words
};

struct BuildPlan {
  bool semantics = true;
  bool view_branch = true;
  int first_pass = 0;  ///< earlier passes are not built
  bool head_on_unlabelled_rays = false;
  bool undistortion = true;
  bool depth_metrics = true;
  std::vector<int> class_of_logit;  ///< logit -> class; absent classes have none
  std::vector<LeftOut> left_out;    ///< what is not built
  std::vector<std::string> kept;    ///< forced back by name
};

/// `keep`: components forced back in. Throws Error(usage) for a name that is not left out here, listing those that are,
/// and for one that cannot be built (semantics without a class table).
BuildPlan plan_build(const SceneManifest& manifest, const BuildRequest& request, const std::vector<std::string>& keep);

}  // namespace semfield
