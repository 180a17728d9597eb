// G06 to G08: configurations.
#include <algorithm>

#include "box_room.h"
#include "config/config_tree.h"
#include "input_parts.h"

namespace semfield::numerics {

namespace {

std::string times(const std::string& part, int count) {
  std::string out;
  out.reserve(part.size() * static_cast<std::size_t>(count));
  for (int i = 0; i < count; ++i) out += part;
  return out;
}

// Refused with a place, within 100 ms and 64 MiB of this thread.
void refused_quickly(CaseRun& run, const std::string& yaml, const std::vector<std::string>& words) {
  const ResourceUse use;
  std::vector<std::string> all = words;
  all.emplace_back("deep.yaml:");
  run.expect_error(ErrorKind::config, all, [&] { (void)parse_config_text(yaml, "deep.yaml"); });
  run.measure(use.seconds(), 0.1, "seconds");
  run.measure(use.grown_mib() / 640, 0.1, "memory, 64 MiB being 0.1");
}

}  // namespace

void deep_yaml(CaseRun& run) {
  run.row("-");
  run.note("error: CPU seconds of the slowest; memory stays below 64 MiB");
  const int n = 100'000;
  refused_quickly(run, times("[", n), {"nested deeper than 64 levels"});
  refused_quickly(run, times("[", n) + times("]", n), {"nested deeper than 64 levels"});
  refused_quickly(run, times("[[:", n / 3), {"nested deeper than 64 levels"});
  refused_quickly(run, times("{foo: ", n), {"nested deeper than 64 levels"});
  refused_quickly(run, times("- ", n) + "x", {});
  refused_quickly(run, times("? ", n) + "x", {});
  refused_quickly(run, times("a: [", n), {});
  refused_quickly(run, "a: \"" + times("x", n), {"not closed"});
  refused_quickly(run, "a: '" + times("''", n), {"not closed"});
  std::string stairs;
  for (int i = 0; i < 1000; ++i) stairs += std::string(static_cast<std::size_t>(i), ' ') + "k:\n";
  refused_quickly(run, stairs, {});
  refused_quickly(run, times("k: v\n", 300'000), {});  // over 1 MiB
  std::string sixty;
  for (int i = 0; i < 60; ++i) sixty += "[";
  (void)parse_config_text(sixty + std::string(60, ']'), "deep.yaml");
  run.expect(true, "60 levels are read");
}

void alias_bombs(CaseRun& run) {
  run.row("-");
  run.note("error: CPU seconds of the slowest");
  std::string bomb = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n";
  for (int i = 1; i < 9; ++i) {
    const std::string last = "*a" + std::to_string(i - 1), name = "a" + std::to_string(i);
    bomb += name + ": &" + name + " [" + times(last + ", ", 8) + last + "]\n";
  }
  refused_quickly(run, bomb, {"deep.yaml:1:5", "anchors are not allowed"});
  refused_quickly(run, "a: &x [*x]\n", {"deep.yaml:1:4", "anchors are not allowed"});
  refused_quickly(run, "a: *x\n", {"deep.yaml:1:4", "aliases are not allowed"});
  refused_quickly(run, "a: &x {b: *x}\nc: *x\n", {"anchors are not allowed"});
  refused_quickly(run, "<<: {a: 1}\n", {"merge keys are not allowed"});
  refused_quickly(run, "a: !!python/object/apply:os.system [x]\n", {"tags are not allowed"});
}

void yaml_mistakes(CaseRun& run) {
  run.row("-");
  Registry registry = with_room(run.registry());
  const std::string good = std::string("scene: {type: box_room}\n") + kHashPass;
  const auto findings = [&](const std::string& yaml) {
    Diagnostics found;
    (void)read_run_config(parse_config_text(yaml, "room.yaml"), registry, found);
    std::string text;
    for (const Diagnostic& one : found.all()) text += one.text() + "\n";
    return text;
  };
  run.expect(findings(good).empty(), "the control is read without a finding");
  const auto refused = [&](const std::string& line, const std::vector<std::string>& words) {
    const std::string text = findings(good + line + "\n");
    run.expect(text.find("room.yaml:10:") != std::string::npos, line + " is told with its line: " + text);
    for (const std::string& word : words) run.expect(text.find(word) != std::string::npos, word + " in: " + text);
  };
  run.expect(std::count(good.begin(), good.end(), '\n') == 9, "added lines are line 10");
  refused("sematics: {weight: 1}", {"room.yaml:10:1", "unknown section 'sematics'", "did you mean 'semantics'?"});
  refused("report: {log_every: 3}", {"room.yaml:10:10", "unknown key 'log_every'"});
  refused("runtime: {seed: 1e400}", {"10:17", "1e400"});
  refused("runtime: {seed: .nan}", {"10:17", ".nan"});
  refused("runtime: {seed: 010}", {"10:17", "010"});
  refused("runtime: {seed: 0x10}", {"10:17", "0x10"});
  refused("runtime: {seed: 1_000}", {"10:17", "1_000"});
  refused("runtime: {seed: -1}", {"10:17", "-1"});
  refused("runtime: {seed: 99999999999999999999}", {"10:17"});
  refused("runtime: {seed: 1.0}", {"10:17"});
  refused("runtime: {fold_feature_layer: no}", {"10:31", "no"});
  refused("runtime: {fold_feature_layer: True}", {"10:31", "True"});
  refused("runtime: {fold_feature_layer: 1}", {"10:31"});
  for (const char* value :
       {"1e400", "-1e400", ".nan", ".inf", "-.inf", "nan", "inf", "1;5", "0x1p3", "\"1\"", "[1]", "~"})
    refused("report: {eval_every_s: " + std::string(value) + "}", {"10:24"});
  run.expect_error(ErrorKind::config, {"room.yaml:10:1", "duplicate key 'train'", "room.yaml:9:1"},
                   [&] { (void)parse_config_text(good + "train: {rays: 3}\n", "room.yaml"); });
}

}  // namespace semfield::numerics
