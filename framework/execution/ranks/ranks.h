// The processes that work on one run together, on one machine or on several.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <numeric>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "core/error.h"
#include "core/non_copyable.h"
#include "core/view.h"

namespace semfield {

struct Launched;

/// A process of the run has ended or does not answer: the others cannot go on without it.
class RankLost : public Error {
 public:
  using Error::Error;
};

/// All processes call the same functions in the same order; rank 0 leads. Each call is made by one thread at a time,
/// and throws RankLost when another process has ended or does not answer. No call may follow that but abandon.
class Ranks : NonCopyable {
 public:
  virtual ~Ranks() = default;

  virtual int rank() const = 0;
  virtual int size() const = 0;
  /// "rank 1 on node7".
  virtual const std::string& name_of(int rank) const = 0;
  /// Among the ranks of this host.
  virtual int local_rank() const = 0;
  virtual int local_size() const = 0;

  /// `data` of rank `root` becomes that of all.
  virtual void broadcast(std::span<std::byte> data, int root = 0) = 0;
  /// bytes[r] bytes of each rank r, one after the other, in `all` of every rank.
  virtual void all_gather(std::span<const std::byte> mine, std::span<std::byte> all,
                          std::span<const std::size_t> bytes) = 0;
  /// Returns when `data` may be used again.
  virtual void send(int to, std::span<const std::byte> data) = 0;
  virtual void receive(int from, std::span<std::byte> data) = 0;

  /// `asked` tells whether this process was asked to end; it is called while the process waits for others. Of another
  /// rank, rank 0 then hears, and its `hear` is called, once per rank. Where some ranks run on other hosts, rank 0 that
  /// was asked itself waits half a second more: a launcher asks all to end when one has failed, and soon kills them.
  virtual void end_when(std::function<bool()> asked, std::function<void()> hear) = 0;
  /// Throws RankLost when another process has ended. To be called now and then by whoever waits for what others do by
  /// other means than these calls.
  virtual void watch() = 0;
  /// Whether a call has thrown RankLost.
  virtual bool lost() const = 0;
  /// Ends the processes of the run, this one too, where their launcher can do so. Returns where it cannot.
  virtual void abandon(int code) = 0;
};

/// A small value of every rank.
template <class T>
std::vector<T> all_of(Ranks& ranks, const T& mine) {
  std::vector<T> all(static_cast<std::size_t>(ranks.size()));
  const std::vector<std::size_t> bytes(all.size(), sizeof(T));
  ranks.all_gather(std::as_bytes(std::span(&mine, 1)), std::as_writable_bytes(std::span(all)), bytes);
  return all;
}

/// `all` becomes the values of every rank, in order; each may have another number of them.
template <class T>
void join_values(Ranks& ranks, std::span<const T> mine, std::vector<T>& all) {
  const std::vector<std::size_t> bytes = all_of(ranks, mine.size_bytes());
  all.resize(std::accumulate(bytes.begin(), bytes.end(), std::size_t{0}) / sizeof(T));
  ranks.all_gather(std::as_bytes(mine), std::as_writable_bytes(std::span(all)), bytes);
}

/// Text of every rank, in order.
std::vector<std::string> texts_of(Ranks& ranks, const std::string& mine);

/// Calls `work` and tells all ranks how it ended. Throws the Error that it threw here, or else that of the first rank
/// where it failed; so all ranks throw or none does.
void agree(Ranks& ranks, const std::function<void()>& work);

/// Rank r's part of `count` things in a row: [first, second).
std::pair<std::int64_t, std::int64_t> part_of(std::int64_t count, int rank, int size);

/// Whether this build can join other processes.
bool has_mpi() noexcept;
/// Joins the other processes that `by` tells of, through MPI. Throws Error(unavailable) where this build has none, or
/// where MPI sees other processes than the launcher tells of.
std::unique_ptr<Ranks> join_ranks(const Launched& by);

// What mpirun or srun says of this process, read from the environment alone.

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
