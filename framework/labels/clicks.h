// Label events: their text, the file that keeps them, and what they add up to: classes, clicks and painted labels.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/error.h"
#include "core/files.h"
#include "labels/mask_outlines.h"
#include "scene/scene.h"

namespace semfield {

// clicks.jsonl: the label events of a run, one per line. An event is on the disk before it is confirmed.

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

// What label events add up to.

/// The events of a log, applied in order. Undoing takes an event out of the sum and undoing the undo puts it back in
/// its old place, so the result does not depend on the way to it.
class Annotations {
 public:
  /// `room`: most classes there can be; the scene's own come first, and there are never fewer. A scene without a class
  /// table gets {0, "void", ignored}. An added class gets the next free id above those of the scene's classes. Throws
  /// Error(data) for more room than a class table has.
  Annotations(const SceneInfo& scene, int room);

  /// False: an event of this id was applied before. Throws Error(data) naming what is wrong: an unknown frame or one
  /// that does not train, a point outside, an image of another shape, an unknown class, a name that is taken, no room,
  /// an undo of nothing, of an undone event or of a class that clicks use, a merge of the scene's own class, ...
  bool check(const LabelEvent& event) const;
  /// The same; then the event counts. Nothing has changed where it throws.
  bool apply(const LabelEvent& event);

  struct Mark {
    std::string id;                  ///< of its event
    int frame = 0;                   ///< in SceneInfo::frames
    std::vector<PixelPoint> points;  ///< pixels of the loaded frame
    double radius_px = 0;
    int class_index = kVoid;  ///< after merges; kVoid: ignore (a void class was named); of skips always
    bool fill = false;        ///< the points are a closed outline
    std::int32_t object = 0;  ///< LabelEvent::object
  };
  const std::vector<Mark>& marks() const { return marks_; }  ///< clicks in force, in the order of their events
  const std::vector<Mark>& skips() const { return skips_; }

  /// As many valid classes as there is room for: the scene's, the added ones, then "unnamed ID". A class keeps index
  /// and id; one that is undone, merged or deleted is called "unnamed ID" and keeps its place until every place has
  /// been given a name: then the next added class takes it, and the other cannot come back while that is there.
  const ClassTable& classes() const { return classes_; }
  /// Places that were ever given a name: the classes [0, named_classes()); is_named() is false for those that are
  /// undone, merged or deleted.
  int named_classes() const { return static_cast<int>(named_.size()); }
  bool is_named(int class_index) const {
    return class_index >= 0 && class_index < named_classes() && named_[static_cast<std::size_t>(class_index)];
  }
  /// Whether one more class can be added.
  bool has_room() const { return free_place() >= 0; }
  /// The first of these are the scene's own, whose names no event changes.
  int own_classes() const { return own_classes_; }
  /// The table without the unnamed classes.
  ClassTable named_table() const;

  /// Indices of frames with clicks, ascending.
  std::vector<int> frames_with_marks() const;
  /// Labels [height * width] of a frame: `base` (empty: void) with the frame's clicks painted over it, in order.
  std::vector<std::int16_t> paint(int frame, std::span<const std::int16_t> base) const;
  /// Takes labels [height * width] of an image of a frame, of any size, away where its clicks say to ignore it; false:
  /// they say so nowhere.
  bool clear_ignored(int frame, std::int32_t width_px, std::int32_t height_px, std::span<std::int16_t> labels) const;
  bool seen(const std::string& id) const { return record_of_.contains(id); }
  /// The events applied.
  const EventsKnown& known() const { return known_; }

  /// What `events` add up to; event i stood in line i + 1 of `name`, which errors name. Where `room` is 0 there is room
  /// for all classes that they add, one place each; else for `room`, and for more only where events need more.
  friend Annotations replay(const SceneInfo& scene, int room, const std::vector<LabelEvent>& events,
                            const std::string& name);

 private:
  struct Record {
    LabelEvent event;
    bool in_force = true;
    int class_index = kVoid;             // of all kinds but undo and skip
    int class_record = -1;               // the record that added the class; -1: it is the scene's own, or void
    int into = kVoid, into_record = -1;  // the same of the other class: merge_class
    int of = -1;                         // undo: the record undone
  };
  struct Naming {
    std::string name;
    std::optional<std::array<std::uint8_t, 3>> color;
    int record = -1;  // that added the class; -1: the scene's own
  };
  struct FrameShape {
    std::string name;
    Camera camera;
    Split split = Split::train;
  };

  Record resolve(const LabelEvent& event) const;
  void resolve_place(const LabelEvent& event) const;
  int resolve_class(const LabelEvent& event, const std::string& name) const;
  // A class that an event may rename, merge or delete: an added one.
  int resolve_added_class(const LabelEvent& event, const char* remedy) const;
  // The record that added a class which is there now; -1: none, it is the scene's own, or void.
  int record_of_class(int class_index) const {
    return class_index < 0 ? -1 : named_[static_cast<std::size_t>(class_index)]->record;
  }
  int free_place() const;
  bool has_its_class(const Record& record) const {
    return record.class_record < 0 || records_[static_cast<std::size_t>(record.class_record)].in_force;
  }
  void require_free_name(const LabelEvent& event, const std::string& name, const char* remedy) const;
  // An undo turns its target round, and an undo that is turned round turns its own target, until an event that is none.
  struct Turned {
    std::vector<int> records;
    bool in_force = false;  // the last one's new state
  };
  Turned turned_by(int of) const;
  void check_undo(const LabelEvent& event) const;
  void check_class_undo(const LabelEvent& event, const Turned& turned) const;
  // apply() without listing the marks anew.
  bool enter(const LabelEvent& event);
  // Of each record that is a click: its class after later merges, nothing where that was deleted.
  std::vector<std::optional<int>> classes_now() const;
  // The last merge or deletion in force that concerns the class which a record added; null: none.
  const Record* end_of_class(int added) const;
  std::vector<std::optional<Naming>> namings(int turned = -1) const;
  void paint_marks(int frame, LabelRaster& raster) const;
  void list_marks();
  void list_classes();

  std::vector<FrameShape> frames_;
  std::map<std::string, int> frame_of_;
  std::vector<ClassEntry> own_;    // the scene's entries, or the void one
  std::vector<std::int32_t> ids_;  // of all classes there is room for
  int own_classes_ = 0;
  std::vector<Record> records_;
  std::map<std::string, int> record_of_;
  std::vector<std::optional<Naming>> named_;  // of the places taken; nullopt: its event is undone
  std::vector<Mark> marks_, skips_;
  ClassTable classes_;
  EventsKnown known_;
};

/// Pixels of a frame of this size that the mark paints: those inside a filled outline (its line alone where it holds
/// no pixel's centre), or those of stroke_runs.
std::vector<PixelRun> runs_of(const Annotations::Mark& mark, std::int32_t width_px, std::int32_t height_px);

Annotations replay(const SceneInfo& scene, int room, const std::vector<LabelEvent>& events, const std::string& name);

}  // namespace semfield
