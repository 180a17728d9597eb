#include "programs/scale_start.h"

#include <fmt/format.h>
#include <sched.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <chrono>
#include <csignal>
#include <filesystem>
#include <fstream>
#include <set>
#include <string_view>
#include <thread>
#include <utility>

#include "app/child_process.h"
#include "app/signals.h"
#include "compute/parallel.h"
#include "core/error.h"
#include "core/text.h"
#include "system/files.h"

namespace semfield::app {

namespace {

using Clock = std::chrono::steady_clock;

constexpr std::chrono::seconds kLongest{900};  // of a start; more is a process that waits for ever
constexpr std::chrono::seconds kToEnd{10};     // after it was asked to

// Cores with their threads counted once, of those that this process may run on; 0 where the system does not tell.
int physical_cores(const cpu_set_t& allowed) {
  std::set<std::pair<int, int>> cores;
  for (int cpu = 0; cpu < CPU_SETSIZE; ++cpu) {
    if (!CPU_ISSET(cpu, &allowed)) continue;
    const std::string folder = fmt::format("/sys/devices/system/cpu/cpu{}/topology/", cpu);
    int package = 0, core = 0;
    if (!(std::ifstream(folder + "physical_package_id") >> package) || !(std::ifstream(folder + "core_id") >> core))
      return 0;
    cores.emplace(package, core);
  }
  return static_cast<int>(cores.size());
}

cpu_set_t allowed_cores() {
  cpu_set_t allowed;
  CPU_ZERO(&allowed);
  sched_getaffinity(0, sizeof allowed, &allowed);
  return allowed;
}

cpu_set_t first_of(const cpu_set_t& allowed) {
  cpu_set_t first;
  CPU_ZERO(&first);
  for (int cpu = 0; cpu < CPU_SETSIZE; ++cpu) {
    if (!CPU_ISSET(cpu, &allowed)) continue;
    CPU_SET(cpu, &first);
    break;
  }
  return first;
}

std::string mpirun() {
  std::string program = program_in_path("mpirun");
  if (program.empty())
    throw Error(ErrorKind::unavailable, "ranks.mpi.missing",
                "the program mpirun, which starts several ranks, is not in PATH",
                "install it (Debian: apt-get install openmpi-bin), or ask for one rank with --ranks 1");
  return program;
}

std::vector<std::string> launcher_words(const ScaleStart& start, const AppContext& context) {
  std::vector<std::string> words{mpirun(), "-n", std::to_string(start.ranks)};
  if (geteuid() == 0) {
    static bool told = false;
    if (!std::exchange(told, true))
      print_note(context, "mpirun starts no ranks of root by itself; it gets --allow-run-as-root, as we are root");
    words.emplace_back("--allow-run-as-root");
  }
  if (start.pinned && start.ranks <= physical_cores(allowed_cores())) {
    words.insert(words.end(), {"--map-by", "core", "--bind-to", "core:if-supported"});
  } else if (start.pinned && start.ranks <= hardware_threads()) {
    words.insert(words.end(), {"--use-hwthread-cpus", "--map-by", "hwthread", "--bind-to", "hwthread:if-supported"});
  } else {
    words.insert(words.end(), {"--oversubscribe", "--bind-to", "none"});
  }
  return words;
}

// What the program said, which stands somewhere before what mpirun says of its end.
std::string failure_text(int status, const std::string& log_file) {
  const std::string log = read_text_file(log_file);
  std::string_view text = log, line;
  while (next_line(text, line)) {
    if (line.starts_with("semfield: ")) return std::string(line.substr(10));
  }
  return child_failure(status, log_file);
}

}  // namespace

void need_mpirun() { mpirun(); }

ScaleEnd start_ranks(const ScaleStart& start, const std::string& folder, const AppContext& context) {
  std::vector<std::string> words;
  if (start.ranks > 1) words = launcher_words(start, context);
  words.push_back((std::filesystem::path(own_program()).parent_path() / "semfield").string());
  words.insert(words.end(), start.words.begin(), start.words.end());
  const ChildFiles files{(std::filesystem::path(folder) / "output.txt").string(),
                         (std::filesystem::path(folder) / "log.txt").string()};
  const bool pin = start.pinned && start.ranks == 1;
  const cpu_set_t core = first_of(allowed_cores());
  install_stop_signals();
  const Clock::time_point begin = Clock::now();
  const pid_t pid = start_child(words, files, [pin, core] {
    if (pin) sched_setaffinity(0, sizeof core, &core);
  });
  int status = 0;
  bool asked = false;
  Clock::time_point kill_at = Clock::time_point::max();
  for (pid_t ended = 0; (ended = waitpid(pid, &status, WNOHANG)) != pid;) {
    if (ended < 0 && errno != EINTR)
      throw Error(ErrorKind::internal, "internal.process.wait", "the process that was started cannot be waited for",
                  "report this");
    const Clock::time_point now = Clock::now();
    if (!asked && (stop_signal() != 0 || now - begin > kLongest)) {
      asked = true;
      kill_at = now + kToEnd;
      kill(pid, SIGTERM);
    }
    if (now > kill_at) kill(-pid, SIGKILL);
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
  }
  ScaleEnd end;
  end.seconds = std::chrono::duration<double>(Clock::now() - begin).count();
  if (stop_signal() != 0)
    throw Error(ErrorKind::failure, "study.process.stopped", "stopped by a signal", "start it again to measure again");
  if (asked)
    throw Error(ErrorKind::failure, "study.process.stuck",
                fmt::format("`{}` did not end within {} s", join(words, " "), kLongest.count()),
                "see whether mpirun works here: mpirun -n 2 hostname");
  end.code = WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
  if (end.code != 0) end.failure = failure_text(status, files.log);
  return end;
}

}  // namespace semfield::app
