// The checkpoints of one run: written so that a good one exists at every moment, found again by verification.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "core/error.h"
#include "formats/safetensors.h"

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

  /// For the run's own process: creates the folder when it is missing and removes temporary files that a killed process
  /// left. `keep` >= 2 newest checkpoints stay.
  explicit CheckpointStore(std::string folder, int keep = 2);
  /// For evaluation and rendering, also while another process trains: nothing is created or removed.
  static CheckpointStore read(std::string folder);

  /// Writes the checkpoint of `step` into a temporary file, syncs it, reads it back and verifies it, gives it its name,
  /// moves `latest`, and only then deletes older ones. Checkpoints of later steps belong to a course that this run has
  /// left: they get the suffix ".abandoned". Returns the path. Throws Error(io or cannot_create) that names the last
  /// checkpoint before, which is then untouched.
  std::string save(std::int64_t step, const std::vector<TensorRef>& tensors, const TensorMetadata& metadata);

  /// The newest checkpoint that verifies; each newer one that does not is reported as a warning. None without
  /// checkpoints; throws Error(data) when there are some but none verifies.
  std::optional<Found> find_latest(Diagnostics& diagnostics) const;

  /// By step, newest first; not verified. A missing folder holds none. Throws Error(io) when it cannot be read.
  std::vector<Entry> list() const;
  static std::string file_name(std::int64_t step);

  /// "the checkpoint of step 200 is kept", the newest that verifies, or that there is none: for messages about a failed
  /// write.
  std::string kept_text() const;

 private:
  struct Reading {};
  CheckpointStore(std::string folder, Reading) : folder_(std::move(folder)), keep_(2) {}
  std::string folder_;
  int keep_;
};

}  // namespace semfield
