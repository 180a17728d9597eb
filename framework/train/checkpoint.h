// A checkpoint: its tensors, what it says of its run beside them, and whether a scene is still the one that it was
// trained on.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "core/error.h"
#include "formats/safetensors.h"
#include "labels/clicks.h"
#include "labels/training_labels.h"
#include "model/leave_out.h"
#include "model/param_store.h"

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
  std::string config;   ///< the resolved YAML
  std::string classes;  ///< the class table as YAML; "" = none
  KnownScene scene;
  SceneInputs inputs;
  std::optional<EventsKnown>
      clicks;  ///< events of clicks that training knew; none: it had no clicks, or an earlier version
  std::map<std::string, std::string> modules;  ///< loaded plugin modules: name and checksum of each file
  std::string self_labels;  ///< the round of self-training whose labels train (train/self_training.h); "" = none
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

/// Tensors of a checkpoint as they lie in the store: every learned and state tensor under its name, moments under
/// adam/m/NAME and adam/v/NAME. Borrowed.
std::vector<TensorRef> stored_tensors(const ParamStore<float>& store);
/// Throws Error(failure) naming the first of them that holds a number that is not finite; `step` is for the message.
void check_storable(const ParamStore<float>& store, std::int64_t step);
/// Into the store. Strict: every tensor must be there with its shape and, with `moments`, nothing else may be; without,
/// moments are not read. Throws Error(data) naming file and tensor; nothing has changed then.
void load_tensors(const TensorFile& file, ParamStore<float>& store, bool moments = true);

}  // namespace semfield
