#include "tests/crash/reorder_model.h"

#include <fcntl.h>

#include <algorithm>
#include <limits>
#include <set>

#include "system/files.h"
#include "tests/scene/tiny_scene.h"

namespace semfield::testing_crash {

namespace fs = std::filesystem;

namespace {

constexpr std::size_t kNever = std::numeric_limits<std::size_t>::max();

std::string folder_of(const std::string& path) {
  const std::size_t slash = path.rfind('/');
  return slash == std::string::npos ? std::string() : path.substr(0, slash);
}

}  // namespace

DiskState read_disk(const std::string& root) {
  DiskState state;
  for (const auto& entry : fs::recursive_directory_iterator(root)) {
    if (entry.is_regular_file())
      state[fs::relative(entry.path(), root).string()] = read_text_file(entry.path().string());
  }
  return state;
}

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

int ReorderModel::each_state(const std::function<void(const DiskState&, std::size_t)>& body) const {
  int states = 0;
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
      ++states;
      body(state, done);
    }
  }
  return states;
}

}  // namespace semfield::testing_crash
