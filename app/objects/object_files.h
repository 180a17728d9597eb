// What `semfield objects` writes: the table as JSON, CSV and labelled points, images of ids and COCO's panoptic form,
// and the folder of them while people edit it.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "app/app_context.h"
#include "core/files.h"
#include "scene/scene.h"
#include "surface/objects/find_objects.h"
#include "surface/objects/object_set.h"

namespace semfield::app {

// The table of objects as files. Edits that a person made are in them.

/// Names objects and their edits: the same have the same, others another.
std::string objects_state(const ObjectEdits& edits);

/// Writes objects.json, the table with the keys of set.about, the number of edits and objects_state beside it, then
/// objects.csv and objects.ply (points of the surface, label = id, in colours of the objects), into `folder`. Every
/// file appears whole; objects.json is first, so that where it has another state than the edits, any may be old. Throws
/// as write_file_atomic; Error(data) for more than 1,024 objects.
void write_object_tables(const std::string& folder, const EditedObjects& objects, const SceneInfo& info);

/// The objects in RUN/objects with their edits; none where none were found. `classes`: valid ones of the run's table.
/// Throws as read_edited_objects.
std::optional<ObjectSet> objects_of_run(const std::string& run_dir, int classes);

/// Throws Error(data) for more objects than files hold, before anything is written.
void check_object_count(const std::vector<ObjectRow>& rows);

/// "chair", or "object" where the class is not known.
std::string object_class_name(const ObjectRow& row, const ClassTable& classes);
/// "chair 3", or what a person called it.
std::string object_name(const ObjectRow& row, const ClassTable& classes);

/// A row of the table as a JSON object, as objects.json has it.
std::string object_row_json(const ObjectRow& row, const ClassTable& classes);

// Objects in rendered views as files.

/// A rendered view: ids and, with semantics, the field's classes, [H * W] each.
struct ObjectView {
  const FrameInfo& frame;
  std::span<const std::int32_t> id;
  std::span<const std::int16_t> label;
};

/// Writes into `folder`, which it makes:
///   instance/FRAME.png   16 bits, the ids of the table, 0: no object
///   panoptic/FRAME.png   COCO's panoptic form: R + 256 G + 65536 B, with panoptic.json beside the folder; ids of
///                        stuff lie behind those of the objects
/// Every file appears whole. Throws as write_file_atomic.
class ObjectFiles {
 public:
  /// Borrows all three.
  ObjectFiles(std::string folder, const FoundObjects& found, const SceneInfo& info);
  void add(const ObjectView& view);
  void finish() { write_file_atomic(path("panoptic.json"), panoptic_json()); }

 private:
  std::string path(const std::string& name) const { return (std::filesystem::path(folder_) / name).string(); }
  std::int32_t panoptic_id(std::int32_t object, std::int16_t label) const;
  std::string panoptic_json() const;

  std::string folder_;
  const FoundObjects& found_;
  const SceneInfo& info_;
  Json images_ = Json::array(), annotations_ = Json::array();
};

// The folder of a run's objects while people edit them: one program changes it at a time, and nobody changes what he
// has not seen.

/// Alone with the folder, which is there, until the hold ends. Waits so long for another program. Throws
/// Error(cannot_create) that names it, and write_error.
FolderLock hold_objects(const std::string& folder, double wait_s);

/// For one thread at a time.
class ObjectFolder {
 public:
  /// Borrows `info`.
  ObjectFolder(std::string folder, const SceneInfo& info) : folder_(std::move(folder)), info_(info) {}

  /// The objects as they are on the disk now; null where none were found. Throws as read_edited_objects.
  const EditedObjects* look();
  /// objects_state of the last look; "": none were found.
  std::string state() const { return read_ ? objects_state(read_->edits) : std::string(); }
  /// Edits the objects that have this state, or takes the last edit back, and writes tables and edits.json. Throws
  /// Error(data) for an edit that cannot be, and where the objects have another state by now; as hold_objects; as
  /// write_object_tables. Then edits.json is as it was.
  const EditedObjects& edit(const std::optional<ObjectEdit>& edit, const std::string& state);
  /// Writes the tables anew where they are of another state, as a program leaves them that was killed between tables
  /// and edits. Throws as edit.
  void mend();

 private:
  std::string file(const char* name) const { return (std::filesystem::path(folder_) / name).string(); }
  void write(EditedObjects next);

  std::string folder_;
  const SceneInfo& info_;
  std::optional<EditedObjects> read_;
  std::string stamp_;  // of the files that were read
};

}  // namespace semfield::app
