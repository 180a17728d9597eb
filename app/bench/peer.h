// The PyTorch steps of studies/peers as a program that measures on request: it answers one line for each line, so that
// its work can alternate with ours.
#pragma once

#include <cstdint>
#include <memory>
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

/// One step of the peer to be measured.
struct PeerRequest {
  std::string net;  ///< paper or hash
  std::string mode = "fp32";
  std::int64_t rays = 1024;
  int classes = 29;
  int log2_entries = 15;  ///< hash
  int steps = 1;          ///< mean of so many
};

/// Of a step; `processor`: summed over the peer's threads.
struct PeerTimes {
  double seconds = 0, processor = 0;
};

class Peer {
 public:
  /// Finds a Python with torch (`python`, or python3 on PATH, or the system's) and starts `script` as a server, tuned
  /// or as installed, on the device (cpu or cuda). Throws Error(unavailable) with the reason where that cannot be had.
  Peer(const std::string& script, const std::string& python, int threads, bool tuned,
       const std::string& device = "cpu");

  /// Throws Error(unavailable) with the peer's own words.
  PeerTimes measure(const PeerRequest& request);
  /// Version, threads and what was tuned, in words.
  const std::string& description() const { return description_; }

 private:
  std::unique_ptr<PeerProcess> process_;
  std::string description_;
};

}  // namespace semfield
