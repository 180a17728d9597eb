// The floating-point mode of compute threads: set on entering numerical work, the caller's own restored on leaving.
#pragma once

#include <cstdint>

namespace semfield {

/// While it lives, this thread computes as every compute thread does: subnormal inputs and results count as 0, results
/// are rounded to nearest, and nothing traps. Subnormal numbers carry no information that training or rendering needs,
/// and some CPUs take 25 times as long over them. The mode is that of SSE and AVX (MXCSR) or AArch64 (FPCR);
/// elsewhere this does nothing. Scopes nest.
class ComputeFloatMode {
 public:
  ComputeFloatMode();
  ~ComputeFloatMode();
  ComputeFloatMode(const ComputeFloatMode&) = delete;
  ComputeFloatMode& operator=(const ComputeFloatMode&) = delete;

  /// This thread is in the mode; always where there is no such mode.
  static bool in_effect();

 private:
  std::uint64_t before_;
};

}  // namespace semfield
