// clicks.jsonl: the label events of a run, a line each, on the disk before anybody is told that they are taken.
#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "core/error.h"
#include "labels/clicks/label_event.h"
#include "system/folder_lock.h"

namespace semfield {

inline constexpr const char* kClickFile = "clicks.jsonl";  ///< a run's own file, in its folder

/// Events of a text of lines; event i stood in line i + 1. A last line without its end is what a kill left of an event
/// that was not acknowledged: it is dropped with a warning. Throws Error(data) naming `name` and the line for any other
/// bad line and for an id that an earlier line has.
std::vector<LabelEvent> parse_click_log(std::string_view text, const std::string& name, Diagnostics& diagnostics);
/// The same of a file, which is not changed. Throws Error(no_input) when it cannot be read.
std::vector<LabelEvent> read_click_log(const std::string& path, Diagnostics& diagnostics);

/// Appends to the file, which no other program may do meanwhile: a lock file beside it keeps those away that ask, and
/// the file's size gives away those that do not.
class ClickLog {
 public:
  /// Locks the file and opens it, or creates it with an entry of its folder that outlives a power cut, and cuts off
  /// what parse_click_log drops. Throws as read_click_log, write_error, and Error(cannot_create) naming the process
  /// that appends to the file.
  static ClickLog open(const std::string& path, Diagnostics& diagnostics);

  ClickLog(ClickLog&& other) noexcept;
  ClickLog& operator=(ClickLog&&) = delete;
  ~ClickLog();

  const std::string& path() const { return path_; }
  /// Those of the file, then those appended.
  const std::vector<LabelEvent>& events() const { return events_; }
  /// Returns when the event outlives a power cut. Where it throws (write_error, or Error(io) for a full log) the file
  /// is as it was, and a later call may succeed. A file that another program changed or removed is refused with
  /// Error(io); what that program wrote is not touched.
  void append(const LabelEvent& event);

 private:
  ClickLog(std::string path, FolderLock lock, int file) : path_(std::move(path)), lock_(std::move(lock)), file_(file) {}
  void require_own(std::string_view mine) const;
  void take_back(std::string_view line) noexcept;
  std::string path_;
  FolderLock lock_;
  int file_ = -1;
  std::uint64_t size_ = 0;
  std::string torn_;  // the line whose append failed, where taking it back failed too
  std::vector<LabelEvent> events_;
};

}  // namespace semfield
