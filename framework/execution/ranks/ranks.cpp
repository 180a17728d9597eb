#include "execution/ranks/ranks.h"

#include <unistd.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <cstdlib>

#include "core/process.h"
#include "core/text.h"

namespace semfield {

std::vector<std::string> texts_of(Ranks& ranks, const std::string& mine) {
  const std::vector<std::size_t> sizes = all_of(ranks, mine.size());
  std::size_t total = 0;
  for (const std::size_t size : sizes) total += size;
  std::string all(total, '\0');
  ranks.all_gather(std::as_bytes(std::span(mine)), std::as_writable_bytes(std::span(all)), sizes);
  std::vector<std::string> texts;
  std::size_t at = 0;
  for (const std::size_t size : sizes) {
    texts.push_back(all.substr(at, size));
    at += size;
  }
  return texts;
}

void agree(Ranks& ranks, const std::function<void()>& work) {
  std::optional<Error> own;
  std::exception_ptr thrown;
  try {
    work();
  } catch (const RankLost&) {
    throw;
  } catch (const Error& error) {
    own = error;
    thrown = std::current_exception();
  }
  constexpr int kSound = -1;
  const std::vector<int> kinds = all_of(ranks, own ? static_cast<int>(own->kind()) : kSound);
  std::size_t failed = 0;
  while (failed < kinds.size() && kinds[failed] == kSound) ++failed;
  if (failed == kinds.size()) return;
  const std::vector<std::string> codes = texts_of(ranks, own ? own->code().text() : "");
  const std::vector<std::string> messages = texts_of(ranks, own ? own->message() : "");
  const std::vector<std::string> remedies = texts_of(ranks, own ? own->remedy() : "");
  if (thrown) std::rethrow_exception(thrown);
  const Code code = Code::parse(codes[failed]).value_or(Code("internal.exception"));
  throw Error(static_cast<ErrorKind>(kinds[failed]), code, messages[failed], remedies[failed]);
}

std::pair<std::int64_t, std::int64_t> part_of(std::int64_t count, int rank, int size) {
  return {count * rank / size, count * (rank + 1) / size};
}

// Ranks and sizes as launchers write them into the environment.

namespace {

constexpr std::string_view kRemedy = "start the program by mpirun or srun itself, or unset the variable";

Error senseless(const std::string& name, const std::string& value, const std::string& why) {
  return {ErrorKind::config, "ranks.launcher.variable", "environment variable " + name + ": '" + value + "' " + why,
          std::string(kRemedy)};
}

class Environment {
 public:
  explicit Environment(const EnvironmentReader& value_of) : value_of_(value_of) {}

  // A variable that is set to nothing counts as not set.
  std::optional<std::string> text(const char* name) const {
    const char* const value = value_of_(name);
    return value != nullptr && *value != '\0' ? std::optional<std::string>(value) : std::nullopt;
  }

  bool has(const char* name) const { return text(name).has_value(); }

  int number(const char* name, int least, const std::string& what) const {
    const std::string value = text(name).value_or("");
    const auto read = to_number<int>(value);
    if (!read || *read < least) throw senseless(name, value, "is not a " + what);
    return *read;
  }

  // Of a pair that a launcher sets together, both.
  void demand(const char* name, const char* because) const {
    if (has(name)) return;
    throw Error(ErrorKind::config, "ranks.launcher.variable",
                std::string("environment variable ") + name + " is not set, although " + because + " is",
                std::string(kRemedy));
  }

  // A rank and how many there are of them.
  void pair(const char* rank_name, const char* size_name, int& rank, int& size) const {
    demand(rank_name, size_name);
    demand(size_name, rank_name);
    size = number(size_name, 1, "number of processes");
    rank = number(rank_name, 0, "rank");
    if (rank >= size) {
      throw senseless(rank_name, std::to_string(rank),
                      "is not a rank of " + std::to_string(size) + " processes (" + size_name + ")");
    }
  }

 private:
  const EnvironmentReader& value_of_;
};

// Of SLURM_STEP_TASKS_PER_NODE, "4(x2),3": the tasks of the node with this number; 0 where the text is no such list.
int tasks_of_node(std::string_view list, int node) {
  int first = 0;
  while (!list.empty()) {
    const std::string_view part = list.substr(0, list.find(','));
    list.remove_prefix(std::min(list.size(), part.size() + 1));
    int tasks = 0, nodes = 1;
    const char* const end = part.data() + part.size();
    const auto count = std::from_chars(part.data(), end, tasks);
    if (count.ec != std::errc{}) return 0;
    const std::string_view times(count.ptr, static_cast<std::size_t>(end - count.ptr));
    if (!times.empty()) {
      if (!times.starts_with("(x") || std::from_chars(times.data() + 2, end, nodes).ec != std::errc{}) return 0;
    }
    if (node < first + nodes) return tasks;
    first += nodes;
  }
  return 0;
}

constexpr const char* kStepSize = "SLURM_STEP_NUM_TASKS";
constexpr const char* kStepRank = "SLURM_PROCID";
constexpr const char* kStepLocalRank = "SLURM_LOCALID";
constexpr const char* kStepTasks = "SLURM_STEP_TASKS_PER_NODE";

// A batch script is given SLURM_PROCID and SLURM_LOCALID too, of one task; the size of a step tells them apart.
bool is_step(const Environment& environment) { return environment.has(kStepSize) && environment.has(kStepRank); }

Launched of_open_mpi(const Environment& environment) {
  Launched found{.by = "mpirun"};
  environment.pair("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE", found.rank, found.size);
  environment.pair("OMPI_COMM_WORLD_LOCAL_RANK", "OMPI_COMM_WORLD_LOCAL_SIZE", found.local_rank, found.local_size);
  return found;
}

Launched of_step(const Environment& environment) {
  Launched found{.by = "srun"};
  environment.pair(kStepRank, kStepSize, found.rank, found.size);
  found.local_rank = found.rank;
  found.local_size = found.size;
  if (!environment.has(kStepLocalRank)) return found;
  found.local_rank = environment.number(kStepLocalRank, 0, "rank");
  const int node = environment.has("SLURM_NODEID") ? environment.number("SLURM_NODEID", 0, "number of a node") : 0;
  if (const std::optional<std::string> tasks = environment.text(kStepTasks)) {
    found.local_size = tasks_of_node(*tasks, node);
    if (found.local_size < 1)
      throw senseless(kStepTasks, *tasks, "does not tell the tasks of node " + std::to_string(node));
  }
  if (found.local_rank >= found.local_size) {
    throw senseless(kStepLocalRank, std::to_string(found.local_rank),
                    "is not a rank of " + std::to_string(found.local_size) + " processes of this host");
  }
  return found;
}

Launched of_pmi(const Environment& environment) {
  Launched found{.by = "mpirun"};
  environment.pair("PMI_RANK", "PMI_SIZE", found.rank, found.size);
  // Slurm can speak PMI as well, and then the step says more. Where mpirun started its helpers by srun, the step is
  // that of the helpers, so it counts only where it says the same.
  if (is_step(environment)) {
    const Launched step = of_step(environment);
    if (step.rank == found.rank && step.size == found.size) return step;
  }
  found.local_rank = found.rank;
  found.local_size = found.size;
  if (environment.has("MPI_LOCALRANKID") && environment.has("MPI_LOCALNRANKS"))
    environment.pair("MPI_LOCALRANKID", "MPI_LOCALNRANKS", found.local_rank, found.local_size);
  return found;
}

}  // namespace

std::optional<Launched> launched(const EnvironmentReader& value_of) {
  const Environment environment(value_of);
  std::optional<Launched> found;
  if (environment.has("OMPI_COMM_WORLD_RANK") || environment.has("OMPI_COMM_WORLD_SIZE")) {
    found = of_open_mpi(environment);
  } else if (environment.has("PMI_RANK") || environment.has("PMI_SIZE")) {
    found = of_pmi(environment);
  } else if (is_step(environment)) {
    found = of_step(environment);
  }
  return found && found->size >= 2 ? found : std::nullopt;
}

std::optional<Launched> launched() {
  return launched([](const char* name) { return std::getenv(name); });
}

std::vector<char*> environment_of_child() {
  // What only a launcher sets; without it, variables of these families are settings that a user gives to launchers.
  static constexpr std::array<const char*, 4> marks{"OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "PMIX_RANK", kStepSize};
  static constexpr std::array<std::string_view, 8> families{"OMPI_", "PMIX_", "PMI_",      "PMI2_",
                                                            "PRTE_", "ORTE_", "MPI_LOCAL", "SLURM_STEP"};
  static constexpr std::array<std::string_view, 5> names{kStepRank, kStepLocalRank, "SLURM_NODEID", "SLURM_GTIDS",
                                                         "SLURM_TASK_PID"};
  const bool launched =
      std::any_of(marks.begin(), marks.end(), [](const char* mark) { return std::getenv(mark) != nullptr; });
  const auto is_of_launcher = [&](std::string_view name) {
    // Of root, who was asked whether mpirun may be used at all: a setting of the user.
    if (!launched || name.starts_with("OMPI_ALLOW_RUN_AS_ROOT")) return false;
    return std::any_of(families.begin(), families.end(),
                       [&](std::string_view start) { return name.starts_with(start); }) ||
           std::find(names.begin(), names.end(), name) != names.end();
  };
  std::vector<char*> kept;
  for (char** entry = environ; entry != nullptr && *entry != nullptr; ++entry) {
    const std::string_view setting(*entry);
    if (!is_of_launcher(setting.substr(0, setting.find('=')))) kept.push_back(*entry);
  }
  kept.push_back(nullptr);
  return kept;
}

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
