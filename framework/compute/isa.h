// Instruction sets: kernels are compiled once for each, the best that the CPU has is chosen when the program
// starts.
#pragma once

#include <cstdint>
#include <iterator>
#include <string>
#include <string_view>

/// Namespace of the variant that is being compiled, isa_avx2 for one; set by the build (cmake/Isa.cmake).
#ifndef SEMFIELD_ISA
#define SEMFIELD_ISA isa_build
#endif

namespace semfield {

/// Weakest first. amx_emulated: the kernels of amx_bf16 with its tile instructions written in those of avx512_bf16, for
/// tests; never chosen unless it is asked for. `build`: the only variant of a build that compiles its kernels once,
/// with its own flags.
enum class Isa : std::uint8_t { generic, avx2, avx512, avx512_bf16, amx_emulated, amx_bf16, build };

std::string_view isa_name(Isa isa);

/// The instruction set in use: the best that this CPU and this build have, or less by the environment variable
/// SEMFIELD_ISA (generic, avx2, avx512, avx512_bf16, amx_emulated, amx_bf16). Throws Error(config) when that names
/// something else or something that is missing.
Isa isa();

/// Whether this CPU has tile registers with products of bf16 (AMX), and the kernel lets this process use them.
bool processor_has_tiles();

/// Variants of this build, e.g. "generic avx2 avx512 avx512_bf16 amx_emulated amx_bf16".
std::string isas_of_build();
/// Those of them that this CPU has.
std::string isas_of_machine();

template <class Function>
struct IsaVariant {
  Isa isa;
  Function function;
};

/// The last variant that needs no more than isa(); variants are listed weakest first and begin with the weakest of the
/// build.
template <class Function, std::size_t kCount>
Function best_variant(const IsaVariant<Function> (&variants)[kCount]) {
  const Isa best = isa();
  std::size_t chosen = 0;
  for (std::size_t i = 1; i < kCount; ++i) {
    if (variants[i].isa <= best) chosen = i;
  }
  return variants[chosen].function;
}

}  // namespace semfield
