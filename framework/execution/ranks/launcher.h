// What mpirun or srun says of this process, read from the environment alone.
#pragma once

#include <functional>
#include <optional>
#include <string>
#include <vector>

namespace semfield {

/// One of several processes that a launcher started together.
struct Launched {
  int rank = 0, size = 1;              ///< of all of them: 0 <= rank < size
  int local_rank = 0, local_size = 1;  ///< of those on this host
  std::string by;                      ///< "mpirun" or "srun"
};

/// Text of an environment variable, null for one that is not set.
using EnvironmentReader = std::function<const char*(const char* name)>;

/// What the environment says of this process: that of Open MPI (OMPI_COMM_WORLD_...), of launchers that speak PMI
/// (PMI_RANK and PMI_SIZE: MPICH, Intel MPI), of a Slurm step (SLURM_STEP_NUM_TASKS, SLURM_PROCID, SLURM_LOCALID), the
/// first of these that is there. None for a process started by hand, for one that is alone (size 1), and for a batch
/// script, which is no step. A launcher that does not say who is on this host has all processes counted as on it.
/// Throws Error(config) naming the variable whose number makes no sense.
std::optional<Launched> launched(const EnvironmentReader& value_of);
/// Of this process's environment.
std::optional<Launched> launched();

/// The environment for a process that this one starts, as execve takes it: without what a launcher told this one, or
/// the child would pass for the same rank. A process that no launcher started hands on all of its own. It points into
/// this process's environment.
std::vector<char*> environment_of_child();

}  // namespace semfield
