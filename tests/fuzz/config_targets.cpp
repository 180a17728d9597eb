// Configuration files: the tree, composition with includes and values of the command line, runs and sweeps.
#include <sstream>

#include "config/compose.h"
#include "config/config_tree.h"
#include "report/sweep/sweep_file.h"
#include "settings/run_config.h"
#include "tests/fuzz/inputs.h"
#include "tests/fuzz/targets.h"

namespace semfield::fuzz {

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

}  // namespace semfield::fuzz
