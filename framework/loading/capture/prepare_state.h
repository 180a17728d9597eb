// Which steps of a prepared scene are done: a file in its folder, by which a killed run goes on.
#pragma once

#include <string>
#include <vector>

#include "system/folder_lock.h"

namespace semfield {

class PrepareState {
 public:
  /// Reads `file` where it is there. `identity` is a text of all that steps depend on. Throws Error(cannot_create) for
  /// a file of another identity, whose steps would be mixed with ours.
  PrepareState(std::string file, std::string identity);

  /// What mark() was given for the step; null where it is not done. Valid until the next mark().
  const std::string* done(const std::string& step) const;
  /// The lines of that; none where the step is not done.
  std::vector<std::string> lines(const std::string& step) const;
  /// The step is done, with what it found as lines of text.
  void mark(const std::string& step, const std::string& found = {});
  /// The step is to be done again.
  void forget(const std::string& step);

 private:
  void write() const;
  std::string file_, identity_;
  std::vector<std::pair<std::string, std::string>> steps_;
};

/// The folder of a scene that is being prepared: scene/prepare/ with its steps, logs and work. Held for as long as this
/// lives.
class PrepareFolder {
 public:
  /// `scene` is created, or is one that this began. Throws Error(cannot_create) for a folder of others, and where
  /// another process prepares it.
  explicit PrepareFolder(const std::string& scene);
  /// `steps` of all that depends on `identity`; PrepareState says when it throws.
  PrepareState steps(const std::string& identity) const { return {prepare_ + "/steps.json", identity}; }
  std::string work() const { return prepare_ + "/work"; }
  std::string logs() const { return prepare_ + "/log"; }

 private:
  std::string prepare_;
  FolderLock lock_;
};

}  // namespace semfield
