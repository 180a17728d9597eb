#include "app/child_process.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <chrono>
#include <csignal>
#include <cstdlib>
#include <sstream>
#include <thread>
#include <utility>

#include "app/signals.h"

namespace semfield::app {

namespace {

// Where a process writes; refused here where it cannot be written, before the process starts.
FileDescriptor output_file(const std::string& path) {
  FileDescriptor file(open(path.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_APPEND | O_CLOEXEC | O_NOFOLLOW, 0644));
  if (file < 0) throw write_error("open", path, errno);
  return file;
}

int code_of(int status) { return WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status); }

}  // namespace

std::string own_program() { return fs::read_symlink("/proc/self/exe").string(); }

pid_t start_child(const std::vector<std::string>& words, const ChildStreams& streams,
                  const std::function<void()>& in_child, const std::vector<char*>& environment) {
  std::vector<char*> argv;
  for (const std::string& word : words) argv.push_back(const_cast<char*>(word.c_str()));
  argv.push_back(nullptr);
  const pid_t parent = getpid();
  // Signals wait until the child has put our handlers away, which would swallow one that comes before the program
  // starts.
  sigset_t all{}, before{};
  sigfillset(&all);
  pthread_sigmask(SIG_BLOCK, &all, &before);
  const pid_t pid = fork();
  if (pid != 0) pthread_sigmask(SIG_SETMASK, &before, nullptr);
  if (pid == 0) {
    signal(SIGINT, SIG_DFL);
    signal(SIGTERM, SIG_DFL);
    signal(SIGPIPE, SIG_DFL);
    pthread_sigmask(SIG_SETMASK, &before, nullptr);
    setpgid(0, 0);                     // Ctrl-C reaches the parent alone, which asks every child once
    prctl(PR_SET_PDEATHSIG, SIGTERM);  // a parent that is killed leaves no child behind
    if (getppid() != parent) _exit(128 + SIGTERM);
    if (in_child) in_child();
    dup2(streams.in < 0 ? open("/dev/null", O_RDONLY | O_CLOEXEC) : streams.in, STDIN_FILENO);
    dup2(streams.out, STDOUT_FILENO);
    dup2(streams.log, STDERR_FILENO);
    execve(argv[0], argv.data(), environment.data());
    _exit(127);
  }
  if (pid < 0)
    throw Error(ErrorKind::unavailable, "system.process.limit", "no process can be started",
                "see what limits them: ulimit -u");
  return pid;
}

Pipe open_pipe(const std::string& program) {
  std::array<int, 2> ends{};
  if (pipe2(ends.data(), O_CLOEXEC) != 0)
    throw Error(ErrorKind::unavailable, "system.process.limit", "no pipe to '" + program + "' can be had",
                "raise the number of open files with `ulimit -n`");
  return {ends[0], ends[1]};
}

OwnedChild::~OwnedChild() {
  if (pid > 0) kill(pid, signal);
  wait();
}

int OwnedChild::wait() { return pid > 0 ? code_of_child(std::exchange(pid, -1)) : 0; }

int code_of_child(pid_t pid) {
  int status = 0;
  while (waitpid(pid, &status, 0) < 0 && errno == EINTR) {
  }
  return code_of(status);
}

pid_t start_child(const std::vector<std::string>& words, const ChildFiles& files,
                  const std::function<void()>& in_child) {
  const FileDescriptor out = output_file(files.out), log = output_file(files.log);
  return start_child(words, ChildStreams{-1, out, log}, in_child);
}

ProcessEnd end_of_child(pid_t pid, const std::function<int()>& stop) {
  ProcessEnd end;
  rusage usage{};
  for (bool told = false; wait4(pid, &end.status, WNOHANG, &usage) != pid;) {
    try {
      if (const int signal = stop(); signal != 0 && !told) told = kill(pid, signal) == 0;
    } catch (...) {
      kill(pid, SIGTERM);
      code_of_child(pid);
      throw;
    }
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
  }
  const auto seconds = [](const timeval& t) {
    return static_cast<double>(t.tv_sec) + 1e-6 * static_cast<double>(t.tv_usec);
  };
  end.peak_mb = static_cast<double>(usage.ru_maxrss) / 1024;
  end.processor_s = seconds(usage.ru_utime) + seconds(usage.ru_stime);
  return end;
}

ChildEnd run_child(const std::vector<std::string>& words) {
  const FileDescriptor out(memfd_create("out", MFD_CLOEXEC));
  const pid_t pid = start_child(words, ChildStreams{-1, out, STDERR_FILENO});
  const int code = code_of(end_of_child(pid, stop_signal).status);
  return {code, read_text_file(fmt::format("/proc/self/fd/{}", static_cast<int>(out)))};
}

int run_logged_child(const std::vector<std::string>& words, const std::string& log, const std::function<void()>& tick) {
  constexpr int kLooksPerTick = 25;
  int look = 0;
  const ProcessEnd end = end_of_child(start_child(words, {log, log}), [&] {
    if (++look % kLooksPerTick == 0) tick();
    return stop_signal();
  });
  return code_of(end.status);
}

std::string last_line(const std::string& log_file) {
  if (!fs::exists(log_file)) return {};
  std::string text = read_text_file(log_file);
  text.resize(text.find_last_not_of('\n') + 1);
  return text.substr(text.rfind('\n') + 1);
}

std::string child_failure(int status, const std::string& log_file) {
  const std::string how = WIFSIGNALED(status) ? fmt::format("ended by signal {}", WTERMSIG(status))
                                              : fmt::format("exit code {}", WEXITSTATUS(status));
  return fmt::format("{}: {} (see {})", how, last_line(log_file), log_file);
}

std::string program_in_path(const std::string& name) {
  const char* const folders = std::getenv("PATH");
  std::istringstream stream(folders == nullptr ? "" : folders);
  for (std::string folder; std::getline(stream, folder, ':');) {
    const std::string candidate = (fs::path(folder.empty() ? "." : folder) / name).string();
    if (is_file(candidate) && access(candidate.c_str(), X_OK) == 0) return candidate;
  }
  return {};
}

}  // namespace semfield::app
