// What a checkpoint says of its run beside the tensors, and whether a scene is still the one that it was trained on.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "core/error.h"
#include "formats/safetensors.h"
#include "labels/clicks/click_log.h"
#include "labels/training_labels.h"
#include "model/leave_out.h"

namespace semfield {

struct KnownScene {
  SceneManifest manifest;
  double pixel_footprint_m = 0;
};

/// One JSON object, the value of the metadata key `scene`.
std::string manifest_text(const KnownScene& scene);
/// Throws Error(data) when it cannot be read.
KnownScene read_manifest_text(const std::string& text);

struct CheckpointFacts {
  std::int64_t step = 0;
  double train_s = 0;
  std::uint32_t seed = 0;
  std::string config;               ///< the resolved YAML
  std::string classes;              ///< the class table as YAML; "" = none
  KnownScene scene;
  SceneInputs inputs;
  std::optional<EventsKnown>
      clicks;  ///< events of clicks that training knew; none: it had no clicks, or an earlier version
  std::map<std::string, std::string> modules;  ///< loaded plugin modules: name and checksum of each file
  std::string self_labels;  ///< the round of self-training whose labels train (session/self_training.h); "" = none
};

/// The metadata of a checkpoint, but for the checksums.
TensorMetadata checkpoint_metadata(const CheckpointFacts& facts, const std::string& config_hash);
/// `step` is what the file's name says. Throws Error(data) naming file and cause for another format, another step, a
/// missing or bad value.
CheckpointFacts read_checkpoint_facts(const TensorFile& file, std::int64_t step);
/// The same for a file whose name says no step.
CheckpointFacts read_checkpoint_facts(const TensorFile& file);

/// One warning where the counts of labels of a run that goes on are others: Error(data) where a class with a logit
/// would be another one. `keep`: components that were forced back in, then and now.
void compare_training_labels(const KnownScene& trained, const SceneManifest& now, const ClassTable& classes,
                             const std::vector<std::string>& keep, Diagnostics& diagnostics);

}  // namespace semfield
