// Configurations, what a run left behind, and the table of all targets.
#include <algorithm>
#include <sstream>

#include "config/compose.h"
#include "config/config_tree.h"
#include "formats/safetensors.h"
#include "objects/object_edits.h"
#include "report/sweep/sweep_file.h"
#include "run/metrics_log.h"
#include "session/checkpoint_facts.h"
#include "session/settings/run_config.h"
#include "tests/fuzz/inputs.h"
#include "tests/fuzz/targets.h"

namespace semfield::fuzz {

// Configuration files: the tree, composition with includes and values of the command line, runs and sweeps.

namespace {

void written_reads_back(std::string_view yaml) {
  ConfigNode tree;
  if (!accepted([&] { tree = parse_config_text(yaml, "main.yaml"); })) return;
  ConfigNode again, inline_again;
  promise(accepted([&] { again = parse_config_text(write_config(tree), "written"); }),
          "what is written cannot be read");
  promise(equal_config(tree, again), "what is written reads back as something else");
  promise(accepted([&] { inline_again = parse_config_value(write_config_inline(tree), "--set a"); }),
          "what is written in one line cannot be read");
  promise(equal_config(tree, inline_again), "what is written in one line reads back as something else");
}

std::vector<std::string> lines_of(std::string_view text) {
  std::vector<std::string> out;
  std::istringstream in{std::string(text)};
  for (std::string line; std::getline(in, line);) out.push_back(line);
  return out;
}

}  // namespace

// Parts: the file, a file part.yaml that it may include, lines of --set.
void fuzz_config(std::string_view bytes) {
  const auto parts = parts_of(bytes, 3);
  written_reads_back(parts[0]);
  const std::string main = put("main.yaml", parts[0]);
  put("part.yaml", parts[1]);
  accepted([&] {
    const ConfigNode tree = compose_config(main, lines_of(parts[2]));
    if (tree.find("plugins") != nullptr) return;  // would load code
    Diagnostics diagnostics;
    const RunConfig run = read_run_config(tree, registry(), diagnostics);
    if (diagnostics.has_errors()) return;
    const ConfigNode resolved = resolved_config(run);
    Diagnostics second;
    ConfigNode read_back = parse_config_text(write_config(resolved), "run.yaml");
    const RunConfig same = read_run_config(read_back, registry(), second);
    promise(!second.has_errors(), "a resolved configuration is refused");
    promise(equal_config(resolved, resolved_config(same)), "a resolved configuration reads back as another run");
  });
}

// Parts: the sweep, a base configuration part.yaml.
void fuzz_sweep(std::string_view bytes) {
  const auto parts = parts_of(bytes, 2);
  const std::string main = put("sweep.yaml", parts[0]);
  put("part.yaml", parts[1]);
  accepted([&] { (void)read_sweep(main); });
}

// What a run left behind: checkpoints and metrics.

void fuzz_checkpoint(std::string_view bytes) {
  for (const bool with_checksums : {true, false}) {
    TensorFile::Limits limits{.require_checksums = with_checksums};
    accepted([&] {
      const TensorFile file = TensorFile::decode(std::string(bytes), "a.safetensors", limits);
      for (const TensorRef& tensor : file.tensors()) {
        std::uint64_t count = 1;
        for (const std::int64_t axis : tensor.shape) count *= static_cast<std::uint64_t>(axis);
        promise(tensor.bytes.size() == count * tensor_type_bytes(tensor.type), "bytes that do not fill the shape");
        accepted([&] { (void)file.floats(tensor.name, static_cast<std::int64_t>(count)); });
      }
      accepted([&] { (void)read_manifest_text(file.metadata()); });
      (void)read_checkpoint_facts(file, 2);
    });
  }
}

void fuzz_metrics(std::string_view bytes) {
  accepted([&] {
    const std::vector<MetricsRow> rows = parse_metrics(bytes, "metrics.jsonl");
    std::string written;
    for (const MetricsRow& row : rows) written += metrics_line(row) + "\n";
    std::vector<MetricsRow> again;
    promise(accepted([&] { again = parse_metrics(written, "written"); }), "what is written cannot be read");
    promise(again.size() == rows.size(), "what is written has other rows");
  });
}

// Parts: edits.json, then found.safetensors, which may hold any bytes; its checksums are corrected.
void fuzz_objects(std::string_view bytes) {
  constexpr int kClasses = 3;
  const auto parts = parts_of(bytes, 2);
  const std::string edits_file = put("objects/edits.json", parts[0]);
  std::string found(parts[1]);
  accepted([&] {
    const TensorFile::Limits limits{.refuse_nonfinite = false, .require_checksums = false};
    const TensorFile file = TensorFile::decode(found, "found.safetensors", limits);
    if (file.find("") == nullptr) found = encode_safetensors(file.tensors(), file.metadata());
  });
  const std::string found_file = put("objects/found.safetensors", found);
  ObjectSet set;
  if (!accepted([&] { set = read_object_set(found_file, kClasses); })) return;
  const auto is_whole = [](const ObjectSet& one) {
    for (const std::int32_t id : one.id) promise(id >= 0 && id <= std::ssize(one.rows), "an object without a row");
    for (const std::int16_t index : one.class_of) promise(index >= kVoid && index < kClasses, "a class that is none");
    for (const ObjectRow& row : one.rows)
      promise(row.class_index >= kVoid && row.class_index < kClasses && row.points >= 0 && row.views >= 0,
              "a row that cannot be");
  };
  is_whole(set);
  const std::string written = folder() + "/objects/written.safetensors";
  write_object_set(written, set);
  promise(read_object_set(written, kClasses).digest() == set.digest(), "objects that read back as others");
  accepted([&] {
    ObjectEdits edits = read_object_edits(edits_file);
    const std::string text = put("objects/again.json", object_edits_text(edits));
    promise(object_edits_text(read_object_edits(text)) == object_edits_text(edits), "edits that read back as others");
    edits.digest = set.digest();
    apply_edits(set, edits, edits_file);
  });
  is_whole(set);
}

std::span<const Target> targets() {
  static constexpr Target kTargets[] = {
#define TARGET(name) {#name, fuzz_##name},
#include "targets.inc"
  };
  return kTargets;
}

const Target* find_target(std::string_view name) {
  const auto all = targets();
  const auto found = std::find_if(all.begin(), all.end(), [&](const Target& t) { return t.name == name; });
  return found == all.end() ? nullptr : &*found;
}

}  // namespace semfield::fuzz
