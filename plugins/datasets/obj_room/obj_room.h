// Dataset 'obj_room': an OBJ + MTL room, rendered on demand along a camera path.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "config/params.h"
#include "core/small_math.h"
#include "datasets/obj_room/mesh_io.h"
#include "datasets/obj_room/mesh_render.h"
#include "plugin/dataset.h"
#include "scene/camera.h"
#include "scene/classes/class_table.h"

namespace semfield {

struct PathSettings {
  int poses = 0;
  std::uint64_t seed = 0;
  Vec3d up{0, 0, 1};          ///< one of the world's axes
  Box region;                 ///< camera centres stay in it, world units
  double clearance_m = 0.35;  ///< no surface is nearer to a camera centre
  double lowest_m = 0.9;      ///< height above the floor of the region
  double highest_m = 1.9;
};

/// Seeded 6-DOF path, roll locked. Key positions are free, see surfaces in nearly every direction (so they lie inside
/// the room) and can see each other along free segments; key directions turn by the golden angle towards surfaces;
/// poses between the keys lie on a Catmull-Rom spline, or on the straight segment where the spline would come too near
/// to a surface. Throws Error(data) when the region has no free space.
std::vector<Pose> make_camera_path(const Raycaster& rays, const PathSettings& settings);

enum class UpAxis : std::uint8_t { y, z };

SEMFIELD_CHOICES(UpAxis, "y", "z");
SEMFIELD_CHOICES(CameraAxes, "right_down_forward", "right_up_backward", "left_up_forward");

/// What an instance of a room is: an object of the file, or what is of one class and touches.
enum class RoomInstances : std::uint8_t { objects, pieces };
SEMFIELD_CHOICES(RoomInstances, "objects", "pieces");

struct ObjRoomParams {
  std::string root = "room";
  std::string obj;
  std::string classes;
  std::string cameras;
  CameraAxes camera_axes = CameraAxes::right_down_forward;
  UpAxis up = UpAxis::z;
  RoomInstances instances = RoomInstances::objects;
  int width_px = 160;
  int height_px = 120;
  double hfov_deg = 90;
  int frames = 90;
  int test_frames = 30;
  std::int64_t seed = 1;
  int supersample = 2;
  int occlusion_rays = 8;
  int shadow_rays = 2;
  double exposure = 1.4;
  double daylight = 0.6;
  double clearance_m = 0.35;
  double lowest_m = 0.9;
  double highest_m = 1.9;
  std::vector<double> bounds;
  std::vector<std::string> room_classes{"wall", "ceiling"};
  double near_m = 0;
  double far_m = 0;
};

void describe(ParamVisitor& visit, ObjRoomParams& p);
void validate(const ObjRoomParams& p, Diagnostics& diagnostics);
std::string recognise(const std::string& path, ObjRoomParams& params);

class ObjRoom final : public Dataset {
 public:
  ObjRoom(const ObjRoomParams& params, const DatasetBuild& build);
  SceneInfo open(Diagnostics& diagnostics) override;
  void read(int frame, FrameBuffer& out) const override;

 private:
  std::string obj_path() const;
  std::string class_path() const;
  Box room_box(const ClassTable& classes, const std::vector<std::int16_t>& class_of) const;
  std::vector<Light> lights(const Box& room, const ClassTable& classes,
                            const std::vector<std::int16_t>& class_of) const;
  void measure(SceneInfo& info, const Box& room) const;

  ObjRoomParams params_;
  std::string root_;
  std::string config_dir_;
  std::unique_ptr<MeshRenderer> renderer_;
  CastCache cast_;
  SceneInfo info_;
};

// From the names in a mesh file to classes.

/// Every pattern given must match; '*' stands for any text, '?' for one character. Earlier rules win.
struct ClassRule {
  std::string object, group, material;  ///< "" = not asked
  std::int32_t id = 0;
};

struct ClassRules {
  ClassTable table;
  std::vector<ClassRule> rules;
};

/// Reads classes.yaml or classes.csv as ClassTable::load does, or a YAML map
///   classes: [{id, name, color, ignore}, ...]
///   rules: [{object: "chair_*", class: chair}, {material: Glass, class: window}, ...]
/// Errors name file, line and column; all of a file are reported together.
ClassRules load_class_rules(const std::string& path);

/// Internal class index of each triangle. Without a matching rule the object's name decides: the part before "__", or
/// the name without trailing "_12", ".003" and the like, has to be a class name. Every object that has no class gets
/// its own error in one pass (its triangles become void).
std::vector<std::int16_t> classes_of_mesh(const TriangleMesh& mesh, const ClassRules& rules, Diagnostics& diagnostics);

bool matches_glob(const std::string& text, const std::string& pattern);

}  // namespace semfield
