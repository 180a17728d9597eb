// What a run left behind: checkpoints and metrics.
#include <string>

#include "formats/safetensors.h"
#include "run/metrics_log.h"
#include "session/checkpoint_facts.h"
#include "tests/fuzz/inputs.h"
#include "tests/fuzz/targets.h"

namespace semfield::fuzz {

void fuzz_checkpoint(std::string_view bytes) {
  for (const bool with_checksums : {true, false}) {
    TensorFile::Limits limits;
    limits.require_checksums = with_checksums;
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

}  // namespace semfield::fuzz
