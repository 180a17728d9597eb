// The one place that decides what a scene does not need, from its manifest and the config; each decision has its
// rule and its evidence.
#pragma once

#include <cstdint>
#include <set>
#include <string>
#include <vector>

#include "plugin/loss.h"
#include "plugin/sampler.h"

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
  /// Widest angle in degrees between a training ray and their mean, twice; 360: unknown.
  double direction_spread_deg = 360;
};

/// A loss, and whether the list names it.
struct LossRequest {
  std::string name;
  std::string saves;  ///< what its absence saves, in words
  bool named = false;
  LossTraits traits;  ///< of one that is named
};

/// What the config asks for, as far as it can be left out.
struct BuildRequest {
  int passes = 1;
  std::string last_pass = "passes.main";  ///< its key
  bool last_sampler_single_pass = false;
  EmptySpace empty_space = EmptySpace::sampled;      ///< of the last pass's sampler
  bool direction_encoder = true;                     ///< the last pass names one
  std::vector<LossRequest> losses;                   ///< every loss that the list `losses` might name
  std::vector<std::string> heads;                    ///< channels that heads of the list `heads` make
  bool trained = false;                              ///< the network is another session's, so all its heads are built
  std::set<std::string> channels;                    ///< further channels that training frames offer
  bool learns_poses = false, learns_colors = false;  ///< of training cameras
  std::string poses_why, colors_why;                 ///< what the scene says of it, where it was asked
  double density_noise = 0;
  double early_stop = 0;
  bool balance_classes = false;
  bool mixed_precision = false;
  bool periodic_evaluation = true;
  std::string no_cuda = "no device is asked for";  ///< why the run stays on the CPU; empty: it does not
  std::int64_t training_depth_px = 0;  ///< pixels whose depth was read for the bounds and is needed by nothing later
  /// Training frames with depth images, and their pixels with a valid depth, for terms that read them; < 0: not
  /// counted.
  std::int64_t depth_frames = -1, depth_px = -1;
};

/// How "same result" is shown: bitwise equal, within a bound that is printed, or statistically over seeds.
enum class ProofClass : char { bitwise = 'B', certified = 'C', statistical = 'S' };

struct LeftOut {
  std::string component;  ///< the NAME of --keep
  std::string rule;       ///< when it is left out
  std::string evidence;   ///< what was found here, with numbers
  ProofClass proof = ProofClass::bitwise;
  std::string saving{};   ///< estimate, in words
  std::string instead{};  ///< what brings it in where --keep cannot ("set runtime.precision: bf16"); empty: --keep does
  std::string measured{};  ///< by the run itself; empty: not
};

struct BuildPlan {
  bool semantics = true;
  bool view_branch = true;
  int first_pass = 0;  ///< earlier passes are not built
  bool head_on_unlabelled_rays = false;
  bool undistortion = true;
  std::int64_t learned_poses = 0, learned_colors = 0;  ///< training cameras whose corrections are learned
  bool late_samples = false;                           ///< rendering evaluates samples behind an opaque surface too
  std::vector<std::string> no_losses;                  ///< types of the list `losses` that are not built
  std::vector<std::string> no_heads;                   ///< channels of heads that are not built
  std::vector<int> class_of_logit;                     ///< logit -> class; absent classes have none
  std::vector<LeftOut> left_out;                       ///< what is not built
  std::vector<std::string> kept;                       ///< forced back by name
};

/// What only the built parts know.
struct BuiltParts {
  std::vector<std::string> sizes;  ///< a sentence for each size that the configuration leaves open
  std::int64_t learned = 0;        ///< values
  std::int64_t in_tables = 0;      ///< of them, values of tables
  bool image_library = false;      ///< this build has one
  bool images_loaded = false;      ///< the process has loaded it
  bool mpi = false;                ///< this build can join other processes
  int processes = 1;               ///< that share the work
};

/// A ray may stop at this transmittance: colours in [0, 1] are then off by at most a quarter of an 8-bit step.
inline constexpr double kEightBitStop = 1.0 / 1020;
/// Training rays within this angle of each other cannot tell a surface that shines from one that does not.
inline constexpr double kDirectionSpreadDeg = 5;

/// Component of the depth of training frames; what keeps it must be known before the scene is loaded.
inline constexpr const char* kTrainingDepth = "training_depth";

/// `keep`: components forced back in; one that the scene needs anyway is no error, so that one list fits several
/// scenes. Throws Error(usage) for a name that no rule has, listing those that can be kept, for one that a setting
/// brings in, and for one that cannot be built (semantics without a class table).
BuildPlan plan_build(const SceneManifest& manifest, const BuildRequest& request, const std::vector<std::string>& keep);

/// Adds to the plan's list what the built parts do without.
void add_built_rows(const BuiltParts& built, BuildPlan& plan);

}  // namespace semfield
