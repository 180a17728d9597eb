// The checkpoints of one run: written so that a good one exists at every moment, found again by verification.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "core/error.h"
#include "train/safetensors.h"

namespace semfield {

/// A folder of `step_00020000.safetensors` files and `latest`, a text file that names the last one saved.
class CheckpointStore {
 public:
  struct Entry {
    std::int64_t step = 0;
    std::string path;
  };
  struct Found {
    std::int64_t step = 0;
    std::string path;
    TensorFile file;
  };

  /// Creates the folder when it is missing and removes temporary files that a killed process left. `keep` >= 2 newest
  /// checkpoints stay.
  explicit CheckpointStore(std::string folder, int keep = 2);

  /// Writes the checkpoint of `step` atomically, reads it back and verifies it, moves `latest`, and only then deletes
  /// older ones. Checkpoints of later steps belong to a course that this run has left: they get the suffix
  /// ".abandoned". Returns the path. Throws Error(io) that names the last good checkpoint, which is then untouched.
  std::string save(std::int64_t step, const std::vector<TensorRef>& tensors, const TensorMetadata& metadata);

  /// The newest checkpoint that verifies; each newer one that does not is reported as a warning. None without
  /// checkpoints; throws Error(data) when there are some but none verifies.
  std::optional<Found> find_latest(Diagnostics& diagnostics) const;

  /// By step, newest first; not verified.
  std::vector<Entry> list() const;
  static std::string file_name(std::int64_t step);

 private:
  std::string folder_;
  int keep_;
};

}  // namespace semfield
