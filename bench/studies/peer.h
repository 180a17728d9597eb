// The PyTorch steps of bench/peers as a program that measures on request.
#pragma once

#include <cstdint>
#include <memory>
#include <string>

#include "studies/peer_process.h"

namespace semfield {

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
