// Objects as files keep them: points of the surface, which object each is of, and a row per object; and their edits.
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "surface/objects/find_objects.h"

namespace semfield {

/// Files hold as many, like classes of a PLY file.
inline constexpr std::int32_t kMostObjects = 1024;

/// What was found, without what found it. Points are those of SurfacePool, one per cell.
struct ObjectSet {
  SurfaceCells cells;
  std::vector<Vec3d> position;                     ///< [points] world
  std::vector<std::array<std::uint8_t, 3>> color;  ///< [points] of the photographs
  std::vector<std::int32_t> id;                    ///< [points] object, 0: none
  std::vector<std::int16_t> class_of;              ///< [points] class index, kVoid: not known
  std::vector<ObjectRow> rows;                     ///< by id from 1 on; one that was merged away has no points
  std::optional<Vec3d> up;                         ///< FoundObjects::up
  std::string about;                               ///< JSON object: how they were found

  /// The object of the surface at a place of the world, 0: none. A place off all points takes the one of those within
  /// kReach cells.
  std::int32_t at(Vec3d place) const;
  std::vector<std::int32_t> at(std::span<const Vec3d> places) const;
  static constexpr double kReach = 4;
  /// Tells one result of `semfield objects` from another: 16 hexadecimal digits of the ids that were found.
  std::string digest() const;
};

ObjectSet object_set(const FoundObjects& found, std::string about);

/// found.safetensors of a folder that `semfield objects` wrote: what was found, before edits. Throws as
/// write_safetensors.
void write_object_set(const std::string& path, const ObjectSet& set);
/// `classes`: valid ones of the run's table. Throws Error(no_input) as TensorFile::read; Error(data) naming the file
/// and the number for anything that is none, or that a run with these classes cannot have.
ObjectSet read_object_set(const std::string& path, int classes);

// Classes of points and of objects by votes, and what a table says of an object.

/// Class probabilities of points [N, classes]; a row of zeros: not known.
struct PointClasses {
  int classes = 0;
  std::vector<float> probability;

  std::vector<std::int16_t> most_probable() const;  ///< [N], kVoid: not known
};

/// By the field's logits where the run has semantics, else by the classes of the segments that the points lie in.
PointClasses classes_of_points(Session& session, std::span<const Vec3d> positions,
                               std::span<const SegmentSights> sights);

/// Points, area, centroid and box of every row, from points at `position` [N] with ids of rows, or 0. Boxes stand
/// upright on the rectangle of least area, along the points' principal axes where `up` is not known. A row without
/// points gets a box without size.
void measure_objects(std::span<ObjectRow> rows, std::span<const Vec3d> position, std::span<const std::int32_t> id,
                     double cell_m, const std::optional<Vec3d>& up);

/// A row per object of `id` [N], by id. Its class has the most votes: those of its points, and as many of the segments
/// that it lies in, as far as these have classes. No object is of a class of `stuff` [classes], however many votes it
/// has; where all votes are for such, its class is not known.
std::vector<ObjectRow> object_table(const ObjectSurface& surface, std::span<const std::int32_t> id,
                                    std::span<const SegmentSights> sights, const PointClasses& classes,
                                    const std::vector<bool>& stuff, const std::optional<Vec3d>& up);

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
/// What edits.json holds. The same objects with the same edits have the same text, others another.
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
