// The folder of one run: where each file lies, who may write in it, and on what machine it was made.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "core/error.h"
#include "core/files.h"
#include "formats/safetensors.h"
#include "model/leave_out.h"

namespace semfield {

/// Layout (all paths relative to the folder, which may be moved as a whole):
///   run.yaml  classes.yaml  clicks.jsonl (of the labelling page)  metrics.jsonl
///   environment.json  left_out.json  findings.txt  labels.json final_eval.json  worst_frames.json  labelling.json
///   report.html  .lock
///   self_labels/round_00010000.safetensors (runs with self-training)
///   checkpoints/step_00020000.safetensors + latest    render/<split>/<frame>_{rgb,label,label_vis,depth,entropy}.*
class RunFolder {
 public:
  /// For training from the start: the folder is created; one that holds files is refused. Holds the lock for its life.
  static RunFolder create(const std::string& path);
  /// Throws as create() would for a folder that is in use or holds files, and creates nothing: before work that a
  /// refusal would waste.
  static void require_new(const std::string& path);
  /// For going on with a run: the folder must hold run.yaml. Holds the lock for its life. Temporary files that killed
  /// processes left in it are removed.
  static RunFolder resume(const std::string& path);
  /// For evaluation and reports: no lock, nothing is created.
  static RunFolder read(const std::string& path);

  const std::string& path() const { return path_; }
  std::string config_path() const { return in("run.yaml"); }
  std::string classes_path() const { return in("classes.yaml"); }
  std::string metrics_path() const { return in("metrics.jsonl"); }
  std::string environment_path() const { return in("environment.json"); }
  std::string left_out_path() const { return in("left_out.json"); }
  std::string labelling_path() const { return in("labelling.json"); }
  /// What training found when it opened the scene, a finding a line: whoever opens the run again does not repeat it.
  std::string findings_path() const { return in("findings.txt"); }
  std::string labels_path() const { return in("labels.json"); }
  std::string final_eval_path() const { return in("final_eval.json"); }
  std::string worst_frames_path() const { return in("worst_frames.json"); }
  std::string report_path() const { return in("report.html"); }
  std::string checkpoints_path() const { return in("checkpoints"); }
  std::string self_labels_path() const { return in("self_labels"); }
  /// "render/test/0017_depth.png"; creates the folders. Slashes in a frame's name become '_'.
  std::string render_path(std::string_view split, std::string_view frame, std::string_view kind,
                          std::string_view extension = "png") const;

 private:
  explicit RunFolder(std::string path) : path_(std::move(path)) {}
  std::string in(std::string_view name) const;
  bool lock(bool may_create);
  bool take_new();
  std::string path_;
  FolderLock lock_;
};

/// What a result may depend on beside its configuration.
struct Environment {
  std::string version, source, compiler, build_type, cpu, cpu_features, abi;
  int hardware_threads = 0, threads = 0;
  std::uint64_t seed = 0;
  std::string input_hash;                                 ///< of the data set's manifest; "" when there is none
  std::vector<std::string> modules;                       ///< plugins in use, "name version"
  std::vector<std::string> settings_changed;              ///< "step 20: train.steps: 20 -> 40", by runs that went on
  std::vector<std::pair<std::string, std::string>> more;  ///< further facts, written under their names
};

/// Facts of this build and machine; seed, input_hash and modules are the caller's.
Environment this_environment();
std::string environment_json(const Environment& environment);
/// Name and value of every entry, in file order; lists joined by commas. Throws Error(data).
std::vector<std::pair<std::string, std::string>> parse_environment(std::string_view json, const std::string& name);

/// What the file says of earlier changes; empty where it says nothing. Throws Error(data).
std::vector<std::string> parse_settings_changed(std::string_view json, const std::string& name);

/// left_out.json: components that were not built because the scene does not need them. `saving_measured` is that of the
/// run, else shipped_saving, else null.
std::string left_out_json(const std::vector<LeftOut>& rows);

// The checkpoints of one run: written so that a good one exists at every moment, found again by verification.

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

// The shipped table of leave-out pairs (docs/reference/leave_out.json), as far as a run's own list needs it.

/// What leaving `component` out saved where it was measured, with the source; empty where no pair measured it.
std::string shipped_saving(const std::string& component);

}  // namespace semfield
