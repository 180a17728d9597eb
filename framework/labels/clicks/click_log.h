// clicks.jsonl: the label events of a run, a line each, on the disk before anybody is told that they are taken.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "core/error.h"
#include "core/files.h"
#include "labels/mask_outlines.h"

namespace semfield {

enum class LabelEventKind : std::uint8_t { click, add_class, change_class, undo, skip, merge_class, delete_class };

struct LabelEvent {
  std::string id;  ///< the client's, unique: 1 to 64 of [A-Za-z0-9_-]
  LabelEventKind kind = LabelEventKind::click;
  std::int64_t unix_ms = 0;                  ///< when it was taken; 0: not told
  std::string frame;                         ///< click, skip: FrameInfo::name
  std::int32_t width_px = 0, height_px = 0;  ///< click, skip: size of the image whose pixels `points` count
  std::vector<PixelPoint> points;            ///< click: one, or the polyline of a stroke; skip: one
  double radius_px = 0;                      ///< click: 0 = the pixels that the points or the stroke lie in, alone
  bool fill = false;                         ///< click: `points` are a closed outline, and its inside is named
  std::int32_t object = 0;                   ///< click: which thing of its class; 0: not told
  std::string class_name;                    ///< click: what was named, a void name: nothing; else the class meant
  std::string new_name;                      ///< change_class: the new name, or the old one where the colour alone
                                             ///< changes; merge_class: whose clicks those of `class_name` become
  std::optional<std::array<std::uint8_t, 3>>
      color;       ///< add_class (none: the default of its id), change_class (none: unchanged)
  std::string of;  ///< undo: id of the event undone; undoing an undo brings the event back
  bool operator==(const LabelEvent&) const = default;
};

inline constexpr std::size_t kMostEventBytes = std::size_t{256} << 10;  ///< of an event as text
inline constexpr std::size_t kMostEventPoints = 4096;
inline constexpr std::int64_t kMostEventSide = 65536;  ///< pixels an axis
inline constexpr double kMostEventRadius = 1e6;
inline constexpr std::int32_t kMostObjectNumber = 65535;
inline constexpr std::size_t kMostClassNameBytes = 128;
inline constexpr std::size_t kMostFrameNameBytes = 4096;

inline constexpr std::size_t kLeastOutlinePoints = 3;

/// Whether `text` may be the id of an event.
bool is_event_id(std::string_view text);

/// Throws Error(data) with a sentence that names the key, for every value out of its bounds and for keys that are
/// missing, unknown or given twice.
LabelEvent parse_label_event(std::string_view json);

/// One line without its end; parse_label_event gives the same event again.
std::string label_event_json(const LabelEvent& event);

/// How many events there are, and a CRC-32C of their lines: tells whether two lists begin with the same events.
struct EventsKnown {
  std::int64_t events = 0;
  std::uint32_t checksum = 0;
  void add(const LabelEvent& event);
  bool operator==(const EventsKnown&) const = default;
};

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

  const std::string& path() const { return path_; }
  /// Those of the file, then those appended.
  const std::vector<LabelEvent>& events() const { return events_; }
  /// Returns when the event outlives a power cut. Where it throws (write_error, or Error(io) for a full log) the file
  /// is as it was, and a later call may succeed. A file that another program changed or removed is refused with
  /// Error(io); what that program wrote is not touched.
  void append(const LabelEvent& event);

 private:
  ClickLog(std::string path, FolderLock lock, FileDescriptor file)
      : path_(std::move(path)), lock_(std::move(lock)), file_(std::move(file)) {}
  void require_own(std::string_view mine) const;
  void take_back(std::string_view line) noexcept;
  std::string path_;
  FolderLock lock_;
  FileDescriptor file_;
  std::uint64_t size_ = 0;
  std::string torn_;  // the line whose append failed, where taking it back failed too
  std::vector<LabelEvent> events_;
};

}  // namespace semfield
