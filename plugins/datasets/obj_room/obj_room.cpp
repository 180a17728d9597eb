// Dataset 'obj_room': parameters, camera split, lights and bounds; the pictures come from scene/mesh_render.
#include "obj_room.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <numbers>

#include "datasets/obj_room/class_rules.h"
#include "datasets/obj_room/mesh_pieces.h"
#include "plugin/module.h"
#include "system/sorted_folder.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;

using std::numbers::pi;

constexpr double kPieceGap = 0.03;  // metres

std::string resolved(const std::string& folder, const std::string& path) {
  const fs::path p(path);
  return p.is_absolute() || folder.empty() ? p.string() : (fs::path(folder) / p).lexically_normal().string();
}

Vec3d up_of(UpAxis up) { return up == UpAxis::y ? Vec3d{0, 1, 0} : Vec3d{0, 0, 1}; }

}  // namespace

void describe(ParamVisitor& visit, ObjRoomParams& p) {
  SEMFIELD_PARAM(visit, p, root, "folder of the room; relative to the config");
  SEMFIELD_PARAM(visit, p, obj, "OBJ file, relative to root; empty: the only one there");
  SEMFIELD_PARAM(visit, p, classes,
                 "class table and rules, relative to the config; empty: classes.yaml or classes.csv in root");
  SEMFIELD_PARAM(visit, p, cameras, "camera-to-world matrices (3x4 or 4x4), relative to root; empty: a generated path");
  SEMFIELD_PARAM(visit, p, camera_axes, "where x, y, z of a camera of that file point");
  SEMFIELD_PARAM(visit, p, up, "axis of the mesh that points up");
  SEMFIELD_PARAM(visit, p, instances,
                 "objects: those of the file; pieces: what is of one class and touches within 3 cm, for files whose "
                 "objects are materials");
  SEMFIELD_PARAM(visit, p, width_px, "image width in pixels", {1, 8192});
  SEMFIELD_PARAM(visit, p, height_px, "image height in pixels", {1, 8192});
  SEMFIELD_PARAM(visit, p, hfov_deg, "horizontal field of view in degrees", {5, 150});
  SEMFIELD_PARAM(visit, p, frames, "training frames", {1, 100000});
  SEMFIELD_PARAM(visit, p, test_frames, "held-out frames, spread evenly between the training frames", {0, 100000});
  SEMFIELD_PARAM(visit, p, seed, "seed of path, light samples and colours of objects without material", {0, 9e15});
  SEMFIELD_PARAM(visit, p, supersample, "the square of this many colour samples per pixel", {1, 8});
  SEMFIELD_PARAM(visit, p, occlusion_rays, "ambient occlusion rays per pixel, shared with its neighbours", {0, 1024});
  SEMFIELD_PARAM(visit, p, shadow_rays, "shadow rays per pixel and light, shared with its neighbours", {1, 1024});
  SEMFIELD_PARAM(visit, p, exposure, "brightness before the film curve", {0.01, 100});
  SEMFIELD_PARAM(visit, p, daylight, "strength of the light at the largest object of class 'window'; 0 = none",
                 {0, 100});
  SEMFIELD_PARAM(visit, p, clearance_m, "least distance of generated cameras to any surface in metres", {0.01, 10});
  SEMFIELD_PARAM(visit, p, lowest_m, "least height of generated cameras above the floor in metres", {0, 100});
  SEMFIELD_PARAM(visit, p, highest_m, "greatest height of generated cameras above the floor in metres", {0, 100});
  SEMFIELD_PARAM(visit, p, bounds,
                 "inside of the room in metres: [xmin, ymin, zmin, xmax, ymax, zmax]; empty: see room_classes");
  SEMFIELD_PARAM(visit, p, room_classes, "classes whose common box is the room when bounds is empty");
  SEMFIELD_PARAM(visit, p, near_m, "nearest distance along rays in metres; 0 = measured", {0, 1000});
  SEMFIELD_PARAM(visit, p, far_m, "farthest distance along rays in metres; 0 = measured", {0, 10000});
}

void validate(const ObjRoomParams& p, Diagnostics& diagnostics) {
  if (p.highest_m < p.lowest_m) diagnostics.error("config.value.order", "highest_m", "is below lowest_m", "raise it");
  if (p.far_m > 0 && p.far_m <= p.near_m)
    diagnostics.error("config.value.order", "far_m", "is not beyond near_m", "raise it");
  if (!p.bounds.empty()) {
    if (p.bounds.size() != 6) {
      diagnostics.error("config.value.length", "bounds", "has " + std::to_string(p.bounds.size()) + " numbers",
                        "give [xmin, ymin, zmin, xmax, ymax, zmax]");
    } else if (p.bounds[0] >= p.bounds[3] || p.bounds[1] >= p.bounds[4] || p.bounds[2] >= p.bounds[5]) {
      diagnostics.error("config.value.order", "bounds", "has a least corner that is not below the greatest",
                        "give [xmin, ymin, zmin, xmax, ymax, zmax]");
    }
  }
}

std::string recognise(const std::string& path, ObjRoomParams& p) {
  std::error_code unknown;
  std::vector<std::string> found;
  for (fs::directory_iterator it(path, unknown), end; !unknown && it != end; it.increment(unknown)) {
    if (it->path().extension() == ".obj") found.push_back(it->path().filename().string());
  }
  if (found.size() != 1) return "";  // of several, the user says which
  p.root = path;
  return "the room " + found[0];
}

ObjRoom::ObjRoom(const ObjRoomParams& params, const DatasetBuild& build)
    : params_(params), root_(resolved(build.config_dir, params.root)), config_dir_(build.config_dir) {}

std::string ObjRoom::obj_path() const {
  if (!fs::is_directory(root_))
    throw Error(ErrorKind::no_input, "files.folder.missing", "no folder '" + root_ + "'",
                "set scene.root to the room's folder");
  if (!params_.obj.empty()) return resolved(root_, params_.obj);
  std::vector<std::string> found;
  for (const auto& entry : sorted_folder(root_)) {
    if (entry.path().extension() == ".obj") found.push_back(entry.path().filename().string());
  }
  if (found.empty())
    throw Error(ErrorKind::no_input, "scene.obj.missing", "no OBJ file in '" + root_ + "'",
                "put one there or set scene.obj");
  if (found.size() > 1) {
    throw Error(ErrorKind::no_input, "scene.obj.several", "several OBJ files in '" + root_ + "': " + join(found),
                "set scene.obj to one of them");
  }
  return resolved(root_, found[0]);
}

std::string ObjRoom::class_path() const {
  if (!params_.classes.empty()) return resolved(config_dir_, params_.classes);
  for (const char* name : {"classes.yaml", "classes.csv"}) {
    if (fs::is_regular_file(fs::path(root_) / name)) return resolved(root_, name);
  }
  throw Error(ErrorKind::no_input, "labels.classes.none", "no classes.yaml or classes.csv in '" + root_ + "'",
              "write one ({classes: [...], rules: [...]}) or set scene.classes");
}

Box ObjRoom::room_box(const ClassTable& classes, const std::vector<std::int16_t>& class_of) const {
  Box box;
  if (params_.bounds.size() == 6) {
    const std::vector<double>& b = params_.bounds;
    box.include({b[0], b[1], b[2]});
    box.include({b[3], b[4], b[5]});
    return box;
  }
  const TriangleMesh& mesh = renderer_->mesh();
  for (std::size_t i = 0; i < mesh.size(); ++i) {
    if (class_of[i] < 0) continue;
    const std::string& name = classes.valid(class_of[i]).name;
    if (std::find(params_.room_classes.begin(), params_.room_classes.end(), name) == params_.room_classes.end())
      continue;
    for (const std::uint32_t corner : mesh.triangles[i]) {
      const Vec3f p = mesh.positions[corner];
      box.include({p.x, p.y, p.z});
    }
  }
  return box.empty() ? mesh.bounds : box;
}

std::vector<Light> ObjRoom::lights(const Box& room, const ClassTable& classes,
                                   const std::vector<std::int16_t>& class_of) const {
  const Vec3d up = up_of(params_.up), size = room.size(), center = room.center();
  const double height = std::abs(dot(size, up));
  const Vec3d level[2] = {params_.up == UpAxis::y ? Vec3d{1, 0, 0} : Vec3d{1, 0, 0},
                          params_.up == UpAxis::y ? Vec3d{0, 0, 1} : Vec3d{0, 1, 0}};
  const int along = dot(size, level[0]) >= dot(size, level[1]) ? 0 : 1;
  const double longer = dot(size, level[along]), shorter = dot(size, level[1 - along]);
  // Two warm balls under the ceiling; their strength grows with the area that they light.
  const auto strength = static_cast<float>(0.28 * (0.25 * longer * shorter + height));
  std::vector<Light> out;
  for (const double side : {-1.0, 1.0}) {
    Light light;
    light.position = center + up * (0.5 * height - std::min(0.45, 0.2 * height)) +
                     level[along] * (side * 0.26 * longer) + level[1 - along] * (-side * 0.08 * shorter);
    light.radius_m = 0.16;
    light.intensity = {strength, 0.9f * strength, 0.76f * strength};
    out.push_back(light);
  }
  const TriangleMesh& mesh = renderer_->mesh();
  std::vector<Box> boxes(mesh.objects.size());
  for (std::size_t i = 0; i < mesh.size(); ++i) {
    if (class_of[i] < 0 || classes.valid(class_of[i]).name != "window") continue;
    for (const std::uint32_t corner : mesh.triangles[i]) {
      const Vec3f p = mesh.positions[corner];
      boxes[static_cast<std::size_t>(mesh.object_of[i])].include({p.x, p.y, p.z});
    }
  }
  const Box* largest = nullptr;
  double best = 0;
  for (const Box& b : boxes) {
    if (b.empty()) continue;
    const Vec3d s = b.size();
    const double area = s.x * s.y + s.y * s.z + s.z * s.x;
    if (area > best) {
      best = area;
      largest = &b;
    }
  }
  if (largest != nullptr && params_.daylight > 0) {
    Vec3d inward = center - largest->center();
    inward = inward - up * dot(inward, up);
    if (length(inward) > 1e-6) {
      const auto s = static_cast<float>(params_.daylight * 2.2);
      out.push_back({largest->center() + normalized(inward) * 0.35, 0.35, {0.84f * s, 0.94f * s, s}});
    }
  }
  return out;
}

// Near, far and bounds from what a coarse grid of rays of every camera meets; the world beyond the room (through its
// windows) does not count.
void ObjRoom::measure(SceneInfo& info, const Box& room) const {
  constexpr int kColumns = 24, kRows = 18;
  double nearest = 1e300, farthest = 0;
  Box grown = room;
  for (int k = 0; k < 3; ++k) {
    grown.lo[k] -= 1.0;
    grown.hi[k] += 1.0;
  }
  for (const FrameInfo& frame : info.frames) {
    info.bounds.include(frame.world_from_camera.t);
    for (int n = 0; n < kColumns * kRows; ++n) {
      const Vec3d d = frame.camera.direction((n % kColumns + 0.5) * frame.camera.width_px / kColumns,
                                             (n / kColumns + 0.5) * frame.camera.height_px / kRows);
      const Vec3d w = frame.world_from_camera.rotate(d);
      const RayHit hit = renderer_->rays().trace(frame.world_from_camera.t, w);
      if (!hit.hit()) continue;
      const Vec3d p = frame.world_from_camera.t + w * hit.distance_m;
      bool inside = true;
      for (int k = 0; k < 3; ++k) inside = inside && p[k] >= grown.lo[k] && p[k] <= grown.hi[k];
      if (!inside) continue;
      nearest = std::min(nearest, hit.distance_m);
      farthest = std::max(farthest, hit.distance_m);
      info.bounds.include(p);
    }
  }
  for (int k = 0; k < 3; ++k) {  // the grid misses the outermost corners
    info.bounds.lo[k] -= 0.05;
    info.bounds.hi[k] += 0.05;
  }
  info.near_hint_m = params_.near_m > 0 ? params_.near_m : farthest > 0 ? 0.8 * nearest : 0;
  info.far_hint_m = params_.far_m > 0 ? params_.far_m : 1.05 * farthest;
}

SceneInfo ObjRoom::open(Diagnostics& diagnostics) {
  const std::string path = obj_path();
  const ClassRules rules = load_class_rules(class_path());
  TriangleMesh mesh = load_obj(path, diagnostics);
  std::vector<std::int16_t> class_of = classes_of_mesh(mesh, rules, diagnostics);
  if (params_.instances == RoomInstances::pieces) mesh.piece_of = pieces_of(mesh, class_of, kPieceGap);
  RenderSettings settings;
  settings.up = up_of(params_.up);
  settings.occlusion_rays = params_.occlusion_rays;
  settings.shadow_rays = params_.shadow_rays;
  settings.supersample = params_.supersample;
  settings.exposure = static_cast<float>(params_.exposure);
  settings.seed = static_cast<std::uint64_t>(params_.seed);
  renderer_ = std::make_unique<MeshRenderer>(std::move(mesh), class_of, settings, diagnostics);
  const Box room = room_box(rules.table, class_of);
  settings.lights = lights(room, rules.table, class_of);
  renderer_->set_lights(settings.lights);
  cast_ = CastCache(cast_key(renderer_->mesh(), class_of, settings));

  const int total = params_.frames + params_.test_frames;
  std::vector<Pose> poses;
  if (params_.cameras.empty()) {
    PathSettings where;
    where.poses = total;
    where.seed = settings.seed;
    where.up = settings.up;
    where.region = room;
    where.clearance_m = params_.clearance_m;
    where.lowest_m = params_.lowest_m;
    where.highest_m = params_.highest_m;
    poses = make_camera_path(renderer_->rays(), where);
  } else {
    const std::string file = resolved(root_, params_.cameras);
    const std::vector<Pose> all = read_camera_file(file, params_.camera_axes);
    if (static_cast<int>(all.size()) < total) {
      throw Error(ErrorKind::data, "scene.obj.poses",
                  file + ": holds " + std::to_string(all.size()) + " poses, frames + test_frames asks for " +
                      std::to_string(total),
                  "lower scene.frames or scene.test_frames");
    }
    for (int i = 0; i < total; ++i) {
      poses.push_back(
          all[static_cast<std::size_t>(static_cast<std::int64_t>(i) * static_cast<std::int64_t>(all.size()) / total)]);
    }
  }
  Camera camera;
  camera.width_px = params_.width_px;
  camera.height_px = params_.height_px;
  camera.fx = camera.fy = 0.5 * params_.width_px / std::tan(0.5 * params_.hfov_deg * pi / 180);
  camera.cx = 0.5 * params_.width_px;
  camera.cy = 0.5 * params_.height_px;

  SceneInfo info;
  info.name = fs::path(path).stem().string();
  info.classes = rules.table;
  for (int i = 0; i < total; ++i) {
    char name[24];
    std::snprintf(name, sizeof name, "%04d", i);
    FrameInfo frame;
    frame.name = name;
    frame.source = path + " (pose " + std::to_string(i) + ")";
    frame.camera = camera;
    frame.world_from_camera = poses[static_cast<std::size_t>(i)];
    // Test frames are spread evenly: frame i is one where i * test / total passes a whole number.
    const std::int64_t t = params_.test_frames;
    frame.split = (i + 1) * t / total > i * t / total ? Split::test : Split::train;
    frame.has_depth = frame.has_labels = frame.has_instances = true;
    info.frames.push_back(std::move(frame));
  }
  measure(info, room);
  info_ = info;
  return info;
}

void ObjRoom::read(int frame, FrameBuffer& out) const {
  if (frame < 0 || frame >= static_cast<int>(info_.frames.size())) {
    throw Error(ErrorKind::internal, "internal.frame.range",
                "frame " + std::to_string(frame) + " of " + std::to_string(info_.frames.size()) + " was asked for");
  }
  const FrameInfo& f = info_.frames[static_cast<std::size_t>(frame)];
  const auto number = static_cast<std::uint64_t>(frame);
  if (cast_.read(number, f, out)) return;
  renderer_->render(f.camera, f.world_from_camera, number, out);
  cast_.write(number, f, info_.classes, out);
}

namespace {
void register_into(Registry& registry) {
  registry.add_dataset<ObjRoom, ObjRoomParams>("obj_room",
                                               "An OBJ + MTL room, ray-cast along a generated or given camera path.");
}
}  // namespace

SEMFIELD_PLUGIN_MODULE(obj_room, "1.0", register_into)

}  // namespace semfield
