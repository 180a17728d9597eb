// Pairs of runs that differ in one left-out component: the proof that nothing is lost, and what it saves.
#pragma once

#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "model/leave_out.h"
#include "session/session.h"

namespace semfield {

/// What a pair compares, and what of it is timed.
enum class PairKind {
  training,    ///< tensors after training (bitwise); a step
  rendering,   ///< pictures of one field (bitwise or within a bound); a picture
  outputs,     ///< the colours of a picture rendered with and without semantics (bitwise); a picture
  quality,     ///< test scores over seeds (statistical); a step
  cost,        ///< that the sides are different trainings; what leaving it out would save; a step
  rows,        ///< rows of tables that no ray met (bitwise); a step
  evaluation,  ///< tensors after training with evaluations between (bitwise); an evaluation
  checks,      ///< that the checks find a value that is not finite; what they cost; a step
  library,     ///< the process's memory map; loading
};

struct LeaveOutPair {
  std::string name;       ///< of `--only`
  std::string component;  ///< of left_out.json; empty: decided where it is used, in no run's list
  std::string rule;
  ProofClass proof = ProofClass::bitwise;
  PairKind kind = PairKind::training;
  std::string config = "configs/quickstart.yaml";
  std::vector<std::string> both, out, kept;  ///< overrides "a.b=value" of each side
  std::string kept_by;                       ///< how a user keeps it
  std::string but;                           ///< not empty: it stays in, and why
  double bound = 0;                          ///< certified pairs: what a ray may lose of its opacity
  int steps = 60;                            ///< of training before anything is compared
};

/// Every pair there is, in the order of the page.
const std::vector<LeaveOutPair>& leave_out_pairs();

struct PairOptions {
  std::vector<std::string> set;  ///< of all pairs, before their own: size of the scene
  int rounds = 7;                ///< alternating, timed; medians
  int steps_a_round = 5;
  int frames = 2;        ///< test frames that are rendered and compared
  int seeds = 5;         ///< of statistical pairs
  int seed_steps = 300;  ///< of each of their runs
};

/// Seconds of CPU time on one thread, and what the saving's noise is.
struct PairCost {
  std::string of;                              ///< "step" or "picture"
  double out_s = 0, kept_s = 0;                ///< medians
  double share = 0;                            ///< median over rounds of 1 - out / kept
  double noise = 0;                            ///< half the middle half of the rounds' shares
  std::int64_t out_bytes = 0, kept_bytes = 0;  ///< held by scene, parameters and activations
};

struct PairResult {
  bool idle = false;   ///< nothing was left out, so that nothing is proved
  bool holds = false;  ///< the proof class was met, or what PairKind says of pairs that prove nothing
  std::string result;  ///< hash, bound and difference, or interval
  PairCost cost;
  double seconds = 0;  ///< of CPU time for the pair
};

/// Runs one pair. `configs` resolves its configuration's path.
PairResult run_pair(const LeaveOutPair& pair, const PairOptions& options, Registry& registry,
                    const std::function<std::string(const std::string&)>& configs);

/// Lower limits of the 95 % interval of the mean paired difference (out - kept) [Student08].
inline constexpr double kPsnrMargin_dB = -0.1;
inline constexpr double kMiouMargin = -0.005;

}  // namespace semfield
