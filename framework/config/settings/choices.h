// What is decided where the configuration leaves it open: cameras, device, labels, pace and length of a run; and which
// settings make it that run.
#pragma once

#include <cstdint>
#include <deque>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "config/explain.h"
#include "config/settings/run_config.h"
#include "core/error.h"
#include "core/view.h"
#include "labels/training_labels.h"
#include "plugin/registry.h"

namespace semfield {

// What a scene decides of corrections of its cameras, where the configuration leaves it open.

struct CameraEvidence {
  bool tracked = false;            ///< SceneInfo::tracked
  std::optional<double> exposure;  ///< LoadedScene::exposure
  std::optional<bool> fits = {};   ///< the photographs, by LoadedScene::cameras; nothing: they say nothing
};

/// Brightness of overlapping frames that differs by more than this factor is a camera's that changes its exposure.
/// Renderings differ by 1.001, photographs with a fixed exposure by 1.003 to 1.02, the HoloLens room by 1.12 (decision
/// 40).
inline constexpr double kExposureChanges = 1.05;

/// Why `auto` became what it did; empty where it was not asked for.
struct CameraReasons {
  std::string poses, colors;
  std::vector<std::string> learned;  ///< a line for each that is learned, which no list of parts left out has
};

/// Puts what `auto` is in place of it. Poses: learned where a phone's tracker gave them and photographs do not say that
/// they fit; far wrong ones are for `prepare` to fix. Colours: learned where brightness changes.
CameraReasons choose_cameras(CameraParams& cameras, const CameraEvidence& evidence);

// Where a run computes and in which precision: what its settings ask for, held against what build and machine have.

struct ChosenDevice {
  DeviceId device;
  std::string no_cuda;  ///< why it is the CPU
};
/// The device that the run's configuration asks for; its kernels are then in the registry's tables. `auto` is the first
/// cuda device where build and machine have it and every part of the passes and term of the loss has kernels for it;
/// one without them is noted and leaves the run on the CPU. Throws Error(unavailable) with the reason when a cuda
/// device is asked for and cannot be had.
ChosenDevice chosen_device(const RunConfig& config, Registry& registry, Diagnostics& diagnostics);
/// runtime.precision, or what `auto` is there: bf16 where the device computes it faster and every field has kernels.
Precision precision_of(const RunConfig& config, const Registry& registry, DeviceId device);
/// Sizes that the configuration leaves to the device become numbers: rays of a step, and what plugins of passes leave
/// to it. "train.rays: sentence" each.
std::vector<std::string> choose_for_device(RunConfig& config, Device device);
/// CUDA kernels of linked plugins and loaded modules into the registry's tables; a device is not needed. Throws
/// Error(unavailable) when the build has none.
void add_cuda_kernels(Registry& registry);
/// As chosen_device where a device is there and its tables are in the registry.
ChosenDevice device_for_parts(const RunConfig& config, const Registry& registry, Diagnostics& diagnostics);

/// A finding for each way in which `device` trains more slowly than it could: what it costs, and the setting that has
/// the fast way. runtime.precision must be settled; `bf16_instructions`: the CPU computes bf16 by instructions of its
/// own (bf16_is_native).
void say_slow_paths(const RunConfig& config, const Registry& registry, DeviceId device, bool bf16_instructions,
                    Diagnostics& diagnostics);

// What the labels that train decide: which of a pass's semantic branches is built, and where rays come from.

/// What can be seen of training labels without knowing whether they are right.
struct LabelStatistics {
  std::int64_t pixels = 0, labelled = 0;   ///< of all training frames
  std::int64_t neighbours = 0, equal = 0;  ///< labelled pixels beside or above one another; those with equal labels
  /// The same of labelled pixels that have no labelled pixel between them, in a row or column, and are 2 to kReach
  /// apart.
  std::int64_t apart = 0, apart_equal = 0;
  double share() const { return part(labelled, pixels, 0); }
  double agreement() const { return part(equal, neighbours, 1); }
  double agreement_apart() const { return part(apart_equal, apart, 1); }
  /// Whether enough of them lie side by side, or near one another, to say that they agree.
  bool side_by_side() const { return 2 * neighbours >= labelled && neighbours > 0; }
  bool near_one_another() const { return 2 * apart >= labelled && apart > 0; }

 private:
  static double part(std::int64_t of, std::int64_t all, double none) {
    return all > 0 ? static_cast<double>(of) / static_cast<double>(all) : none;
  }
};
inline constexpr std::int32_t kReach = 32;
LabelStatistics label_statistics(const LoadedScene& scene, const TrainingLabels& labels);

/// Neighbouring pixels lie on one surface more often than not: of right labels of rooms more than 19 in 20 pairs agree;
/// thin things in small frames leave fewer. Where fewer than kAgreement do, labels are noisy. On a grid of 8 to 32
/// pixels 0.86 to 0.44 of the pairs of right labels agree (Replica walk, 320 and 160 pixels wide), and 0.23 to 0.10
/// where half of the labels are wrong; the border there is kAgreementApart. Labels of under kFewShare of all pixels are
/// few, those of kDenseShare and more are dense; the others are many. Few labels that have hardly a neighbour, such as
/// clicks, cannot be seen to be noisy.
inline constexpr double kAgreement = 0.8, kAgreementApart = 0.3, kFewShare = 0.002, kDenseShare = 0.5;
LabelKind kind_of(const LabelStatistics& statistics);

/// Leaves each pass the first branch for these labels, or for any. A sentence for each pass that had a choice.
std::vector<std::string> choose_branches(RunConfig& config, const LabelStatistics& statistics);

/// How many training pixels have a label, and whether such may come later: clicks, or labels that a program sets.
struct LabelCount {
  std::int64_t labelled_px = 0, train_px = 0;
  bool may_come = false;
};
/// Puts what `auto` is in place of it: label_balanced where labels are or may come, else all_images. Returns a
/// sentence, or "".
std::string choose_ray_source(TrainParams& train, const LabelCount& labels);
/// Warns where rays are drawn evenly by hand although under kRareShare of the pixels have a label: steps then hardly
/// see one.
inline constexpr double kRareShare = 0.05;
void warn_of_rare_labels(const TrainParams& train, const LabelCount& labels, Diagnostics& diagnostics);

// How many steps fit into the time that a run was asked to train, from the rate of its own steps.

/// Reads no clock: it is given seconds of training. The number of steps is settled after a tenth of the time, once
/// the rate holds still, and after a quarter of it at the latest: steps become faster as space empties. Where the rate
/// has changed since for longer than a moment, so that the end would miss the time by more than a twelfth of it, the
/// number is settled anew; also when it is reached more than a tenth of the time too early.
class Pace {
 public:
  /// For what is trained between two times of training, in seconds.
  Pace(double begin_s, double until_s);

  /// After steps were made: `step` of them in `train_s` seconds of training. `end`: steps of the run at its end, 0
  /// while they are not settled. Returns the end where it is settled now.
  std::optional<std::int64_t> made(std::int64_t step, double train_s, std::int64_t end);

  /// Of the last tenth of the time; 0 before two steps were made.
  double steps_per_s() const;

 private:
  struct Mark {
    double s = 0;
    std::int64_t step = 0;
  };
  bool still() const;
  double misses_by(double steps_per_s, std::int64_t end) const;
  std::int64_t end_at_this_rate() const;

  double begin_s_, until_s_, share_s_;
  std::deque<Mark> marks_;  // one a share of the time, newest last
  Mark settled_;            // when the number was settled last
};

// How long a run trains and what its learning rate does meanwhile: asked for in steps or in seconds, settled in steps.

/// Steps that a run trains when nobody says how many: about a minute on two cores, some seconds on a GPU.
inline constexpr std::int64_t kStepsOnCpu = 3000, kStepsOnGpu = 20000;

/// What somebody asks a run for; one of both, or neither.
struct AskedLength {
  std::int64_t steps = 0;
  double seconds = 0;
  bool any() const { return steps > 0 || seconds > 0; }
};

/// Steps of the run at its end; 0: not settled yet.
std::int64_t last_step(const RunConfig& config);
/// Seconds of training of the run at its end, as they were asked for; 0: nobody did.
double end_s(const RunConfig& config);

/// "3000 steps", "20 s of training".
std::string length_text(const RunConfig& config);

/// Length and schedule of a run that begins: the rate falls to its factor at the end.
void ask(RunConfig& config, const AskedLength& asked);
/// That much more for a run that has made `step` steps in `train_s` seconds: a further leg, which begins at half of the
/// first rate where the rate has fallen below that, and falls to the factor at the new end. What was left of the length
/// so far is not trained beside it.
void ask_more(RunConfig& config, const AskedLength& asked, std::int64_t step, double train_s);

/// When a session opens: the device settles a length that nobody asked for, and the schedule follows train.steps. Until
/// a time has been settled the rate is held. A sentence about the device's choice, or "".
std::string resolve_length(RunConfig& config, Device device);
/// A run that was asked for in seconds, and has made `step` steps, ends at `end`: it holds its rate until now, and
/// falls from now on. Also where that had been settled before.
void settle(RunConfig& config, std::int64_t step, std::int64_t end);

/// Errors for what can never work in a run of this length: a warm-up beyond its end, terms of the loss that begin
/// there.
void check_length(const RunConfig& config, Diagnostics& diagnostics);

// Which settings make a run the run that it is, and which may change while it goes on.

/// Not: a run's length, what it prints, measures and keeps beside the tensors, the machine's part in it (threads,
/// memory, device), and where files lie.
bool is_part_of_identity(std::string_view key_path);
/// What is no part of the identity, and what helps a run over a step that failed: optimiser, schedule, seed, precision.
/// Everything else would make it another run.
bool may_change_on_resume(std::string_view key_path);

/// Equal for runs whose settings are the same but for those that are no part of the identity.
std::string identity_hash(const RunConfig& config);

/// Throws Error(no_input) naming the setting and `--set` when a place that run.yaml names for the scene or its label
/// files, but for clicks, is not there any more.
void require_scene_places(const RunConfig& config, const std::string& run_dir);

/// The text of run.yaml, which has been read back: Error(config) names what could never be read again, such as a
/// derived value beyond the range of its setting or a path that is no UTF-8.
std::string run_config_text(const RunConfig& config, Registry& registry);

}  // namespace semfield
