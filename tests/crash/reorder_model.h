// What a disk may hold after a power cut in the middle of recorded file calls.
#pragma once

#include <map>

#include "tests/crash/victim_runs.h"

namespace semfield::testing_crash {

/// Files by path relative to the root, with their bytes.
using DiskState = std::map<std::string, std::string>;
DiskState read_disk(const std::string& root);
/// Makes `root` hold exactly this.
void write_disk(const DiskState& state, const std::string& root);

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

  /// Calls body(state, calls done) for every different state after every number of calls, 0 to all. Returns how many.
  int each_state(const std::function<void(const DiskState&, std::size_t)>& body) const;

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

}  // namespace semfield::testing_crash
