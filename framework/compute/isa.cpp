#include "compute/isa.h"

#include <cstdlib>

#if defined(__x86_64__) && defined(__linux__)
#include <cpuid.h>
#include <sys/syscall.h>
#include <unistd.h>
#endif
#if defined(__SSE2__)
#include <xmmintrin.h>
#endif

#include "core/error.h"
#include "isa_list.h"

namespace semfield {

namespace {

#define SEMFIELD_LIST(name) Isa::name,
constexpr Isa kBuilt[] = {SEMFIELD_FOR_EVERY_ISA(SEMFIELD_LIST)};
#undef SEMFIELD_LIST

bool processor_has(Isa isa) {
#if defined(__x86_64__)
  // The feature levels x86-64-v3 and v4, by the features that our kernels use of them.
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
  const bool avx512 = avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                      __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
                      __builtin_cpu_supports("avx512cd");
  if (isa == Isa::avx2) return avx2;
  if (isa == Isa::avx512) return avx512;
  const bool avx512_bf16 = avx512 && __builtin_cpu_supports("avx512bf16");
  if (isa == Isa::avx512_bf16 || isa == Isa::amx_emulated) return avx512_bf16;
  if (isa == Isa::amx_bf16) return avx512_bf16 && processor_has_tiles();
#endif
  return isa == Isa::generic || isa == Isa::build;
}

template <class Wanted>
std::string names_of(const Wanted& wanted) {
  std::string text;
  for (const Isa built : kBuilt)
    if (wanted(built)) text += (text.empty() ? "" : " ") + std::string(isa_name(built));
  return text;
}

Isa choose() {
  Isa best = kBuilt[0];
  for (const Isa built : kBuilt) {
    if (processor_has(built) && built != Isa::amx_emulated) best = built;
  }
  const char* wanted = std::getenv("SEMFIELD_ISA");
  if (wanted == nullptr || *wanted == '\0') return best;
  for (const Isa built : kBuilt) {
    if (isa_name(built) == wanted && processor_has(built)) return built;
  }
  throw Error(ErrorKind::config, "config.environment.value",
              "environment variable SEMFIELD_ISA: '" + std::string(wanted) +
                  "' is not an instruction set that this CPU and this build have",
              "set one of: " + isas_of_machine() + ", or unset it");
}

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

bool processor_has_tiles() {
#if defined(__x86_64__) && defined(__linux__)
  constexpr unsigned kOsSaves = 1u << 27, kTiles = (1u << 22) | (1u << 24);  // OSXSAVE; AMX-BF16, AMX-TILE
  unsigned a = 0, b = 0, c = 0, d = 0;
  if (__get_cpuid(1, &a, &b, &c, &d) == 0 || (c & kOsSaves) == 0) return false;
  if (__get_cpuid_count(7, 0, &a, &b, &c, &d) == 0 || (d & kTiles) != kTiles) return false;
  unsigned low = 0, high = 0;
  __asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
  constexpr unsigned kSaved = 3u << 17;  // tile configuration and tile data
  if ((low & kSaved) != kSaved) return false;
  // Linux gives the memory of tiles to a process that asks.
  constexpr long kRequestPermission = 0x1023, kTileData = 18;  // ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA
  static const bool allowed = syscall(SYS_arch_prctl, kRequestPermission, kTileData) == 0;
  return allowed;
#else
  return false;
#endif
}

std::string_view isa_name(Isa isa) {
  constexpr std::string_view kNames[] = {"generic",      "avx2",     "avx512", "avx512_bf16",
                                         "amx_emulated", "amx_bf16", "build"};
  return kNames[static_cast<std::size_t>(isa)];
}

Isa isa() {
  static const Isa chosen = choose();
  return chosen;
}

std::string isas_of_build() {
  return names_of([](Isa) { return true; });
}
std::string isas_of_machine() { return names_of(processor_has); }

SEMFIELD_FOR_EACH_ISA(SEMFIELD_DECLARE_VARIANT, fill_cpu_kernels, CpuKernels<float>)
SEMFIELD_FOR_EACH_ISA(SEMFIELD_DECLARE_VARIANT, fill_cpu_kernels, CpuKernels<double>)

template <class Real>
const CpuKernels<Real>& cpu_kernels() {
  using Fill = void (*)(CpuKernels<Real>&);
  static constexpr IsaVariant<Fill> kVariants[] = {SEMFIELD_FOR_EACH_ISA(SEMFIELD_VARIANT, fill_cpu_kernels)};
  static const CpuKernels<Real> kernels = [] {
    CpuKernels<Real> filled{};
    best_variant(kVariants)(filled);
    return filled;
  }();
  return kernels;
}

bool bf16_is_native() {
#if defined(__AVX512BF16__)
  return true;  // the whole build has them
#else
  return isa() >= Isa::avx512_bf16 && isa() != Isa::build;
#endif
}

bool bf16_is_faster() {
#if defined(__x86_64__)
  return isa() == Isa::amx_bf16 || (bf16_is_native() && __builtin_cpu_is("amd") != 0);
#else
  return false;
#endif
}

template const CpuKernels<float>& cpu_kernels<float>();
template const CpuKernels<double>& cpu_kernels<double>();

// Both stay out of line, so that no arithmetic moves across them.
ComputeFloatMode::ComputeFloatMode() : before_(read_control()) { write_control(kMode); }
ComputeFloatMode::~ComputeFloatMode() { write_control(before_); }
bool ComputeFloatMode::in_effect() { return (read_control() & ~kStatus) == kMode; }

}  // namespace semfield
