// What train, eval and render share: configuration, loaded scene, plan and pipeline.
#pragma once

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "config/settings/run_config.h"
#include "eval/evaluator.h"
#include "execution/ranks/ranks.h"
#include "model/leave_out.h"
#include "train/assembly.h"
#include "train/checkpoint.h"
#include "train/ray_source.h"

namespace semfield {

struct Session {
  RunConfig config;
  LoadedScene scene;
  TrainingLabels labels;  ///< of training frames; the scene's own stay in `scene` as the truth
  SceneManifest manifest;
  BuildPlan plan;
  SceneExtent extent;
  std::vector<std::string> chosen;            ///< a line for each parameter that was chosen from the scene
  std::vector<std::string> chosen_by_device;  ///< and for each size that the device decided
  /// And for each choice that the labels made (settings/choices.h), and each correction of cameras.
  std::vector<std::string> chosen_by_labels;
  RayLimits limits;
  std::unique_ptr<Pipeline<float>> pipeline;

  /// What this session's work is done with; borrows from it.
  WorkSettings work() const;
  int classes() const { return scene.info.classes.valid_count(); }
  std::vector<std::string> choices() const;  ///< all of them
  EvalJob eval_job(std::vector<int> frames) const;
  SplitScore evaluate(const EvalJob& job) const;
  /// Inverse of plan.class_of_logit, kVoid for absent classes.
  std::vector<std::int16_t> logit_of_class() const;
  /// Training frames with pixels: those of the ray source, in its order.
  std::vector<int> drawn_frames() const;
  std::unique_ptr<RaySource> make_ray_source() const;
};

/// Adds components to `runtime.keep`, which is part of the resolved configuration: whoever opens the run again must
/// build the same network.
void keep_components(RunConfig& config, const std::vector<std::string>& components);

/// The scene that was loaded last, as it was loaded: later sessions of this process that would load an equal one copy
/// it.
struct KeptScene {
  std::string settings;  ///< all that reaches the loader; "": none is kept
  LoadedScene scene;
  Diagnostics found;
};

struct SessionOptions {
  std::vector<std::string> keep;  ///< components forced back in
  bool trainable = true;
  bool build = true;                  ///< false: stop after the plan
  DepthKept depth = DepthKept::test;  ///< what a later evaluation compares with
  /// What training knew of the scene (checkpoint.h); then the training labels are not made again.
  std::optional<KnownScene> known;
  bool pixels = true;          ///< false, with `known`: no pixel is read. Enough to render, not to evaluate.
  bool probe = false;          ///< let a short training find the bounds of a scene that only guesses them
  Ranks* ranks = nullptr;      ///< processes that this session's work is shared with; null: none
  bool instances = false;      ///< keep the instances of frames
  bool labels = false;         ///< make the training labels although `known` is given
  KeptScene* kept = nullptr;   ///< looked at before the scene is loaded, and replaced; null: it is loaded
  LoadProgress progress = {};  ///< told while the scene is opened; null: whom the caller's WorkSettings tell
  /// The class table that the network was trained with, as YAML; a scene with another one is refused.
  std::optional<std::string> trained_classes;
};

/// Loads the scene, selects labels, decides what is left out, fixes bounds and distances in `config.load`, and
/// assembles; pixels that do not fit into memory are refused before they are read.
/// Problems that do not stop go into `diagnostics`; those that do are thrown together.
Session open_session(RunConfig config, Registry& registry, const SessionOptions& options, Diagnostics& diagnostics);

/// The labels that train, scored against the scene's own on `frames`; void labels are dropped and counted.
ConfusionMatrix score_training_labels(const Session& session, const std::vector<int>& frames);

/// `train --dry-run`: scene, network, and every component left out with its reason.
std::string describe_session(const Session& session);

// A session whose steps and rendering are those of several processes. Rank 0 alone reads the scene and writes files;
// the others get from it what their networks are made of, and follow.

/// What the other ranks do until rank 0 calls dismiss: they serve the sessions that it leads, one after the other.
/// Throws RankLost.
void follow(Ranks& ranks, Registry& registry);
/// Rank 0, when it leads no session any more.
void dismiss(Ranks& ranks);

/// All ranks, once: those that may run on the same cores share them (set_thread_count). Returns a sentence about
/// processes and threads. Throws Error(unavailable) where ranks are programs of different versions, or where CPUs
/// would compute with different instructions, so that the ranks' tensors would drift apart.
std::string prepare_ranks(Ranks& ranks, const std::string& version);

}  // namespace semfield
