#include "execution/ranks/launcher.h"
#include "execution/ranks/ranks.h"
#include "system/shared_library.h"

namespace semfield {

bool has_mpi() noexcept {
#ifdef SEMFIELD_MPI_LIBRARY
  return true;
#else
  return false;
#endif
}

std::unique_ptr<Ranks> join_ranks([[maybe_unused]] const Launched& by) {
#ifdef SEMFIELD_MPI_LIBRARY
  using Join = Ranks* (*)(const Launched*);
  static const auto join = reinterpret_cast<Join>(library_symbol(
      SEMFIELD_MPI_LIBRARY, "semfield_join_ranks", by.by + " started several processes, but MPI cannot be loaded",
      "install what the reason names: OpenMPI (package openmpi-bin), or, if it names " SEMFIELD_MPI_LIBRARY
      ", Semfield itself again, whole; or start one process"));
  return std::unique_ptr<Ranks>(join(&by));
#else
  throw Error(ErrorKind::unavailable, "ranks.mpi.missing",
              by.by + " started several processes, but this build has no MPI",
              "build where MPI is found (package libopenmpi-dev), or start one process");
#endif
}

}  // namespace semfield
