#include "studies/peer.h"

#include <fmt/format.h>

#include <memory>
#include <nlohmann/json.hpp>

#include "core/error.h"

namespace semfield {

namespace {

using nlohmann::json;

std::string python_with_torch(const std::string& chosen) {
  const std::vector<std::string> candidates =
      chosen.empty() ? std::vector<std::string>{"python3", "/usr/bin/python3"} : std::vector<std::string>{chosen};
  for (const std::string& python : candidates) {
    if (run_silently({python, "-c", "import torch"}) == 0) return python;
  }
  throw Error(ErrorKind::unavailable, "study.peer.missing", "no Python with torch (asked: " + join(candidates) + ")",
              "install python3-torch, or name an interpreter with --python");
}

json parsed(const std::string& line) {
  const json answer = json::parse(line, nullptr, false);
  if (!answer.is_object())
    throw Error(ErrorKind::unavailable, "study.peer.failed", "the peer answered '" + line.substr(0, 200) + "'");
  if (answer.contains("error")) throw Error(ErrorKind::unavailable, "study.peer.failed", answer["error"].dump());
  return answer;
}

}  // namespace

Peer::Peer(const std::string& script, const std::string& python, int threads, bool tuned, const std::string& device) {
  std::vector<std::string> words{python_with_torch(python), script, "--serve", "--device", device};
  if (tuned) {
    words.insert(words.end(), {"--tuned", "--threads", std::to_string(threads)});
  } else if (device == "cpu") {
    words.push_back("--plain");
  }
  process_ = std::make_unique<PeerProcess>(words);
  const json about = parsed(process_->read_line());
  description_ = fmt::format("PyTorch {}, {} threads, BLAS {}, allocator {}, ATen {}", about.value("torch", "?"),
                             about.value("threads", 0), about.value("blas", "?"),
                             about.value("preload", "").empty() ? "of the C library" : about.value("preload", ""),
                             about.value("capability", "?"));
  if (device == "cpu" && about.value("blas", "") == "reference") {
    throw Error(ErrorKind::unavailable, "study.peer.slow",
                "PyTorch here multiplies matrices with the reference BLAS, 50 times too slow to compare",
                "install libopenblas0-openmp");
  }
}

PeerTimes Peer::measure(const PeerRequest& r) {
  const json request{{"net", r.net},         {"mode", r.mode},   {"rays", r.rays},
                     {"classes", r.classes}, {"steps", r.steps}, {"log2_entries", r.log2_entries}};
  const json answer = parsed(process_->ask(request.dump()));
  return {answer.value("seconds", 0.0), answer.value("processor", 0.0)};
}

}  // namespace semfield
