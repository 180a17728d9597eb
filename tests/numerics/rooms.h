// The analytic room as a dataset of the suite, and small networks on it: whole steps and whole pictures.
#pragma once

#include "core/non_copyable.h"
#include "execution/lane_executor.h"
#include "plugin/registry.h"
#include "tests/threads.h"
#include "train/session.h"
#include "train/trainer.h"

namespace semfield::numerics {

/// Passes and rendering of two kinds of network; to be put behind "scene: {type: box_room}\n". The hash grid
/// learns its encoding behind an occupancy grid; the frequency kind has the shape of [Zhi21], two passes.
extern const char* const kHashPass;
extern const char* const kFrequencyPass;

/// The analytic room (4 m x 3 m x 2 m) moved by `shift_m`.
std::unique_ptr<Dataset> shifted_room(Vec3d shift_m);

/// `known` and the dataset 'box_room', moved by `shift_m`: 12 frames of 48 x 36 pixels.
Registry with_room(const Registry& known, Vec3d shift_m = {});

/// Reads and opens a configuration, for the CPU unless it names a device. Throws Error with every problem.
Session open_room(const std::string& yaml, Registry& registry);

/// Colours of the first frame before any training.
std::vector<float> render_room_frame(const Registry& known, const std::string& yaml, Vec3d shift_m);

// A small scene of formulas with its pipeline, rays and trainer, from a configuration in text.

/// Two passes of the paper's shape, narrow, on the analytic room; `more` is YAML appended at the top
/// level.
std::string small_config(const std::string& more = "");
/// Hash grid behind an occupancy grid on the same room.
std::string grid_config(const std::string& more = "");

class TrainingBox : NonCopyable {
 public:
  /// `registry` with the dataset 'box_room' added. Throws Error(config).
  TrainingBox(const Registry& registry, const std::string& yaml);
  ~TrainingBox();

  Session& session() { return session_; }
  Pipeline<float>& pipeline() { return *session_.pipeline; }
  Trainer& trainer() { return trainer_; }
  /// Losses and gradients of a step without an update.
  StepLosses gradients(std::int64_t step);
  /// The batch of the last call of gradients.
  BatchBuffers& batch() { return batch_; }

  /// Every byte that a step may change: values and moments, by tensor.
  struct Kept {
    std::string name;
    std::vector<float> values, moments;
    bool operator==(const Kept&) const = default;
  };
  std::vector<Kept> state();

 private:
  ThreadScope one_thread_{1};  // results do not depend on it, and tiny steps are faster
  Registry registry_;
  Session session_;
  Trainer trainer_;
  BatchBuffers batch_;
};

}  // namespace semfield::numerics
