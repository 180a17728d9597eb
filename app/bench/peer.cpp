#include "app/bench/peer.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/wait.h>
#include <unistd.h>

#include <array>
#include <csignal>
#include <nlohmann/json.hpp>

#include "core/error.h"

namespace semfield {

namespace {

std::vector<char*> argv_of(const std::vector<std::string>& words) {
  std::vector<char*> argv;
  for (const std::string& word : words) argv.push_back(const_cast<char*>(word.c_str()));
  argv.push_back(nullptr);
  return argv;
}

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

PeerProcess::PeerProcess(const std::vector<std::string>& words) : name_(words.at(0)) {
  const std::vector<char*> argv = argv_of(words);  // before the fork: the child may not allocate
  std::array<int, 2> in{}, out{};
  if (pipe2(in.data(), O_CLOEXEC) != 0 || pipe2(out.data(), O_CLOEXEC) != 0) {
    throw Error(ErrorKind::unavailable, "system.process.limit", "no pipe to '" + name_ + "'");
  }
  pid_ = fork();
  if (pid_ == 0) {
    dup2(in[0], STDIN_FILENO);
    dup2(out[1], STDOUT_FILENO);
    std::signal(SIGPIPE, SIG_DFL);
    execvp(argv[0], argv.data());
    _exit(127);
  }
  close(in[0]);
  close(out[1]);
  to_ = in[1];
  from_ = out[0];
  if (pid_ < 0) throw Error(ErrorKind::unavailable, "system.process.limit", "cannot start '" + name_ + "'");
}

PeerProcess::~PeerProcess() {
  close(to_);  // the end of its input ends it
  close(from_);
  if (pid_ > 0) {
    kill(pid_, SIGTERM);
    waitpid(pid_, nullptr, 0);
  }
}

std::string PeerProcess::read_line() {
  std::size_t end = 0;
  while ((end = pending_.find('\n')) == std::string::npos) {
    std::array<char, 4096> buffer;
    const ssize_t got = read(from_, buffer.data(), buffer.size());
    if (got <= 0) throw Error(ErrorKind::unavailable, "study.peer.failed", "'" + name_ + "' ended without an answer");
    pending_.append(buffer.data(), static_cast<std::size_t>(got));
  }
  std::string line = pending_.substr(0, end);
  pending_.erase(0, end + 1);
  return line;
}

std::string PeerProcess::ask(const std::string& line) {
  const std::string text = line + "\n";
  for (std::size_t sent = 0; sent < text.size();) {
    const ssize_t n = write(to_, text.data() + sent, text.size() - sent);
    if (n <= 0) throw Error(ErrorKind::unavailable, "study.peer.failed", "'" + name_ + "' takes no more requests");
    sent += static_cast<std::size_t>(n);
  }
  return read_line();
}

int run_silently(const std::vector<std::string>& words) {
  const std::vector<char*> argv = argv_of(words);
  const pid_t pid = fork();
  if (pid < 0) return 127;
  if (pid == 0) {
    const int null = open("/dev/null", O_RDWR);
    for (const int fd : {STDIN_FILENO, STDOUT_FILENO, STDERR_FILENO}) dup2(null, fd);
    execvp(argv[0], argv.data());
    _exit(127);
  }
  int status = 0;
  waitpid(pid, &status, 0);
  return WIFEXITED(status) ? WEXITSTATUS(status) : 127;
}

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
