// What this machine can do at most, measured: multiply-adds from registers.
#pragma once

#include <vector>

namespace semfield {

/// Floating-point operations per second (a multiply-add counts 2) of independent float chains held in registers, over
/// `threads` threads, each running for about `seconds`. Uses the widest vectors that the CPU has, whatever the
/// build was compiled for: it is the machine's limit, not the build's.
double peak_fp32_flops(int threads, double seconds);

/// The same for products of bfloat16 pairs added in float by tile registers (tdpbf16ps) or vectors
/// (vdpbf16ps); 0 where the CPU has neither.
double peak_bf16_flops(int threads, double seconds);

/// One call of a loop that a probe repeats. Its result tells how many rounds every chain made, and with them whether
/// `operations` are those that were executed.
struct ProbeCall {
  const char* name = "";  ///< "fp32", "bf16", "tiles"
  double operations = 0;  ///< floating-point operations that the probe counts for it
  double result = 0;
};
inline constexpr int kProbeChains = 12;         ///< of a float loop, on vectors
inline constexpr int kProbeRounds = 20000;      ///< of a float loop: 0.1 ms
inline constexpr double kProbeScale = 0.99999;  ///< a chain of fp32: a = a * scale + (1 - scale), so that it nears 1

/// Of each loop that this CPU has: chain i of a float loop starts at 1 + i; a round of bf16 adds 0.004 to the
/// first half of a vector and 0.000006 to the second; half of the products of tiles are 1 and the others 0.
std::vector<ProbeCall> probe_calls();

}  // namespace semfield
