// Which training steps `bench step` measures, and what came out.
#pragma once

#include <map>
#include <optional>
#include <string>
#include <vector>

#include "studies/step_bench.h"
#include "studies/study_tools.h"

namespace semfield {

struct BenchStepOptions {
  bool peers = false;
  int threads = 0;  ///< 0: every core
  int repeats = 5;
  std::string size = "full";  ///< full, or tiny: narrow networks and few rays, for tests
  std::string peer_script, python;
  std::vector<std::string> set;  ///< overrides of both networks' configurations
};

/// A measured training step of ours.
struct StepRow {
  std::string net;        ///< paper, hash T=2^15, ...
  std::string precision;  ///< fp32, bf16
  int threads = 0, classes = 0;
  std::int64_t rays = 0;
  Spread seconds;
  double processor = 0;  ///< processor seconds per step, summed over threads; median
  double samples = 0;    ///< a step
  double flop = 0;       ///< of the networks, as executed
  double peak = 0;  ///< measured floating-point operations per second of this precision and thread count; 0: unknown
  std::int64_t allocated = 0;  ///< most bytes of operator new in a call of steps after the first step
  double rate() const { return samples / seconds.median; }
  double flops() const { return flop / seconds.median; }
};

/// A measured training step of the peer's.
struct PeerRow {
  std::string net, mode;
  bool tuned = true;
  std::int64_t rays = 0;
  Spread seconds;
  double processor = 0;  ///< as above
  double samples = 0;    ///< a step
  double rate() const { return samples / seconds.median; }
};

struct BenchStepResults {
  int threads = 0;
  double peak_fp32_one = 0, peak_fp32 = 0;  ///< operations per second on 1 and on `threads` threads
  double peak_bf16_one = 0, peak_bf16 = 0;  ///< 0: the processor has no such instruction
  std::map<std::string, std::pair<double, double>>
      reads;                     ///< table size -> random 8-byte reads a second, 1 and all threads
  std::vector<StepRow> steps;    ///< whole steps, alternating with the peers
  std::vector<StepRow> classes;  ///< the same networks over C; C = 0: without semantics
  std::vector<StepRow> scaling;  ///< 1 thread, 2, and `many_threads`
  int many_threads = 0;          ///< 0: the machine has fewer than 8 cores
  std::vector<PeerRow> peers;
  std::string peer_about, peer_missing;  ///< what answered, or why nothing did
};

/// Throws Error(usage) for a size that does not exist.
BenchStepResults measure_steps(const BenchStepOptions& options, const StudyTools& tools);

/// Goals by name, in the order of the last line; nullopt: not measured here.
using Goals = std::vector<std::pair<std::string, std::optional<double>>>;
Goals goals_of(const BenchStepResults& results);
/// The same ratios of processor time (P4: of one core's limit): what is left of the truth where other programs run
/// beside this one. Threads that wait in a busy loop count as working.
Goals processor_goals_of(const BenchStepResults& results);

}  // namespace semfield
