// What a disk may hold after a power cut in the middle of recorded file calls.

#include <alloca.h>
#include <fcntl.h>
#include <signal.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>
#include <limits>
#include <set>

#include "core/process.h"
#include "core/rng.h"
#include "tests/crash/victim_runs.h"

namespace semfield::testing_crash {
namespace {

/// Files by path relative to the root, with their bytes.
using DiskState = std::map<std::string, std::string>;

/// The model. A call is one or several effects: a write is cut into two pieces, each of which may be on the disk, be
/// missing (the bytes before it stay; behind a later piece it reads as zeros) or be allocated and never filled (zeros);
/// creating, renaming and removing an entry and making a folder are each there whole or not at all. Effects become
/// durable by fsync alone: that of a file makes its bytes so, but not its name; that of a folder its entries, but not
/// those files' bytes. Everything else of the first n calls may be there or not, in any combination: neither bytes nor
/// names keep their order. This is weaker than any file system in use promises (all of them order a folder's entries,
/// and most write a file's bytes before its new name), so what holds here holds there.
///
/// Combinations are exhausted up to `kMostFree` pending effects. Beyond them (many writes into one file before its
/// fsync) the pieces are varied one at a time, and as prefixes, against all kept and all lost.
class ReorderModel {
 public:
  static constexpr std::size_t kMostFree = 9;

  /// `before`: the disk's durable state; paths of `calls` lie below `root`.
  ReorderModel(DiskState before, const std::string& root, std::vector<FileCall> calls);

  /// Calls body(state, calls done) for every different state after every number of calls, 0 to all.
  void each_state(const std::function<void(const DiskState&, std::size_t)>& body) const;

 private:
  enum class Kind { create, write, truncate, rename, unlink, make_folder };
  struct Effect {
    Kind kind{};
    int file = -1;            // which file, by order of appearance: a file keeps its number when it is renamed
    std::string path, other;  // entries
    std::int64_t offset = 0;
    std::string data;
    std::size_t call = 0;        // index of the call that causes it
    std::size_t durable_at = 0;  // after so many calls it cannot be lost; far beyond them: never
  };
  enum class Fate : std::uint8_t { kept, lost, zeros };

  std::vector<std::vector<Fate>> fates(const std::vector<const Effect*>& pending) const;
  DiskState apply(std::size_t done, const std::map<const Effect*, Fate>& fate) const;

  DiskState before_;
  std::map<std::string, int> file_of_before_;
  std::size_t calls_ = 0;
  std::vector<Effect> effects_;
};

constexpr std::size_t kNever = std::numeric_limits<std::size_t>::max();

std::string folder_of(const std::string& path) {
  const std::size_t slash = path.rfind('/');
  return slash == std::string::npos ? std::string() : path.substr(0, slash);
}

DiskState read_disk(const std::string& root) {
  DiskState state;
  for (const auto& entry : fs::recursive_directory_iterator(root)) {
    if (entry.is_regular_file())
      state[fs::relative(entry.path(), root).string()] = read_text_file(entry.path().string());
  }
  return state;
}

/// Makes `root` hold exactly this.
void write_disk(const DiskState& state, const std::string& root) {
  fs::remove_all(root);
  fs::create_directories(root);
  for (const auto& [path, bytes] : state) {
    fs::create_directories((fs::path(root) / path).parent_path());
    testing_room::plain_write((fs::path(root) / path).string(), bytes);
  }
}

ReorderModel::ReorderModel(DiskState before, const std::string& root, std::vector<FileCall> calls)
    : before_(std::move(before)), calls_(calls.size()) {
  const auto relative = [&](const std::string& path) {
    return path.size() <= root.size() ? "" : path.substr(root.size() + 1);
  };
  int files = 0;
  for (const auto& [path, bytes] : before_) file_of_before_[path] = files++;
  std::map<std::string, int> entries = file_of_before_;
  std::map<int, int> file_of_descriptor;  // -1: a folder
  std::map<int, std::string> folder_of_descriptor;
  for (std::size_t i = 0; i < calls.size(); ++i) {
    const FileCall& c = calls[i];
    if (c.result < 0) continue;
    Effect e;
    e.call = i;
    e.durable_at = kNever;
    e.path = relative(c.path);
    if (c.name == "open") {
      const int descriptor = static_cast<int>(c.result);
      if ((c.size & O_DIRECTORY) != 0) {
        file_of_descriptor[descriptor] = -1;
        folder_of_descriptor[descriptor] = e.path;
        continue;
      }
      if (!entries.contains(e.path)) {
        e.kind = Kind::create;
        e.file = entries[e.path] = files++;
        effects_.push_back(e);
      }
      file_of_descriptor[descriptor] = entries[e.path];
    } else if (c.name == "write") {
      e.kind = Kind::write;
      e.file = file_of_descriptor.at(c.descriptor);
      const std::size_t half = c.data.size() / 2;
      for (const auto& [begin, size] : {std::pair{std::size_t{0}, half}, std::pair{half, c.data.size() - half}}) {
        if (size == 0) continue;
        e.offset = c.offset + static_cast<std::int64_t>(begin);
        e.data = c.data.substr(begin, size);
        effects_.push_back(e);
      }
    } else if (c.name == "ftruncate") {
      e.kind = Kind::truncate;
      e.file = file_of_descriptor.at(c.descriptor);
      e.offset = c.size;
      effects_.push_back(e);
    } else if (c.name == "fsync") {
      const int file = file_of_descriptor.at(c.descriptor);
      for (Effect& earlier : effects_) {
        const bool bytes = earlier.kind == Kind::write || earlier.kind == Kind::truncate;
        const bool covered = file >= 0 ? bytes && earlier.file == file
                                       : !bytes && folder_of(earlier.path) == folder_of_descriptor.at(c.descriptor);
        if (covered && earlier.durable_at == kNever) earlier.durable_at = i + 1;
      }
    } else if (c.name == "rename") {
      e.kind = Kind::rename;
      e.other = relative(c.other);
      e.file = entries.at(e.path);
      entries[e.other] = e.file;
      entries.erase(e.path);
      effects_.push_back(e);
    } else if (c.name == "unlink") {
      e.kind = Kind::unlink;
      entries.erase(e.path);
      effects_.push_back(e);
    } else if (c.name == "mkdir") {
      e.kind = Kind::make_folder;
      effects_.push_back(e);
    }
  }
}

std::vector<std::vector<ReorderModel::Fate>> ReorderModel::fates(const std::vector<const Effect*>& pending) const {
  const auto choices = [&](std::size_t i) {
    return pending[i]->kind == Kind::write ? std::vector<Fate>{Fate::kept, Fate::lost, Fate::zeros}
                                           : std::vector<Fate>{Fate::kept, Fate::lost};
  };
  std::vector<std::vector<Fate>> all{{}};
  if (pending.size() <= kMostFree) {
    for (std::size_t i = 0; i < pending.size(); ++i) {
      std::vector<std::vector<Fate>> longer;
      for (const std::vector<Fate>& begun : all) {
        for (const Fate fate : choices(i)) {
          longer.push_back(begun);
          longer.back().push_back(fate);
        }
      }
      all = std::move(longer);
    }
    return all;
  }
  all.clear();
  const std::size_t n = pending.size();
  for (const Fate most : {Fate::kept, Fate::lost}) {
    all.emplace_back(n, most);
    for (std::size_t i = 0; i < n; ++i) {
      for (const Fate fate : choices(i)) {
        all.emplace_back(n, most);
        all.back()[i] = fate;
      }
      all.emplace_back(n, most);
      std::fill_n(all.back().begin(), i, most == Fate::kept ? Fate::lost : Fate::kept);
    }
  }
  return all;
}

DiskState ReorderModel::apply(std::size_t done, const std::map<const Effect*, Fate>& fate) const {
  std::map<std::string, int> entries = file_of_before_;
  std::map<int, std::string> bytes;
  for (const auto& [path, content] : before_) bytes[file_of_before_.at(path)] = content;
  std::set<std::string> lost_folders;
  for (const Effect& e : effects_) {
    if (e.call >= done) break;
    const auto chosen = fate.find(&e);
    const Fate f = chosen == fate.end() ? Fate::kept : chosen->second;
    if (f == Fate::lost && e.kind == Kind::make_folder) lost_folders.insert(e.path);
    if (f == Fate::lost) continue;
    std::string& content = bytes[e.file];
    if (e.kind == Kind::create) entries[e.path] = e.file;
    if (e.kind == Kind::unlink) entries.erase(e.path);
    if (e.kind == Kind::truncate) content.resize(static_cast<std::size_t>(e.offset));
    if (e.kind == Kind::rename) {
      entries[e.other] = e.file;
      entries.erase(e.path);
    }
    if (e.kind == Kind::write) {
      const auto offset = static_cast<std::size_t>(e.offset);
      content.resize(std::max(content.size(), offset + e.data.size()));
      content.replace(offset, e.data.size(), f == Fate::zeros ? std::string(e.data.size(), '\0') : e.data);
    }
  }
  DiskState state;
  for (const auto& [path, file] : entries) {
    bool reachable = true;
    for (std::string above = folder_of(path); !above.empty(); above = folder_of(above))
      reachable = reachable && !lost_folders.contains(above);
    if (reachable) state[path] = bytes[file];
  }
  return state;
}

void ReorderModel::each_state(const std::function<void(const DiskState&, std::size_t)>& body) const {
  for (std::size_t done = 0; done <= calls_; ++done) {
    std::vector<const Effect*> pending;
    for (const Effect& e : effects_) {
      if (e.call < done && e.durable_at > done) pending.push_back(&e);
    }
    std::set<DiskState> seen;
    for (const std::vector<Fate>& choice : fates(pending)) {
      std::map<const Effect*, Fate> fate;
      for (std::size_t i = 0; i < pending.size(); ++i) fate[pending[i]] = choice[i];
      DiskState state = apply(done, fate);
      if (!seen.insert(state).second) continue;
      body(state, done);
    }
  }
}

// A save whose n-th file call fails, for all n: it succeeds where the failure means nothing, and else ends with the
// right kind of error, the old data and no temporary file.

bool creates(const FileCall& call) { return call.name == "open" && (call.size & O_CREAT) != 0; }

// Errors that a kind of call can give.
std::vector<int> causes_of(const FileCall& call) {
  if (call.name == "open" && creates(call)) return {ENOSPC, EDQUOT, EIO, EINTR, EMFILE, EACCES, EROFS};
  if (call.name == "open") return {EIO, EINTR, EMFILE};
  if (call.name == "read") return {EIO, EINTR};
  if (call.name == "write") return {ENOSPC, EDQUOT, EIO, EINTR, EFBIG};
  if (call.name == "fsync") return {EIO, ENOSPC, EDQUOT, EINTR};
  if (call.name == "close") return {EIO, EINTR};
  if (call.name == "flock") return {EINTR, ENOLCK, EWOULDBLOCK};
  if (call.name == "rename") return {EXDEV, EACCES, EIO, ENOSPC};
  if (call.name == "unlink") return {EIO, EACCES};
  if (call.name == "mkdir") return {ENOSPC, EACCES, EIO};
  return {EIO};
}

// Failures that may not disturb the save: those that POSIX wants tried again, locks (another name is taken, or none is
// needed), closing what is synced, old checkpoints that stay on the disk, and folders that are there already.
bool harmless(const FileCall& call, int cause) {
  const bool sets_aside = call.name == "rename" && call.other.ends_with(".abandoned");
  return cause == EINTR || call.name == "flock" || call.name == "close" || call.name == "unlink" || sets_aside ||
         (call.name == "mkdir" && call.cause == EEXIST);
}

int exit_code_of(int cause) { return cause == EACCES || cause == EROFS ? 73 : 74; }

std::string word_of(int cause) {
  return cause == ENOSPC || cause == EDQUOT ? "disk full: need "
         : cause == EFBIG                   ? "the limit of a file's size is reached: need "
                                            : std::strerror(cause);
}

// An fsync that failed is final: the same descriptor is not synced again.
void expect_no_second_sync(const std::vector<FileCall>& calls, const std::string& place) {
  for (auto call = calls.begin(); call != calls.end(); ++call) {
    if (call->name != "fsync" || call->result == 0 || call->cause == EINTR) continue;
    for (auto later = call + 1; later != calls.end() && later->descriptor == call->descriptor; ++later)
      EXPECT_NE(later->name, "fsync") << place;
  }
}

class Faults : public ::testing::TestWithParam<Save> {};

TEST_P(Faults, AtEveryCallKeepTheOldDataAndSayWhy) {
  const Undisturbed& u = undisturbed(GetParam());
  // The call that makes the new data the data; behind it an error is reported, and the new stays.
  const auto replaces = std::find_if(u.calls.begin(), u.calls.end(), [](const FileCall& c) {
    return c.name == "rename" &&
           (c.other.ends_with(".safetensors") || c.other.ends_with(".yaml") || c.other.ends_with(".sfpack"));
  });
  ASSERT_NE(replaces, u.calls.end());
  // A folder of checkpoints is first looked through for leftovers; what cannot be looked at stays. Libraries differ in
  // whether that opening can be seen; the one after the first file was made belongs to the save.
  const auto makes = std::find_if(u.calls.begin(), u.calls.end(), creates);
  const auto found_look = std::find_if(u.calls.begin(), makes, [](const FileCall& c) {
    return c.name == "open" && (c.size & O_DIRECTORY) != 0 && c.path.ends_with("/checkpoints");
  });
  const long look_number = found_look == makes ? -1 : found_look->number;
  int refused = 0, survived = 0;
  for (const FileCall& call : u.calls) {
    for (const int cause : causes_of(call)) {
      for (const bool sticky : {false, true}) {
        if (sticky && (cause != ENOSPC || (call.name != "write" && !creates(call)))) continue;
        const std::string place = std::string(std::strerror(cause)) + (sticky ? " from" : " at") + " call " +
                                  std::to_string(call.number) + ", " + call.name + " " + call.path;
        Trial trial(GetParam());
        const testing_program::Result r = trial.save({call.number, std::to_string(cause), sticky});
        const std::vector<FileCall> calls = trial.calls();
        if (harmless(call, cause) || call.number == look_number) {
          ++survived;
          EXPECT_EQ(r.code, 0) << place << ": " << r.err;
        } else {
          ++refused;
          EXPECT_EQ(r.code, exit_code_of(cause)) << place << ": " << r.err;
          EXPECT_HAS(r.err, trial.folder(), word_of(cause), "; ") << place << " names path, cause and remedy";
        }
        // A temporary file stays only where removing it is what failed.
        for (const auto& entry : std::filesystem::recursive_directory_iterator(trial.folder()))
          EXPECT_NE(entry.path().extension(), ".tmp") << place;
        expect_no_second_sync(calls, place);
        const Look found = trial.look();
        EXPECT_EQ(found.bad, "") << place;
        const bool renewed = r.code == 0 || call.number > replaces->number;
        EXPECT_EQ(found.crc, renewed ? u.new_crc : u.old_crc) << place;
      }
    }
  }
  EXPECT_GT(refused, 10);
  EXPECT_GT(survived, 5);
}

std::string param_name(const ::testing::TestParamInfo<Save>& info) { return name_of(info.param); }
INSTANTIATE_TEST_SUITE_P(EverySave, Faults, ::testing::ValuesIn(kSaves), param_name);

// A save, and an event for a log, killed before, in and after every one of its file calls: a fresh process finds the
// old or the new, whole.

class Kill : public ::testing::TestWithParam<Save> {};

TEST_P(Kill, AtEveryCallLeavesTheOldOrTheNewWhole) {
  const Undisturbed& u = undisturbed(GetParam());
  const bool replaces = GetParam() != Save::clicks;
  int found_old = 0, found_new = 0, stale = 0;
  for (const FileCall& call : u.calls) {
    for (const char* kind : {"kill_before", "kill_half", "kill_after"}) {
      if (std::string(kind) == "kill_half" && (call.name != "write" || call.size < 2)) continue;
      const std::string place = std::string(kind) + " " + call.name + " " + call.path + ", call " +
                                std::to_string(call.number) + " of " + std::to_string(u.calls.size());
      Trial trial(GetParam());
      ASSERT_EQ(trial.save({call.number, kind, false}).signal, SIGKILL) << place;
      for (const auto& entry : std::filesystem::recursive_directory_iterator(trial.folder()))
        stale += entry.path().extension() == ".tmp" ? 1 : 0;
      const Look found = trial.look();
      EXPECT_EQ(found.bad, "") << place;
      EXPECT_EQ(found.temporaries, 0) << place;
      EXPECT_TRUE(found.crc == u.old_crc || found.crc == u.new_crc) << place;
      (found.crc == u.old_crc ? found_old : found_new) += 1;
      if (!replaces) continue;
      // The same save again, by a next process, ends as if nothing had been.
      (void)testing_program::succeeded(trial.save());
      EXPECT_EQ(trial.look().crc, u.new_crc) << place;
    }
  }
  EXPECT_GT(found_old, 0);
  EXPECT_GT(found_new, 0);
  EXPECT_EQ(stale > 0, replaces) << "no kill left a temporary file, so their removal was not tried";
}

TEST_P(Kill, ShortWritesAreGoneOnWith) {
  const Undisturbed& u = undisturbed(GetParam());
  const bool log = GetParam() == Save::clicks;
  int tried = 0;
  for (const FileCall& call : u.calls) {
    if (call.name != "write" || call.size < 2 || (log && !call.path.ends_with("/clicks.jsonl"))) continue;
    Trial trial(GetParam());
    (void)testing_program::succeeded(trial.save({call.number, "short", false}));
    EXPECT_GT(trial.calls().size(), u.calls.size()) << "the rest was not written by a call of its own";
    EXPECT_EQ(trial.look().crc, u.new_crc);
    ++tried;
  }
  EXPECT_GE(tried, 1);
}

INSTANTIATE_TEST_SUITE_P(EverySave, Kill, ::testing::ValuesIn(kSaves), param_name);
INSTANTIATE_TEST_SUITE_P(ALog, Kill, ::testing::Values(Save::clicks), param_name);

// Power cuts that nobody can stage: every state of the disk that a recorded save allows holds the old or the new whole,
// and the new one once the save has returned.

struct Verdict {
  int torn = 0, forgotten = 0, found_old = 0, found_new = 0;
  std::string first;  // what the first bad state was
};

Verdict judge(Save what, const std::vector<FileCall>& calls, const DiskState& before, const std::string& root) {
  const Undisturbed& u = undisturbed(what);
  const TempDir disk;
  Verdict v;
  ReorderModel(before, root, calls).each_state([&](const DiskState& state, std::size_t done) {
    write_disk(state, disk.path() + "/d");
    const Look found = look(what, disk.path() + "/d");
    const bool is_old = found.bad.empty() && found.crc == u.old_crc,
               is_new = found.bad.empty() && found.crc == u.new_crc;
    const bool forgotten = !is_new && done == calls.size();
    v.found_old += is_old ? 1 : 0;
    v.found_new += is_new ? 1 : 0;
    v.torn += is_old || is_new ? 0 : 1;
    v.forgotten += forgotten ? 1 : 0;
    if ((forgotten || (!is_old && !is_new)) && v.first.empty())
      v.first = "after " + std::to_string(done) + " calls: " + (found.bad.empty() ? "the old one" : found.bad);
  });
  return v;
}

struct Reorder : ::testing::TestWithParam<Save> {
  void SetUp() override {
    Trial trial(GetParam());
    before_ = read_disk(trial.folder());
    root_ = trial.folder();
    ASSERT_EQ(trial.save().code, 0);
    calls_ = trial.calls();
  }
  DiskState before_;
  std::string root_;
  std::vector<FileCall> calls_;
};

TEST_P(Reorder, EveryStateHoldsTheOldOrTheNewAndInTheEndTheNew) {
  const Verdict v = judge(GetParam(), calls_, before_, root_);
  EXPECT_EQ(v.torn, 0) << v.first;
  EXPECT_EQ(v.forgotten, 0) << v.first;
  EXPECT_GT(v.found_old, 0);
  EXPECT_GT(v.found_new, 0);
}

INSTANTIATE_TEST_SUITE_P(EverySave, Reorder, ::testing::ValuesIn(kSaves), param_name);

// A packed scene that rots, flipped in a bit or cut: noticed, with the file's name. (G09 and G10 rot checkpoints.)
TEST(Damage, OfAPackedSceneIsNoticed) {
  const TempDir dir;
  prepare(Save::scene, dir.path());
  const std::string path = dir / "room.sfpack", sound = read_text_file(path);
  const auto read_with = [&](const std::string& bytes) {
    testing_room::plain_write(path, bytes);
    return error_of([&] {
      const PackedScene scene(path);
      FrameBuffer buffer;
      for (std::size_t i = 0; i < scene.info().frames.size(); ++i) scene.read(static_cast<int>(i), buffer);
    });
  };
  EXPECT_EQ(read_with(sound), "") << "the control: undamaged, it is read";
  for (std::uint64_t i = 0; i < 5'000; ++i) {
    // The first bits are those of the head, where the lengths stand; the rest is drawn.
    const std::uint64_t bit = i < 1'000 ? i : uniform_below({31, 0, 1}, i, 8 * sound.size());
    std::string bytes = sound;
    bytes[bit / 8] = static_cast<char>(bytes[bit / 8] ^ (1 << (bit % 8)));
    ASSERT_EQ(unsaid(read_with(bytes), {path}), "") << "bit " << bit;
    if (i >= 500) continue;
    const std::uint64_t size = uniform_below({31, 0, 2}, i, sound.size());
    ASSERT_EQ(unsaid(read_with(sound.substr(0, size)), {path}), "") << "cut to " << size;
  }
}

// The log of label events, failing at every file call.

TEST(ClickLogFaults, AtEveryCallAreToldAndLeaveTheLogAsItWas) {
  const Undisturbed& u = undisturbed(Save::clicks);
  int refused = 0;
  for (const FileCall& call : u.calls) {
    if (call.name != "open" && call.name != "read" && call.name != "write" && call.name != "fsync") continue;
    for (const int cause : {EIO, ENOSPC, EINTR}) {
      for (const bool sticky : {false, true}) {
        if (call.name == "read" && cause == ENOSPC) continue;
        if (sticky && cause != ENOSPC) continue;
        const std::string place = std::string(std::strerror(cause)) + " at " + call.name + " " + call.path;
        Trial trial(Save::clicks);
        const testing_program::Result r = trial.save({call.number, std::to_string(cause), sticky});
        const Look found = trial.look();
        EXPECT_EQ(found.bad, "") << place;
        if (cause == EINTR) {
          EXPECT_EQ(r.code, 0) << place << ": " << r.err;
          EXPECT_EQ(found.crc, u.new_crc) << place;
          continue;
        }
        ++refused;
        EXPECT_NE(r.code, 0) << place;
        EXPECT_HAS(r.err, trial.folder()) << place << " names no path: " << r.err;
        // Where not even the taking back succeeds, an event stays that was not acknowledged.
        if (sticky && call.name == "fsync") continue;
        EXPECT_EQ(found.crc, u.old_crc) << place << ": " << r.err;
      }
    }
  }
  EXPECT_GT(refused, 10);
}

TEST(ClickLogFaults, TheEventIsSyncedAndSoIsItsFilesEntry) {
  bool written = false, event = false, entry = false;
  for (const FileCall& call : undisturbed(Save::clicks).calls) {
    written = written || call.name == "write";
    event = event || (written && call.name == "fsync" && call.path.ends_with("/clicks.jsonl"));
    entry = entry || (call.name == "fsync" && call.path.ends_with("/work"));
  }
  EXPECT_TRUE(event && entry);
}

// Pages of the stack below here, as a deep call takes them.
__attribute__((noinline)) void use_stack(std::size_t bytes) {
  auto* const stack = static_cast<volatile char*>(alloca(bytes));
  for (std::size_t at = bytes; at >= 4096; at -= 4096) stack[at - 1] = 0;
}

// How a process ends that uses its stack when its address space is used up.
int signal_of_full_process(bool claims) {
  const pid_t pid = fork();
  if (pid == 0) {
    const bool claimed = claims && claim_stack();
    const rlimit none{4096, 4096};
    setrlimit(RLIMIT_AS, &none);
    use_stack(std::size_t{900} << 10);
    _exit(claimed == claims && !claim_stack() ? 0 : 1);
  }
  int status = 0;
  waitpid(pid, &status, 0);
  return WIFSIGNALED(status) ? WTERMSIG(status) : WEXITSTATUS(status);
}

TEST(Stack, WhatWasClaimedIsThereWhenNoMemoryIs) {
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
  GTEST_SKIP() << "a sanitizer reserves more address space than any limit allows";
#endif
  EXPECT_EQ(signal_of_full_process(false), SIGSEGV);
  EXPECT_EQ(signal_of_full_process(true), 0);
}

}  // namespace
}  // namespace semfield::testing_crash
