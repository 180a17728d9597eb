// Another program that answers one line for each line, so that its work can alternate with ours.
#pragma once

#include <string>
#include <vector>

namespace semfield {

class PeerProcess {
 public:
  /// Starts `words` (found on PATH) with pipes to its stdin and stdout; stderr is shared. Throws Error(unavailable).
  explicit PeerProcess(const std::vector<std::string>& words);
  ~PeerProcess();
  PeerProcess(const PeerProcess&) = delete;
  PeerProcess& operator=(const PeerProcess&) = delete;

  /// One line of its output, without the end. Throws Error(unavailable) when it has ended.
  std::string read_line();
  /// Sends a line, waits for the answer.
  std::string ask(const std::string& line);

 private:
  std::string name_, pending_;
  int pid_ = -1, to_ = -1, from_ = -1;
};

/// Exit code of `words`, with its output thrown away; 127 when it cannot be started.
int run_silently(const std::vector<std::string>& words);

}  // namespace semfield
