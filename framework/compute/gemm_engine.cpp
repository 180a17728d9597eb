#include "compute/gemm_engine.h"

#include "compute/isa.h"
#include "core/error.h"
#include "core/work_scope.h"
#include "system/shared_library.h"

namespace semfield {

namespace {

#ifdef SEMFIELD_ONEDNN_LIBRARY
const OnednnGemm& onednn() {
  static const OnednnGemm loaded = reinterpret_cast<OnednnGemm (*)()>(
      library_symbol(SEMFIELD_ONEDNN_LIBRARY, kOnednnGemmSymbol, "oneDNN cannot be loaded",
                     "install Semfield again, or set runtime.gemm to builtin"))();
  return loaded;
}
#else
const OnednnGemm& onednn() {
  throw Error(ErrorKind::unavailable, "runtime.gemm: this build has no oneDNN",
              "set it to builtin or auto, or build where oneDNN is installed (package libdnnl-dev)");
}
#endif

}  // namespace

const OnednnGemm* choose_gemm_engine(GemmEngine wanted) { return wanted == GemmEngine::onednn ? &onednn() : nullptr; }

std::string gemm_engine_text() {
  const OnednnGemm* foreign = foreign_gemm();
  return foreign != nullptr ? foreign->version() : "built-in, " + std::string(isa_name(isa()));
}

const OnednnGemm* foreign_gemm() { return work_settings().gemm; }

}  // namespace semfield
