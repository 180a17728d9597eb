#include "compute/isa.h"

#include <cstdlib>

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
  if (isa == Isa::avx512_bf16) return avx512 && __builtin_cpu_supports("avx512bf16");
#endif
  return isa == Isa::generic || isa == Isa::build;
}

Isa choose() {
  Isa best = kBuilt[0];
  std::string usable;
  for (const Isa built : kBuilt) {
    if (!processor_has(built)) continue;
    best = built;
    usable += (usable.empty() ? "" : ", ") + std::string(isa_name(built));
  }
  const char* wanted = std::getenv("SEMFIELD_ISA");
  if (wanted == nullptr || *wanted == '\0') return best;
  for (const Isa built : kBuilt) {
    if (isa_name(built) == wanted && processor_has(built)) return built;
  }
  throw Error(ErrorKind::config,
              "environment variable SEMFIELD_ISA: '" + std::string(wanted) +
                  "' is no instruction set that this processor and this build have",
              "set one of " + usable + ", or unset it");
}

}  // namespace

std::string_view isa_name(Isa isa) {
  constexpr std::string_view kNames[] = {"generic", "avx2", "avx512", "avx512_bf16", "build"};
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

}  // namespace semfield
