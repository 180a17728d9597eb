// Small OBJ rooms whose geometry is known in closed form, and short ways to read what was reported.
#pragma once

#include <sstream>

#include "datasets/obj_room/obj_room.h"
#include "scene/scene.h"
#include "tests/scene/tiny_scene.h"

namespace semfield::testing_obj {

using testing_room::fresh_folder;
using testing_room::plain_write;
using testing_room::room_camera;

/// Eight corners and six quads of a box, one object a face: x-, x+, y-, y+, z-, z+.
inline void add_box(std::ostringstream& obj, const Box& box, const std::array<const char*, 6>& names, int& vertices) {
  constexpr std::array<std::array<int, 4>, 6> kFaces{
      {{0, 2, 6, 4}, {1, 5, 7, 3}, {0, 4, 5, 1}, {2, 3, 7, 6}, {0, 1, 3, 2}, {4, 6, 7, 5}}};
  for (int corner = 0; corner < 8; ++corner)
    obj << "v " << ((corner & 1) != 0 ? box.hi.x : box.lo.x) << ' ' << ((corner & 2) != 0 ? box.hi.y : box.lo.y) << ' '
        << ((corner & 4) != 0 ? box.hi.z : box.lo.z) << '\n';
  for (std::size_t face = 0; face < 6; ++face) {
    obj << "o " << names[face] << "\nf";
    for (const int corner : kFaces[face]) obj << ' ' << vertices + corner + 1;
    obj << '\n';
  }
  vertices += 8;
}

// Every coordinate is a float32 number: nothing is lost on the way through the file.
inline const Box kRoom{{-2, -1.5, 0}, {2, 1.5, 2.5}};
inline const Box kCrate{{-0.25, 0.5, 0}, {0.25, 1, 0.75}};

inline constexpr const char* kRoomClasses =
    "- {id: 1, name: wall}\n- {id: 2, name: floor}\n- {id: 3, name: ceiling}\n- {id: 4, name: crate}\n";

/// Objects 0..5 are the room's faces (x-, x+, y-, y+, floor, ceiling), 6..11 those of a crate on its floor.
inline std::string room_text() {
  std::ostringstream obj;
  int vertices = 0;
  add_box(obj, kRoom, {"wall_1", "wall_2", "wall_3", "wall_4", "floor_1", "ceiling_1"}, vertices);
  add_box(obj, kCrate, {"crate_1", "crate_2", "crate_3", "crate_4", "crate_5", "crate_6"}, vertices);
  return obj.str();
}

/// Writes that room with its classes, and six cameras on a slide along +x that look along +y.
inline void write_room(const std::string& folder) {
  plain_write(folder + "/room.obj", room_text());
  plain_write(folder + "/classes.yaml", kRoomClasses);
  std::string cameras;
  for (int i = 0; i < 6; ++i) cameras += "1 0 0 " + std::to_string(-0.5 + 0.2 * i) + " 0 0 1 -1 0 -1 0 1.2\n";
  plain_write(folder + "/cameras.txt", cameras);
}

inline void expect_same(const FrameBuffer& a, const FrameBuffer& b) {
  EXPECT_EQ(a.rgb, b.rgb);
  EXPECT_EQ(a.depth_m, b.depth_m);
  EXPECT_EQ(a.label, b.label);
  EXPECT_EQ(a.instance, b.instance);
}

inline TriangleMesh load_text(const std::string& text, Diagnostics& diagnostics) {
  const std::string path = fresh_folder("mesh") + "/mesh.obj";
  plain_write(path, text);
  return load_obj(path, diagnostics);
}

/// A sound one, about which there is nothing to say.
inline TriangleMesh load_text(const std::string& text) {
  Diagnostics diagnostics;
  TriangleMesh mesh = load_text(text, diagnostics);
  EXPECT_EQ(all_said(diagnostics), "");
  return mesh;
}

inline TriangleMesh room_mesh() { return load_text(room_text()); }

/// What a ray meets in that room.
struct Truth {
  double distance = 1e300;
  int object = -1;  ///< as listed at room_text
};
inline Truth room_truth(Vec3d origin, Vec3d direction) {
  Truth truth;
  double t_near = 0, t_far = 0;
  for (int a = 0; a < 3; ++a) {  // from inside: the first of the planes ahead
    if (direction[a] == 0) continue;
    const double t = ((direction[a] > 0 ? kRoom.hi[a] : kRoom.lo[a]) - origin[a]) / direction[a];
    if (t < truth.distance) truth = {t, 2 * a + (direction[a] > 0 ? 1 : 0)};
  }
  if (!intersect(kCrate, origin, direction, t_near, t_far) || t_near <= 0 || t_near >= truth.distance) return truth;
  truth.distance = t_near;
  const Vec3d p = origin + direction * t_near;
  double best = 1e300;
  for (int a = 0; a < 3; ++a) {
    for (int side = 0; side < 2; ++side) {
      const double off = std::abs(p[a] - (side != 0 ? kCrate.hi[a] : kCrate.lo[a]));
      if (off < best) {
        best = off;
        truth.object = 6 + 2 * a + side;
      }
    }
  }
  return truth;
}

/// Classes of kRoomClasses (0 wall, 1 floor, 2 ceiling, 3 crate) by object.
inline std::int16_t class_of_object(int object) {
  return static_cast<std::int16_t>(object < 4 ? 0 : object == 4 ? 1 : object == 5 ? 2 : 3);
}

}  // namespace semfield::testing_obj
