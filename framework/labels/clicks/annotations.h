// What label events add up to: classes, clicks and the labels that they paint.
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "labels/clicks/click_log.h"
#include "labels/mask_outlines.h"
#include "scene/scene.h"

namespace semfield {

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
