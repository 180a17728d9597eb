#include "compute/float_mode.h"

#if defined(__SSE2__)
#include <xmmintrin.h>
#endif

namespace semfield {

namespace {

#if defined(__SSE2__)
constexpr std::uint64_t kMode = 0x8000 | 0x1F80 | 0x0040;  // flush to zero, every exception masked, denormals are zero
constexpr std::uint64_t kStatus = 0x003F;                  // what has happened, no part of the mode
std::uint64_t read_control() { return _mm_getcsr(); }
void write_control(std::uint64_t value) { _mm_setcsr(static_cast<unsigned>(value)); }
#elif defined(__aarch64__)
constexpr std::uint64_t kMode = std::uint64_t{1} << 24;  // FZ: flushes inputs and results
constexpr std::uint64_t kStatus = 0;
std::uint64_t read_control() {
  std::uint64_t value = 0;
  asm volatile("mrs %0, fpcr" : "=r"(value));
  return value;
}
void write_control(std::uint64_t value) { asm volatile("msr fpcr, %0" : : "r"(value)); }
#else
constexpr std::uint64_t kMode = 0;
constexpr std::uint64_t kStatus = 0;
std::uint64_t read_control() { return kMode; }
void write_control(std::uint64_t) {}
#endif

}  // namespace

// Both stay out of line, so that no arithmetic moves across them.
ComputeFloatMode::ComputeFloatMode() : before_(read_control()) { write_control(kMode); }
ComputeFloatMode::~ComputeFloatMode() { write_control(before_); }
bool ComputeFloatMode::in_effect() { return (read_control() & ~kStatus) == kMode; }

}  // namespace semfield
