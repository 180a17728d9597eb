// What a person changed about the objects that were found: names, merges and splits, in order.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "objects/object_set.h"

namespace semfield {

/// One change. `objects`: one id, or those that are merged, of which the first stays.
struct ObjectEdit {
  enum class Kind { rename, merge, split };
  Kind kind = Kind::rename;
  std::vector<std::int32_t> objects;
  std::string name;                             ///< of rename; "": the name it had by itself
  std::optional<std::array<Vec3d, 2>> at = {};  ///< of split: a place of each part, world
  std::optional<std::array<Vec3d, 3>> plane =
      {};  ///< of split: three places of the plane between the parts, world; neither: pieces that do not touch
};

/// edits.json beside the table: the edits, and the digest of the objects that they are about.
struct ObjectEdits {
  std::string digest;
  std::vector<ObjectEdit> edits;
};

/// One edit as JSON: {"do": "rename", "object": 3, "name": "red chair"}, {"do": "merge", "objects": [3, 7]},
/// {"do": "split", "object": 5}, the same with "at": [[x, y, z], [x, y, z]], or with "plane" and three places. `where`
/// stands in messages. Throws Error(data).
ObjectEdit parse_object_edit(std::string_view json, const std::string& where);

/// No file: no edits. Throws Error(data) naming the file and the edit.
ObjectEdits read_object_edits(const std::string& path);
void write_object_edits(const std::string& path, const ObjectEdits& edits);
/// What is written. The same objects with the same edits have the same text, others another.
std::string object_edits_text(const ObjectEdits& edits);

/// Changes ids and rows. Ids stay, those of merged objects are not used again, and a part that was split off gets a new
/// one behind all others; the largest part keeps its id. Pieces: parts whose cells touch are one, and what has less
/// than a fiftieth of the object's points stays with the largest part. Places: a point is of the part whose place it is
/// reached from first, from cell to cell of the object. A plane: parts are the points on its two sides. The views of
/// merged objects are those of the one that has most, the views of a part those of the whole; class and size are
/// counted anew. Throws Error(data) for ids that are not there, for places that do not lie on the object, for a plane
/// whose places lie on a line, and for an object that stays one piece.
void apply_edit(ObjectSet& set, const ObjectEdit& edit);

/// All in their order, as one by one; what each needs of the whole surface is made once. Throws Error(data) naming
/// `file` for edits of other objects.
void apply_edits(ObjectSet& set, const ObjectEdits& edits, const std::string& file);

/// The objects of a folder as its edits have made them, and those edits, whose digest is that of the objects found.
/// Throws as read_object_set, read_object_edits and apply_edits.
struct EditedObjects {
  ObjectSet set;
  ObjectEdits edits;
};
EditedObjects read_edited_objects(const std::string& folder, int classes);

}  // namespace semfield
