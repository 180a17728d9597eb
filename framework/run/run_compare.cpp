// Two runs' newest checkpoints against each other.
#include "run/run_compare.h"

#include <fmt/format.h>

#include <algorithm>

#include "core/text.h"
#include "run/checkpoint_store.h"
#include "run/run_folder.h"
#include "session/checkpoint_facts.h"
#include "settings/run_identity.h"

namespace semfield {

namespace {

struct Side {
  TensorFile file;
  CheckpointFacts facts;
};

Side read_side(const std::string& folder, Diagnostics& diagnostics) {
  std::optional<CheckpointStore::Found> found =
      CheckpointStore::read(RunFolder::read(folder).checkpoints_path()).find_latest(diagnostics);
  if (!found) {
    throw Error(ErrorKind::no_input, folder + ": the run has no checkpoint yet",
                "train it from step 0 with `semfield train --resume " + shell_word(folder) + "`");
  }
  Side side;
  side.facts = read_checkpoint_facts(found->file, found->step);
  side.file = std::move(found->file);
  return side;
}

// Of one tensor that both have.
std::string difference_of(const TensorRef& a, const TensorRef& b) {
  if (a.type != b.type || a.shape != b.shape) return fmt::format("tensor '{}' has another shape", a.name);
  const auto [left, right] = std::mismatch(a.bytes.begin(), a.bytes.end(), b.bytes.begin());
  if (left == a.bytes.end()) return {};
  const auto element = static_cast<std::size_t>(left - a.bytes.begin()) / tensor_type_bytes(a.type);
  return fmt::format("tensor '{}' differs from element {} on", a.name, element);
}

std::string difference_of_tensors(const TensorFile& a, const TensorFile& b) {
  for (const TensorRef& tensor : a.tensors()) {
    const TensorRef* other = b.find(tensor.name);
    if (other == nullptr) return fmt::format("tensor '{}' is in the first alone", tensor.name);
    if (const std::string found = difference_of(tensor, *other); !found.empty()) return found;
  }
  for (const TensorRef& tensor : b.tensors()) {
    if (a.find(tensor.name) == nullptr) return fmt::format("tensor '{}' is in the second alone", tensor.name);
  }
  return {};
}

std::string first_difference(const Side& a, const Side& b) {
  const ConfigNode left = parse_config_text(a.facts.config, a.file.name()),
                   right = parse_config_text(b.facts.config, b.file.name());
  for (const ConfigDifference& change : changed_settings(left, right)) {
    if (is_part_of_identity(change.key)) return change.text();
  }
  if (a.facts.classes != b.facts.classes) return "the class tables differ";
  if (a.facts.inputs && b.facts.inputs && a.facts.inputs->hash() != b.facts.inputs->hash()) {
    return "the scenes differ in frames, cameras or images";
  }
  if (a.facts.step != b.facts.step) return fmt::format("step: {} -> {}", a.facts.step, b.facts.step);
  return difference_of_tensors(a.file, b.file);
}

}  // namespace

RunComparison compare_runs(const std::string& folder_a, const std::string& folder_b, Diagnostics& diagnostics) {
  const Side a = read_side(folder_a, diagnostics), b = read_side(folder_b, diagnostics);
  return {first_difference(a, b), a.facts.step, a.file.tensors().size()};
}

}  // namespace semfield
