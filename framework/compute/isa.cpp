#include "compute/isa.h"

#include <cstdlib>
#if defined(__x86_64__) && defined(__linux__)
#include <cpuid.h>
#include <sys/syscall.h>
#include <unistd.h>
#endif

#include "core/error.h"
#include "isa_list.h"

namespace semfield {

namespace {

constexpr Isa kBuilt[] = {
#define SEMFIELD_LIST(name) Isa::name,
    SEMFIELD_FOR_EVERY_ISA(SEMFIELD_LIST)
#undef SEMFIELD_LIST
};

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
  std::string text;
  for (const Isa built : kBuilt) text += (text.empty() ? "" : " ") + std::string(isa_name(built));
  return text;
}

std::string isas_of_machine() {
  std::string text;
  for (const Isa built : kBuilt) {
    if (processor_has(built)) text += (text.empty() ? "" : " ") + std::string(isa_name(built));
  }
  return text;
}

}  // namespace semfield
