// Objects in rendered views as files: images of ids and COCO's panoptic form.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "objects/find_objects.h"
#include "objects/object_edits.h"
#include "scene/scene.h"
#include "system/files.h"

namespace semfield::app {

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
  /// pictures/FRAME.png in `folder`, whose folder it makes.
  std::string picture_path(const FrameInfo& frame) const;
  void finish();

 private:
  std::string path(const std::string& name) const;
  std::int32_t panoptic_id(std::int32_t object, std::int16_t label) const;
  std::string panoptic_json() const;

  std::string folder_;
  const FoundObjects& found_;
  const SceneInfo& info_;
  std::vector<std::string> images_, annotations_;  // JSON texts
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
  std::string state() const;
  /// Edits the objects that have this state, or takes the last edit back, and writes tables and edits.json. Throws
  /// Error(data) for an edit that cannot be, and where the objects have another state by now; as hold_objects; as
  /// write_object_tables. Then edits.json is as it was.
  const EditedObjects& edit(const std::optional<ObjectEdit>& edit, const std::string& state);
  /// Writes the tables anew where they are of another state, as a program leaves them that was killed between tables
  /// and edits. Throws as edit.
  void mend();

 private:
  std::string file(const char* name) const;
  void write(EditedObjects next);

  std::string folder_;
  const SceneInfo& info_;
  std::optional<EditedObjects> read_;
  std::string stamp_;  // of the files that were read
};

}  // namespace semfield::app
