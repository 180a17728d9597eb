// Who computes the matrix products of networks: our own kernels, or oneDNN where the build found it.
#pragma once

#include <cstdint>
#include <string>

#include "compute/gemm.h"
#include "core/work_scope.h"

namespace semfield {

enum class GemmEngine : std::uint8_t { automatic, builtin, onednn };

/// For WorkSettings::gemm; null: our kernels, which `automatic` takes (docs/decisions/0017-matrix-tiles.md). Throws
/// Error(unavailable) when oneDNN is asked for and not there.
const OnednnGemm* choose_gemm_engine(GemmEngine wanted);

/// For reports, of this thread's engine: "built-in, avx512_bf16", "oneDNN 2.6.3".
std::string gemm_engine_text();

/// What the library semfield_onednn brings.
struct OnednnGemm {
  /// False: this product is left to our kernels; the same decision for every number of rows.
  bool (*run)(const Gemm<float>& g);
  std::string (*version)();
};
inline constexpr const char* kOnednnGemmSymbol = "semfield_onednn_gemm";  // OnednnGemm()

/// The engine of float products of this thread's work_settings(); null: our kernels.
const OnednnGemm* foreign_gemm();

}  // namespace semfield
