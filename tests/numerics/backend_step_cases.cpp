// I06: whole steps on every instruction set. The set is chosen when a program starts, so each gets a program of its
// own.
#include <dlfcn.h>

#include <algorithm>
#include <cstdlib>
#include <sstream>

#include "backend_parts.h"
#include "box_room.h"
#include "core/text.h"
#include "tests/scene/room_files.h"

namespace semfield::numerics {

namespace {

struct Step {
  double loss = 0, norm = 0, oracle_loss = 0, oracle_norm = 0, psnr_db = 0;
  unsigned state = 0;
};

// The program beside this library, or in the folder of the tests.
std::string probe_path() {
  Dl_info info{};
  if (dladdr(reinterpret_cast<const void*>(&probe_path), &info) == 0 || info.dli_fname == nullptr) return {};
  std::error_code ignored;
  const auto path = std::filesystem::path(info.dli_fname).parent_path() / "semfield_step_probe";
  return std::filesystem::exists(path, ignored) ? path.string() : std::string();
}

std::optional<Step> probe(CaseRun& run, const std::string& program, const std::string& set, const std::string& yaml,
                          int steps) {
  const std::string path = run.folder() + "/step.yaml";
  testing_room::plain_write(path, yaml);
  const std::string command = "SEMFIELD_ISA=" + set + " OMP_WAIT_POLICY=passive " + shell_word(program) + " " +
                              shell_word(path) + " " + std::to_string(steps);
  std::FILE* pipe = ::popen(command.c_str(), "r");  // NOLINT: nothing of it comes from outside
  if (pipe == nullptr) return {};
  char text[512] = "";
  const bool read = std::fgets(text, sizeof text, pipe) != nullptr;
  if (::pclose(pipe) != 0 || !read) return {};
  std::istringstream numbers(text);
  Step step;
  numbers >> step.loss >> step.norm >> step.oracle_loss >> step.oracle_norm >> step.psnr_db >> step.state;
  return numbers.fail() ? std::nullopt : std::optional(step);
}

}  // namespace

void whole_step(CaseRun& run) {
  run.row("fp32");
  const std::string program = probe_path();
  if (program.empty())
    return run.absent("the program that steps under another instruction set is not beside this library");
  const std::string scene = "scene: {type: box_room}\n";
  const auto runtime = [](const char* what) { return "runtime: {" + std::string(what) + "}\n"; };
  constexpr int kSteps = 100, kDeepSteps = 20;
  struct Measured {
    std::string set;
    Step step;
  };
  std::vector<Measured> hash, deep;
  const auto tables = isa_tables<float>();
  bool complete = true;
  const auto measured = [&](std::vector<Measured>& into, const std::string& set, const std::string& yaml, int steps) {
    const std::optional<Step> step = probe(run, program, set, yaml, steps);
    complete = complete && step.has_value();
    into.push_back({set, step.value_or(Step{})});
  };
  for (const IsaTable<float>& table : tables) {
    const std::string set(isa_name(table.isa));
    measured(hash, set, scene + kHashPass + runtime("threads: 1"), kSteps);
    measured(deep, set, scene + kFrequencyPass + runtime("threads: 1"), kDeepSteps);
  }
  std::vector<Measured> more;
  const std::string best(isa_name(isa()));
  measured(more, best, scene + kHashPass + runtime("threads: 3"), kSteps);
  measured(more, best, scene + kFrequencyPass + runtime("threads: 1, precision: bf16"), kDeepSteps);

  run.expect(complete, "every program ran to its end");
  double psnr = 0;
  for (const auto* kind : {&hash, &deep}) {
    for (const Measured& m : *kind) {
      // Against the same step in float64, and against the weakest set.
      run.measure(relative_error(m.step.loss, m.step.oracle_loss), 1e-5, "loss on " + m.set);
      run.measure(relative_error(m.step.norm, m.step.oracle_norm), 1e-4, "norm on " + m.set);
      run.measure(relative_error(m.step.loss, kind->front().step.loss), 1e-5, "loss between sets");
      run.measure(relative_error(m.step.norm, kind->front().step.norm), 1e-4, "norm between sets");
      psnr = std::max(psnr, std::abs(m.step.psnr_db - kind->front().step.psnr_db));
    }
  }
  run.measure(psnr, 0.05, "PSNR after training, dB");
  run.expect(hash.front().step.psnr_db > 15, "that training learned something");
  const unsigned state = hash.back().step.state;
  run.expect(more[0].step.state == state,
             "1 and 3 threads leave the same bits after " + std::to_string(kSteps) + " steps");
  std::string figures;
  for (const Measured& m : hash) {
    char text[64];
    std::snprintf(text, sizeof text, "%s%s %.3f dB", figures.empty() ? "" : ", ", m.set.c_str(), m.step.psnr_db);
    figures += text;
  }
  run.note(figures + " after " + std::to_string(kSteps) + " steps");

  run.row("float64");
  for (const auto* kind : {&hash, &deep}) {
    for (const Measured& m : *kind) {
      run.measure(relative_error(m.step.oracle_loss, kind->front().step.oracle_loss), 1e-12, "loss");
      run.measure(relative_error(m.step.oracle_norm, kind->front().step.oracle_norm), 1e-12, "norm");
    }
  }
  run.row("bf16");
  const Step& bf16 = more[1].step;
  run.expect(bf16.state != deep.back().step.state, "it is another arithmetic");
  // Products of 8 significant bits: 2^-8 a factor.
  run.measure(relative_error(bf16.loss, bf16.oracle_loss), 0x1p-8, "loss");
  run.measure(relative_error(bf16.norm, bf16.oracle_norm), 0x1p-4, "gradient norm");
  run.measure(std::abs(bf16.psnr_db - deep.back().step.psnr_db), 0.5, "PSNR after training, dB");
}

}  // namespace semfield::numerics
