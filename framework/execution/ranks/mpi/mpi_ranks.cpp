// Ranks by MPI: every call is a request that is asked for while the other processes are watched, so that one that was
// killed is noticed and nobody waits for it.
#include <mpi.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <climits>
#include <fstream>
#include <numeric>
#include <sstream>
#include <thread>

#include "execution/ranks/ranks.h"

namespace semfield {

namespace {

using Clock = std::chrono::steady_clock;
using std::chrono::duration;

constexpr double kSpin_s = 50e-6, kYield_s = 2e-3;  // then it sleeps between looks
constexpr auto kNap = std::chrono::microseconds(100);
constexpr auto kLongNap = std::chrono::milliseconds(2);   // of a process that has had nothing to do for a second
constexpr double kLook_s = 0.1;                           // between looks at the other processes
constexpr double kGrace_s = 0.5;                          // of Ranks::end_when
constexpr int kAskedTag = 1;                              // of the message that a rank was asked to end
constexpr double kSilence_s = 600;                        // rank 0 waits no longer for an answer
constexpr std::size_t kMostBytes = std::size_t{1} << 30;  // of a message; MPI counts in int

struct Process {
  char host[256] = {};
  long pid = 0;
  long long born = 0;  // clock ticks since the machine started; 0: unknown
};

// Field 22 of /proc/PID/stat, behind the name in parentheses; 0 for a process that is gone or that has ended.
long long birth_of(long pid) {
  std::ifstream file("/proc/" + std::to_string(pid) + "/stat");
  std::string line;
  if (!std::getline(file, line)) return 0;
  std::istringstream fields(line.substr(std::min(line.size(), line.rfind(')') + 1)));
  std::string field;
  fields >> field;
  if (field == "Z" || field == "X") return 0;
  for (int i = 4; i <= 22; ++i) fields >> field;
  return fields ? std::atoll(field.c_str()) : 0;
}

Process this_process() {
  Process self;
  (void)gethostname(self.host, sizeof self.host - 1);
  self.pid = getpid();
  self.born = birth_of(self.pid);
  return self;
}

class MpiRanks final : public Ranks {
 public:
  explicit MpiRanks(const Launched& by) {
    int provided = 0;
    check(MPI_Init_thread(nullptr, nullptr, MPI_THREAD_SERIALIZED, &provided), "starting MPI");
    check(MPI_Comm_set_errhandler(MPI_COMM_WORLD, MPI_ERRORS_RETURN), "starting MPI");
    check(MPI_Comm_rank(MPI_COMM_WORLD, &rank_), "starting MPI");
    check(MPI_Comm_size(MPI_COMM_WORLD, &size_), "starting MPI");
    if (size_ != by.size || rank_ != by.rank) {
      MPI_Finalize();
      throw Error(ErrorKind::unavailable, "ranks.mpi.size",
                  by.by + " started " + std::to_string(by.size) + " processes, but MPI sees " + std::to_string(size_),
                  "start them with the mpirun of the MPI that semfield was built with, or with srun --mpi=pmix");
    }
    processes_.resize(static_cast<std::size_t>(size_));
    names_.resize(processes_.size());
    processes_ = all_of(*this, this_process());
    const Process& self = processes_[static_cast<std::size_t>(rank_)];
    for (int r = 0; r < size_; ++r) {
      Process& other = processes_[static_cast<std::size_t>(r)];
      names_[static_cast<std::size_t>(r)] = "rank " + std::to_string(r) + " on " + other.host;
      const bool here = std::string(other.host) == self.host;
      if (here && r < rank_) ++local_rank_;
      if (here) ++local_size_;
      // One that cannot be seen from here, from within another container for one, cannot be watched.
      if (!here || birth_of(other.pid) != other.born) other.born = 0;
      all_seen_ = all_seen_ && other.born != 0;
    }
  }

  ~MpiRanks() override {
    if (!lost_) MPI_Finalize();
  }

  int rank() const override { return rank_; }
  int size() const override { return size_; }
  const std::string& name_of(int rank) const override { return names_[static_cast<std::size_t>(rank)]; }
  int local_rank() const override { return local_rank_; }
  int local_size() const override { return local_size_; }

  void broadcast(std::span<std::byte> data, int root) override {
    for (std::size_t at = 0; at < data.size(); at += kMostBytes) {
      const std::size_t count = std::min(kMostBytes, data.size() - at);
      MPI_Request request = MPI_REQUEST_NULL;
      check(MPI_Ibcast(data.data() + at, static_cast<int>(count), MPI_BYTE, root, MPI_COMM_WORLD, &request),
            "a broadcast");
      wait(request, "a broadcast");
    }
  }

  void all_gather(std::span<const std::byte> mine, std::span<std::byte> all,
                  std::span<const std::size_t> bytes) override {
    if (total(bytes) > INT_MAX) return one_by_one(mine, all, bytes);
    const auto [counts, places] = layout(bytes);
    MPI_Request request = MPI_REQUEST_NULL;
    check(MPI_Iallgatherv(mine.data(), static_cast<int>(mine.size()), MPI_BYTE, all.data(), counts.data(),
                          places.data(), MPI_BYTE, MPI_COMM_WORLD, &request),
          "a gathering");
    wait(request, "a gathering");
  }

  void send(int to, std::span<const std::byte> data) override {
    for (std::size_t at = 0; at < data.size(); at += kMostBytes) {
      const std::size_t count = std::min(kMostBytes, data.size() - at);
      MPI_Request request = MPI_REQUEST_NULL;
      check(MPI_Isend(data.data() + at, static_cast<int>(count), MPI_BYTE, to, 0, MPI_COMM_WORLD, &request),
            "sending to " + name_of(to));
      wait(request, "sending to " + name_of(to));
    }
  }

  void receive(int from, std::span<std::byte> data) override {
    for (std::size_t at = 0; at < data.size(); at += kMostBytes) {
      const std::size_t count = std::min(kMostBytes, data.size() - at);
      MPI_Request request = MPI_REQUEST_NULL;
      check(MPI_Irecv(data.data() + at, static_cast<int>(count), MPI_BYTE, from, 0, MPI_COMM_WORLD, &request),
            "receiving from " + name_of(from));
      wait(request, "receiving from " + name_of(from));
    }
  }

  void end_when(std::function<bool()> asked, std::function<void()> hear) override {
    asked_ = std::move(asked);
    hear_ = std::move(hear);
  }

  void watch() override {
    if (Clock::now() - watched_ < std::chrono::duration<double>(kLook_s)) return;
    watched_ = Clock::now();
    look();
  }
  bool lost() const override { return lost_; }
  void abandon(int code) override { MPI_Abort(MPI_COMM_WORLD, code); }

 private:
  static std::size_t total(std::span<const std::size_t> bytes) {
    return std::accumulate(bytes.begin(), bytes.end(), std::size_t{0});
  }

  struct Layout {
    std::vector<int> counts, places;
  };
  static Layout layout(std::span<const std::size_t> bytes) {
    Layout out;
    int at = 0;
    for (const std::size_t count : bytes) {
      out.counts.push_back(static_cast<int>(count));
      out.places.push_back(at);
      at += static_cast<int>(count);
    }
    return out;
  }

  // More than MPI's counts can say at once.
  void one_by_one(std::span<const std::byte> mine, std::span<std::byte> all, std::span<const std::size_t> bytes) {
    std::size_t at = 0;
    for (int r = 0; r < size_; ++r) {
      const std::span<std::byte> part = all.subspan(at, bytes[static_cast<std::size_t>(r)]);
      if (r == rank_) std::copy(mine.begin(), mine.end(), part.begin());
      broadcast(part, r);
      at += part.size();
    }
  }

  [[noreturn]] void lose(std::string what) {
    lost_ = true;
    why_ = what;
    throw RankLost(ErrorKind::failure, "ranks.process.lost", what, "its own messages may say why");
  }

  void check(int code, const std::string& doing) {
    if (code == MPI_SUCCESS) return;
    char text[MPI_MAX_ERROR_STRING] = {};
    int length = 0;
    MPI_Error_string(code, text, &length);
    lose("MPI failed while " + doing + ": " + std::string(text, static_cast<std::size_t>(length)));
  }

  void wait(MPI_Request& request, const std::string& doing) {
    if (lost_) lose(why_);
    pass_on();
    const Clock::time_point start = Clock::now();
    Clock::time_point looked = start;
    double asked_at = -1;
    int done = 0;
    for (;;) {
      check(MPI_Test(&request, &done, MPI_STATUS_IGNORE), doing);
      if (done != 0) return;
      const Clock::time_point now = Clock::now();
      const double waited = duration<double>(now - start).count();
      if (waited < kSpin_s) continue;
      if (waited < kYield_s) {
        std::this_thread::yield();
        continue;
      }
      std::this_thread::sleep_for(waited < 1 ? std::chrono::microseconds(kNap) : std::chrono::microseconds(kLongNap));
      if (duration<double>(now - looked).count() < kLook_s) continue;
      looked = now;
      look();
      pass_on();
      if (rank_ == 0 && !all_seen_ && asked_ && asked_()) {
        if (asked_at < 0) asked_at = waited;
        if (waited - asked_at > kGrace_s)
          lose("this process was asked to end while it waited for the others (" + doing + ")");
      }
      if (rank_ == 0 && waited > kSilence_s)
        lose("the other processes have not answered for " + std::to_string(static_cast<int>(kSilence_s)) + " s (" +
             doing + ")");
    }
  }

  // That a rank was asked to end, from it to rank 0.
  void pass_on() {
    if (rank_ != 0) {
      if (told_ || !asked_ || !asked_()) return;
      told_ = true;
      MPI_Request request = MPI_REQUEST_NULL;
      check(MPI_Isend(nullptr, 0, MPI_BYTE, 0, kAskedTag, MPI_COMM_WORLD, &request), "sending to " + name_of(0));
      MPI_Request_free(&request);
      return;
    }
    for (;;) {
      int came = 0;
      MPI_Status status;
      check(MPI_Iprobe(MPI_ANY_SOURCE, kAskedTag, MPI_COMM_WORLD, &came, &status), "listening to the other processes");
      if (came == 0) return;
      check(MPI_Recv(nullptr, 0, MPI_BYTE, status.MPI_SOURCE, kAskedTag, MPI_COMM_WORLD, MPI_STATUS_IGNORE),
            "receiving from " + name_of(status.MPI_SOURCE));
      if (hear_) hear_();
    }
  }

  // At the processes of this host; of those elsewhere the launcher takes care.
  void look() {
    for (int r = 0; r < size_; ++r) {
      const Process& other = processes_[static_cast<std::size_t>(r)];
      if (other.born == 0 || birth_of(other.pid) == other.born) continue;
      lose(name_of(r) + " (process " + std::to_string(other.pid) + ") has ended");
    }
  }

  int rank_ = 0, size_ = 1, local_rank_ = 0, local_size_ = 0;
  std::vector<Process> processes_;
  std::vector<std::string> names_;
  std::function<bool()> asked_;
  std::function<void()> hear_;
  bool told_ = false;  // rank 0, that this process was asked to end
  Clock::time_point watched_;
  bool all_seen_ = true;  // every process runs where it can be looked at
  bool lost_ = false;
  std::string why_;
};

}  // namespace

}  // namespace semfield

extern "C" semfield::Ranks* semfield_join_ranks(const semfield::Launched* by);
extern "C" semfield::Ranks* semfield_join_ranks(const semfield::Launched* by) { return new semfield::MpiRanks(*by); }
