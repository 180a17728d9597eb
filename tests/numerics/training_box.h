// A small scene of formulas with its pipeline, rays and trainer, from a configuration in text.
#pragma once

#include "plugin/registry.h"
#include "session/session.h"
#include "session/trainer.h"
#include "thread_scope.h"

namespace semfield::numerics {

/// Two passes of the paper's shape, narrow, on the analytic room (box_room.h); `more` is YAML appended at the top
/// level.
std::string small_config(const std::string& more = "");
/// Hash grid behind an occupancy grid on the same room.
std::string grid_config(const std::string& more = "");

class TrainingBox {
 public:
  /// `registry` with the dataset 'box_room' added. Throws Error(config).
  TrainingBox(const Registry& registry, const std::string& yaml);
  ~TrainingBox();
  TrainingBox(const TrainingBox&) = delete;
  TrainingBox& operator=(const TrainingBox&) = delete;

  Session& session() { return session_; }
  Pipeline<float>& pipeline() { return *session_.pipeline; }
  Trainer& trainer() { return *trainer_; }
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
  std::unique_ptr<RaySource> rays_;
  std::unique_ptr<Trainer> trainer_;
  BatchBuffers batch_;
};

}  // namespace semfield::numerics
