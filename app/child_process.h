// This program as a process of its own, which ends with the one that started it.
#pragma once

#include <sys/types.h>

#include <functional>
#include <string>
#include <vector>

#include "core/files.h"
#include "core/non_copyable.h"
#include "execution/ranks/ranks.h"

namespace semfield::app {

/// The file of the running program.
std::string own_program();

struct ChildFiles {
  std::string out, log;  ///< for stdout and stderr, which may be one; replaced
};

/// Standard streams of a child, by the descriptors that become them; `in` -1: it reads nothing.
struct ChildStreams {
  int in, out, log;
};

/// Starts `words`, the first of which is the program's file, in a process group of its own, so that Ctrl-C does not
/// reach it, and by default without what a launcher said to this one (execution/ranks/ranks.h). `in_child` runs between
/// fork and exec, so it calls what is async-signal-safe alone. The thread that starts it is the one that it ends with.
/// Throws write_error for the files, Error(unavailable) where no process can be had.
pid_t start_child(const std::vector<std::string>& words, const ChildFiles& files,
                  const std::function<void()>& in_child = {});
pid_t start_child(const std::vector<std::string>& words, const ChildStreams& streams,
                  const std::function<void()>& in_child = {},
                  const std::vector<char*>& environment = environment_of_child());

/// A pipe to or from a child, which inherits neither end; the caller closes the one that is the child's. Throws
/// Error(unavailable), which names the `program`.
struct Pipe {
  FileDescriptor read, write;
};
Pipe open_pipe(const std::string& program);

/// Waits for it: its exit code, or 128 and the number of the signal that ended it.
int code_of_child(pid_t pid);

struct ProcessEnd {
  int status = 0;                       ///< as wait() tells it
  double peak_mb = 0, processor_s = 0;  ///< what it used
};
/// Waits for it, and sends the signal that `stop` returns on to it once, where that is not 0. `stop` is called now and
/// then, and what it throws ends the child first.
ProcessEnd end_of_child(pid_t pid, const std::function<int()>& stop);

/// A child that this object ends, if it still runs, by a signal.
struct OwnedChild : NonCopyable {
  explicit OwnedChild(int by) : signal(by) {}
  ~OwnedChild();
  /// As code_of_child.
  int wait();

  int signal;
  pid_t pid = -1;
};

struct ChildEnd {
  int code = 0;  ///< its exit code, or 128 and the number of the signal that ended it
  std::string out;
};

/// Starts `words` as start_child does and waits for the end. Its stderr is this program's own, what it prints to stdout
/// comes back. A stop signal that came here (app/signals.h, installed by the caller) is sent on to it once. Throws
/// Error(unavailable) where no process can be had.
ChildEnd run_child(const std::vector<std::string>& words);

/// Starts `words` as start_child does, with stdout and stderr in `log`, and waits for the end; `tick` is called about
/// twice a second, and what it throws ends the child first. A stop signal that came here is sent on to it once. Returns
/// the code as ChildEnd has it.
int run_logged_child(const std::vector<std::string>& words, const std::string& log, const std::function<void()>& tick);

/// What a program said last in its log; "" where it has said nothing.
std::string last_line(const std::string& log_file);
/// How a child that ended with this status failed: code or signal, the last line of its log, and where the rest is.
std::string child_failure(int status, const std::string& log_file);

// Programs of others, found as a shell finds them.

/// File of the first program of that name in the folders of PATH; "" where there is none.
std::string program_in_path(const std::string& name);

}  // namespace semfield::app
