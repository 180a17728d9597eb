// A surface as one HTML file that any browser opens without a network: the mesh, its classes and a viewer.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "objects/object_set.h"
#include "scene/classes/class_table.h"
#include "session/session.h"
#include "surface/mesh/surface.h"

namespace semfield::app {

/// What the page says and shows beside the surface.
struct ScenePage {
  std::string title;
  std::vector<std::string> about;  ///< lines on where the scene comes from
  std::string run;                 ///< name of its folder
  std::int64_t step = 0;
  bool metric = true;        ///< distances are metres; else units of the input
  Vec3d up{0, 1, 0};         ///< unit vector of the world that is upright
  std::optional<Vec3d> eye;  ///< a place inside, world units; none: the scene is seen from outside alone
  Box bounds;                ///< of the scene, for a run without a surface
  int logits = 0;            ///< classes that entropy is over
  std::optional<ObjectSet> objects;
};

/// A room is looked at from where its cameras stood too; the middle of those around an object lies in the object.
/// Objects are those of RUN/objects, with their edits, where they were found.
ScenePage scene_page_of(const Session& session, const std::string& run_dir, std::int64_t step, Vec3d up);

/// A page that stands alone. Positions are rounded to 65,535 steps along each side of the surface's box, and stay in
/// the input's world. surface.attributes.color holds colours as rendered; class colours are the table's. Throws
/// Error(no_input) where the viewer's files, which come with the program, are missing.
std::string scene_page_text(const Surface& surface, const ClassTable& classes, const ScenePage& page);
/// Writes it whole, with the date. Throws Error(io) too.
void write_scene_page(const std::string& path, const Surface& surface, const ClassTable& classes,
                      const ScenePage& page);

/// The page of a program that answers it: it asks for scenes itself. `runs`: their names.
std::string live_page_text(const std::string& title, const std::vector<std::string>& runs);
/// A scene for that page: the length of its facts in 4 bytes, the facts as JSON, the mesh. `more`: keys of the facts
/// beside them, a JSON object.
std::string scene_bytes(const Surface& surface, const ClassTable& classes, const ScenePage& page,
                        const std::string& more);
/// Rows of the objects as the page reads them, a JSON list.
std::string page_objects_json(const ObjectSet& objects, const ClassTable& classes);
/// The object of each vertex, 16 bits each.
std::vector<std::uint16_t> vertex_objects(const Surface& surface, const ObjectSet& objects);

}  // namespace semfield::app
