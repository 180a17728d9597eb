// Dataset 'obj_room': an OBJ + MTL room, rendered on demand along a camera path.
#include "datasets/obj_room/obj_room.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <numbers>
#include <tuple>

#include "config/config_tree.h"
#include "core/files.h"
#include "core/rng.h"
#include "plugin/module.h"
#include "scene/camera.h"
#include "scene/loading/frame_files.h"

namespace semfield {

using std::numbers::pi;

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

namespace {

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
  constexpr const char* kBounds = "give [xmin, ymin, zmin, xmax, ymax, zmax]";
  const std::vector<double>& b = p.bounds;
  if (!b.empty() && b.size() != 6)
    diagnostics.error("config.value.length", "bounds", fmt::format("has {} numbers", b.size()), kBounds);
  else if (!b.empty() && (b[0] >= b[3] || b[1] >= b[4] || b[2] >= b[5]))
    diagnostics.error("config.value.order", "bounds", "has a least corner that is not below the greatest", kBounds);
}

// Names of the OBJ files in a folder.
static std::vector<std::string> objs_in(const std::string& folder) {
  constexpr std::string_view kObj[] = {".obj"};
  std::vector<std::string> names;
  for (const std::string& path : files_with(folder, kObj)) names.push_back(fs::path(path).filename().string());
  return names;
}

std::string recognise(const std::string& path, ObjRoomParams& p) {
  const std::vector<std::string> found = objs_in(path);
  if (found.size() != 1) return "";  // of several, the user says which
  p.root = path;
  return "the room " + found[0];
}

class ObjRoom final : public Dataset {
 public:
  ObjRoom(const ObjRoomParams& params, const DatasetBuild& build)
      : params_(params), root_(resolved(build.config_dir, params.root)), config_dir_(build.config_dir) {}

  SceneInfo open(Diagnostics& diagnostics) override {
    const std::string path = obj_path();
    const ClassRules rules = load_class_rules(class_path());
    TriangleMesh mesh = load_obj(path, diagnostics);
    std::vector<std::int16_t> class_of = classes_of_mesh(mesh, rules, diagnostics);
    if (params_.instances == RoomInstances::pieces) mesh.piece_of = pieces_of(mesh, class_of, kPieceGap);
    RenderSettings settings{.lights = {},
                            .up = up_of(params_.up),
                            .occlusion_rays = params_.occlusion_rays,
                            .shadow_rays = params_.shadow_rays,
                            .supersample = params_.supersample,
                            .exposure = static_cast<float>(params_.exposure),
                            .seed = static_cast<std::uint64_t>(params_.seed)};
    renderer_ = std::make_unique<MeshRenderer>(std::move(mesh), class_of, settings, diagnostics);
    const Box room = room_box(rules.table, class_of);
    renderer_->set_lights(lights(room, rules.table, class_of));
    cast_ = CastCache(room_key());

    const int total = params_.frames + params_.test_frames;
    std::vector<Pose> poses;
    if (params_.cameras.empty()) {
      poses = make_camera_path(renderer_->rays(), {total, settings.seed, settings.up, room, params_.clearance_m,
                                                   params_.lowest_m, params_.highest_m});
    } else {
      const std::string file = resolved(root_, params_.cameras);
      const std::vector<Pose> all = read_camera_file(file, params_.camera_axes);
      if (std::ssize(all) < total)
        throw Error(ErrorKind::data, "scene.obj.poses",
                    fmt::format("{}: holds {} poses, frames + test_frames asks for {}", file, all.size(), total),
                    "lower scene.frames or scene.test_frames");
      for (std::int64_t i = 0; i < total; ++i)
        poses.push_back(all[static_cast<std::size_t>(i * std::ssize(all) / total)]);
    }
    const double focal = 0.5 * params_.width_px / std::tan(0.5 * params_.hfov_deg * pi / 180);
    const Camera camera{params_.width_px,       params_.height_px,      focal, focal,
                        0.5 * params_.width_px, 0.5 * params_.height_px};

    SceneInfo info;
    info.name = fs::path(path).stem().string();
    info.classes = rules.table;
    for (int i = 0; i < total; ++i) {
      FrameInfo frame;
      frame.name = fmt::format("{:04}", i);
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

  void read(int frame, FrameBuffer& out) const override {
    if (frame < 0 || frame >= std::ssize(info_.frames))
      throw Error(ErrorKind::internal, "internal.frame.range",
                  fmt::format("frame {} of {} was asked for", frame, info_.frames.size()));
    const FrameInfo& f = info_.frames[static_cast<std::size_t>(frame)];
    const auto number = static_cast<std::uint64_t>(frame);
    if (cast_.read(number, f, out)) return;
    renderer_->render(f.camera, f.world_from_camera, number, out);
    cast_.write(number, f, info_.classes, out);
  }

 private:
  std::string obj_path() const {
    if (!fs::is_directory(root_))
      throw Error(ErrorKind::no_input, "files.folder.missing", "no folder '" + root_ + "'",
                  "set scene.root to the room's folder");
    if (!params_.obj.empty()) return resolved(root_, params_.obj);
    const std::vector<std::string> found = objs_in(root_);
    if (found.empty())
      throw Error(ErrorKind::no_input, "scene.obj.missing", "no OBJ file in '" + root_ + "'",
                  "put one there or set scene.obj");
    if (found.size() > 1)
      throw Error(ErrorKind::no_input, "scene.obj.several", "several OBJ files in '" + root_ + "': " + join(found),
                  "set scene.obj to one of them");
    return resolved(root_, found[0]);
  }

  // The same room under any path has the same pictures.
  std::string room_key() const {
    std::vector<std::string> files = renderer_->mesh().files;
    files.push_back(class_path());
    if (!params_.cameras.empty()) files.push_back(resolved(root_, params_.cameras));
    ObjRoomParams same = params_;
    same.root = same.obj = same.classes = same.cameras = "";
    return cast_key(write_config(params_to_config([&](ParamVisitor& visit) { describe(visit, same); })), files);
  }

  std::string class_path() const {
    if (!params_.classes.empty()) return resolved(config_dir_, params_.classes);
    for (const char* name : {"classes.yaml", "classes.csv"}) {
      if (fs::is_regular_file(fs::path(root_) / name)) return resolved(root_, name);
    }
    throw Error(ErrorKind::no_input, "labels.classes.none", "no classes.yaml or classes.csv in '" + root_ + "'",
                "write one ({classes: [...], rules: [...]}) or set scene.classes");
  }

  Box room_box(const ClassTable& classes, const std::vector<std::int16_t>& class_of) const {
    const std::vector<double>& b = params_.bounds;
    if (b.size() == 6) return {{b[0], b[1], b[2]}, {b[3], b[4], b[5]}};
    Box box;
    for (const Box& one : boxes_of(classes, class_of, params_.room_classes)) {
      if (one.empty()) continue;
      box.include(one.lo);
      box.include(one.hi);
    }
    return box.empty() ? renderer_->mesh().bounds : box;
  }

  // Of each object's triangles of these classes.
  std::vector<Box> boxes_of(const ClassTable& classes, const std::vector<std::int16_t>& class_of,
                            const std::vector<std::string>& names) const {
    const TriangleMesh& mesh = renderer_->mesh();
    std::vector<Box> boxes(mesh.objects.size());
    for (std::size_t i = 0; i < mesh.size(); ++i) {
      if (class_of[i] < 0 || std::ranges::find(names, classes.valid(class_of[i]).name) == names.end()) continue;
      for (const std::size_t k : {0, 1, 2})
        boxes[static_cast<std::size_t>(mesh.object_of[i])].include(mesh.corner(i, k));
    }
    return boxes;
  }

  std::vector<Light> lights(const Box& room, const ClassTable& classes,
                            const std::vector<std::int16_t>& class_of) const {
    const Vec3d up = up_of(params_.up), size = room.size(), center = room.center();
    const double height = std::abs(dot(size, up));
    const Vec3d level[2] = {{1, 0, 0}, params_.up == UpAxis::y ? Vec3d{0, 0, 1} : Vec3d{0, 1, 0}};
    const int along = dot(size, level[0]) >= dot(size, level[1]) ? 0 : 1;
    const double longer = dot(size, level[along]), shorter = dot(size, level[1 - along]);
    // Two warm balls under the ceiling; their strength grows with the area that they light.
    const auto strength = static_cast<float>(0.28 * (0.25 * longer * shorter + height));
    std::vector<Light> out;
    for (const double side : {-1.0, 1.0}) {
      const Vec3d at = center + up * (0.5 * height - std::min(0.45, 0.2 * height)) +
                       level[along] * (side * 0.26 * longer) + level[1 - along] * (-side * 0.08 * shorter);
      out.push_back({at, 0.16, {strength, 0.9f * strength, 0.76f * strength}});
    }
    const std::vector<Box> boxes = boxes_of(classes, class_of, {"window"});
    const auto area = [](const Box& b) {
      const Vec3d s = b.empty() ? Vec3d{} : b.size();
      return s.x * s.y + s.y * s.z + s.z * s.x;
    };
    const auto largest =
        std::max_element(boxes.begin(), boxes.end(), [&](const Box& a, const Box& b) { return area(a) < area(b); });
    if (largest != boxes.end() && area(*largest) > 0 && params_.daylight > 0) {
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
  void measure(SceneInfo& info, const Box& room) const {
    constexpr int kColumns = 24, kRows = 18;
    double nearest = 1e300, farthest = 0;
    const Vec3d around{1, 1, 1}, edge{0.05, 0.05, 0.05};  // the grid misses the outermost corners
    const Box grown{room.lo - around, room.hi + around};
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
    info.bounds = {info.bounds.lo - edge, info.bounds.hi + edge};
    info.near_hint_m = params_.near_m > 0 ? params_.near_m : farthest > 0 ? 0.8 * nearest : 0;
    info.far_hint_m = params_.far_m > 0 ? params_.far_m : 1.05 * farthest;
  }

  ObjRoomParams params_;
  std::string root_;
  std::string config_dir_;
  std::unique_ptr<MeshRenderer> renderer_;
  CastCache cast_;
  SceneInfo info_;
};

SEMFIELD_PLUGIN_MODULE(obj_room, "1.0", [](Registry& registry) {
  registry.add_dataset<ObjRoom, ObjRoomParams>("obj_room",
                                               "An OBJ + MTL room, ray-cast along a generated or given camera path.");
})

// Path generation by rejection in free space.

namespace {

constexpr double kGoldenAngle = 2.399963229728653;
constexpr int kPosesPerKey = 4;
constexpr int kCandidates = 160;
constexpr double kNearestView_m = 0.6;  // a surface nearer than this in the image centre fills the picture

struct Key {
  Vec3d position;
  double yaw = 0, pitch = 0;
};

// Inside a room nearly every direction meets a surface (windows may be open).
bool enclosed(const Raycaster& rays, Vec3d p) {
  constexpr int kDirections = 48;
  int hits = 0;
  for (int i = 0; i < kDirections; ++i) {
    const double z = 1 - (2 * i + 1.0) / kDirections, r = std::sqrt(1 - z * z), phi = kGoldenAngle * i;
    if (rays.blocked(p, {r * std::cos(phi), r * std::sin(phi), z}, 100)) ++hits;
  }
  return hits * 10 >= kDirections * 8;
}

bool segment_free(const Raycaster& rays, Vec3d p, Vec3d q, double clearance_m) {
  const int steps = std::max(2, static_cast<int>(length(q - p) / 0.1));
  for (int i = 0; i <= steps; ++i) {
    const double t = static_cast<double>(i) / steps;
    if (rays.clearance(p + (q - p) * t, clearance_m) < clearance_m) return false;
  }
  return true;
}

std::vector<Vec3d> free_positions(const Raycaster& rays, const PathSettings& s) {
  const RandomAddress address{s.seed, 0, stream_id("camera_path/position")};
  int axis = 0;
  for (int k = 1; k < 3; ++k)
    if (std::abs(s.up[k]) > std::abs(s.up[axis])) axis = k;
  Box box = s.region;
  const bool flipped = s.up[axis] < 0;
  const double floor = flipped ? box.hi[axis] : box.lo[axis];
  const double sign = flipped ? -1 : 1;
  const double height = box.hi[axis] - box.lo[axis];
  const double low = std::min(s.lowest_m, 0.35 * height), high = std::min(s.highest_m, 0.8 * height);
  box.lo[axis] = std::min(floor + sign * low, floor + sign * high);
  box.hi[axis] = std::max(floor + sign * low, floor + sign * high);
  std::vector<Vec3d> out;
  for (std::uint64_t i = 0; i < 4000 && out.size() < kCandidates; ++i) {
    Vec3d p;
    for (int k = 0; k < 3; ++k)
      p[k] = box.lo[k] +
             (box.hi[k] - box.lo[k]) * static_cast<double>(uniform01(address, 3 * i + static_cast<std::uint64_t>(k)));
    if (rays.clearance(p, s.clearance_m) >= s.clearance_m && enclosed(rays, p)) out.push_back(p);
  }
  return out;
}

// The largest set of candidates that reach one another along sight lines: one room, not also the next one.
std::vector<Vec3d> largest_room(const Raycaster& rays, const std::vector<Vec3d>& points) {
  std::vector<int> room(points.size(), -1);
  std::vector<int> sizes;
  for (std::size_t start = 0; start < points.size(); ++start) {
    if (room[start] >= 0) continue;
    const int id = static_cast<int>(sizes.size());
    std::vector<std::size_t> open{start};
    room[start] = id;
    sizes.push_back(0);
    while (!open.empty()) {
      const std::size_t i = open.back();
      open.pop_back();
      ++sizes.back();
      for (std::size_t j = 0; j < points.size(); ++j) {
        if (room[j] >= 0) continue;
        const Vec3d way = points[j] - points[i];
        const double far = length(way);
        if (far > 0 && rays.blocked(points[i], way * (1 / far), far)) continue;
        room[j] = id;
        open.push_back(j);
      }
    }
  }
  const int best = static_cast<int>(std::max_element(sizes.begin(), sizes.end()) - sizes.begin());
  std::vector<Vec3d> out;
  for (std::size_t i = 0; i < points.size(); ++i)
    if (room[i] == best) out.push_back(points[i]);
  return out;
}

double view_distance(const Raycaster& rays, Vec3d p, Vec3d direction) {
  const RayHit hit = rays.trace(p, direction, 100);
  return hit.hit() ? hit.distance_m : 100;
}

std::vector<Key> make_keys(const Raycaster& rays, const PathSettings& s, const std::vector<Vec3d>& points,
                           const LevelAxes& axes) {
  const RandomAddress order{s.seed, 1, stream_id("camera_path/order")};
  const RandomAddress gaze{s.seed, 2, stream_id("camera_path/gaze")};
  const int count = (s.poses + kPosesPerKey - 1) / kPosesPerKey + 1;
  std::vector<Key> keys;
  std::vector<std::size_t> visited{static_cast<std::size_t>(uniform_below(order, 0, points.size()))};
  double yaw = 2 * pi * static_cast<double>(uniform01(gaze, 0));
  for (int k = 0; k < count; ++k) {
    if (k > 0) {
      // Of a few reachable candidates the one farthest from the last places visited.
      std::size_t best = visited.back();
      double best_score = -1;
      for (std::uint64_t n = 0, found = 0; n < 40 && found < 4; ++n) {
        const auto j =
            static_cast<std::size_t>(uniform_below(order, static_cast<std::uint64_t>(k) * 64 + n, points.size()));
        if (j == visited.back() || !segment_free(rays, points[visited.back()], points[j], s.clearance_m)) continue;
        ++found;
        double score = 1e9;
        for (std::size_t v = visited.size() > 12 ? visited.size() - 12 : 0; v < visited.size(); ++v) {
          score = std::min(score, length(points[visited[v]] - points[j]));
        }
        if (score > best_score) {
          best_score = score;
          best = j;
        }
      }
      visited.push_back(best);
      yaw += kGoldenAngle;
    }
    Key key{points[visited.back()], yaw, 0};
    double best_view = -1;
    for (std::uint64_t n = 0; n < 8; ++n) {
      const std::uint64_t index = 1 + static_cast<std::uint64_t>(k) * 16 + 2 * n;
      const double turn = yaw + 0.7 * (static_cast<double>(uniform01(gaze, index)) - 0.5);
      const double tilt = pi / 180 * (-34 + 40 * static_cast<double>(uniform01(gaze, index + 1)));
      const double view = view_distance(rays, key.position, axes.direction(turn, tilt));
      if (view <= best_view) continue;
      best_view = view;
      key.yaw = turn;
      key.pitch = tilt;
      if (view > 2 * kNearestView_m) break;
    }
    if (!keys.empty()) {
      while (key.yaw - keys.back().yaw > pi) key.yaw -= 2 * pi;
      while (key.yaw - keys.back().yaw < -pi) key.yaw += 2 * pi;
    }
    keys.push_back(key);
  }
  return keys;
}

}  // namespace

std::vector<Pose> make_camera_path(const Raycaster& rays, const PathSettings& s) {
  const std::vector<Vec3d> all = free_positions(rays, s);
  const std::vector<Vec3d> points = all.empty() ? all : largest_room(rays, all);
  if (points.size() < 4)
    throw Error(ErrorKind::data, "scene.obj.space",
                fmt::format("no free space for cameras: {} of 4000 positions are free", points.size()),
                "lower scene.clearance_m or set scene.bounds to the inside of the room");
  const LevelAxes axes = level_axes(s.up);
  const std::vector<Key> keys = make_keys(rays, s, points, axes);
  std::vector<Pose> poses;
  for (int i = 0; i < s.poses; ++i) {
    const double at = static_cast<double>(i) * static_cast<double>(keys.size() - 1) / s.poses;
    const auto k = static_cast<std::size_t>(at);
    const double t = at - static_cast<double>(k);
    const Key &b = keys[k], &c = keys[k + 1];
    const Key &a = k > 0 ? keys[k - 1] : b, &d = k + 2 < keys.size() ? keys[k + 2] : c;
    Vec3d p = catmull_rom(a.position, b.position, c.position, d.position, t);
    const Vec3d way = p - b.position;
    const double far = length(way);
    if (rays.clearance(p, s.clearance_m) < s.clearance_m ||
        (far > 0 && rays.blocked(b.position, way * (1 / far), far))) {
      p = b.position + (c.position - b.position) * t;
    }
    // The segment was tried in steps: where it grazes something thin, halfway towards the nearer key, at last the key.
    const double key = t < 0.5 ? 0 : 1;
    for (double step = t, n = 0; rays.clearance(p, s.clearance_m) < s.clearance_m && n < 8; ++n) {
      step = n < 7 ? 0.5 * (step + key) : key;
      p = b.position + (c.position - b.position) * step;
    }
    const double pitch = std::clamp(catmull_rom(a.pitch, b.pitch, c.pitch, d.pitch, t), -0.8, 0.3);
    const double yaw = catmull_rom(a.yaw, b.yaw, c.yaw, d.yaw, t);
    // The nearest turn that does not stare at something close by.
    double turn = 0;
    for (int n = 0; n < 18; ++n) {
      const double tried = (n % 2 == 0 ? 1 : -1) * ((n + 1) / 2) * (pi / 9);
      if (view_distance(rays, p, axes.direction(yaw + tried, pitch)) < kNearestView_m) continue;
      turn = tried;
      break;
    }
    poses.push_back(look_along(p, axes.direction(yaw + turn, pitch), s.up));
  }
  return poses;
}

// Class tables with rules: reading and applying.

namespace {

const ClassEntry* find_class(const ClassTable& table, const std::string& name) {
  const std::vector<ClassEntry>& all = table.entries();
  const auto found = std::find_if(all.begin(), all.end(), [&](const ClassEntry& e) { return e.name == name; });
  return found == all.end() ? nullptr : &*found;
}

void read_rule(const ConfigNode& node, ClassRules& out, Diagnostics& diagnostics) {
  const std::string where = node.location().text();
  if (!node.is_map()) {
    diagnostics.error("classes.rule.format", where, "a rule is a map such as {object: \"chair_*\", class: chair}", {});
    return;
  }
  refuse_unknown_keys(node, "rules: unknown key", {"object", "group", "material", "class"}, diagnostics);
  ClassRule rule;
  for (const auto& [key, pattern] :
       {std::pair{"object", &ClassRule::object}, {"group", &ClassRule::group}, {"material", &ClassRule::material}})
    if (const ConfigNode* value = node.find(key)) rule.*pattern = value->text();
  if (const ConfigNode* value = node.find("class"); value == nullptr) {
    diagnostics.error("classes.rule.format", where, "the rule names no class", "add class: NAME");
  } else if (const ClassEntry* entry = find_class(out.table, value->text())) {
    rule.id = entry->id;
  } else {
    std::vector<std::string> names;
    for (const ClassEntry& e : out.table.entries()) names.push_back(e.name);
    diagnostics.error("labels.class.unknown", value->location().text(), "no class named '" + value->text() + "'",
                      near_name_remedy(value->text(), names));
  }
  if (rule.object.empty() && rule.group.empty() && rule.material.empty())
    diagnostics.error("classes.rule.format", where, "the rule asks for no object, group or material",
                      "add object: \"PATTERN\"");
  out.rules.push_back(rule);
}

// "chair__Mesh037_Wood" -> "chair"; "dining_chair_2" -> "dining_chair"; "Chair.004" -> "Chair".
std::string stem_of(const std::string& name) {
  const auto cut = name.find("__");
  if (cut != std::string::npos) return name.substr(0, cut);
  const auto end = name.find_last_not_of("0123456789");
  if (end == std::string::npos || end + 1 == name.size() || (name[end] != '_' && name[end] != '.')) return name;
  return name.substr(0, end);
}

}  // namespace

bool matches_glob(const std::string& text, const std::string& pattern) {
  std::size_t t = 0, p = 0, star = std::string::npos, retry = 0;
  while (t < text.size()) {
    if (p < pattern.size() && (pattern[p] == '?' || pattern[p] == text[t]) && pattern[p] != '*') {
      ++t;
      ++p;
    } else if (p < pattern.size() && pattern[p] == '*') {
      star = p++;
      retry = t;
    } else if (star != std::string::npos) {
      p = star + 1;
      t = ++retry;
    } else {
      return false;
    }
  }
  while (p < pattern.size() && pattern[p] == '*') ++p;
  return p == pattern.size();
}

ClassRules load_class_rules(const std::string& path) {
  ClassRules out;
  const ConfigNode root = fs::path(path).extension() == ".csv" ? ConfigNode() : parse_config_file(path);
  if (!root.is_map()) {
    out.table = ClassTable::load(path);
    return out;
  }
  Diagnostics diagnostics;
  refuse_unknown_keys(root, "unknown key", {"classes", "rules"}, diagnostics);
  try {
    out.table = ClassTable::load(path);  // reads the list 'classes' of such a map
  } catch (const Error& e) {
    if (!diagnostics.has_errors()) throw;
    diagnostics.error(e.code(), "", e.message(), e.remedy());
  }
  if (const ConfigNode* rules = root.find("rules"); rules != nullptr && !out.table.empty()) {
    if (!rules->is_list())
      diagnostics.error("classes.rule.format", rules->location().text(), "'rules' is a list of rules", {});
    for (const ConfigNode& rule : rules->items()) read_rule(rule, out, diagnostics);
  }
  diagnostics.throw_if_errors(ErrorKind::config, "the class table '" + path + "' has errors");
  return out;
}

std::vector<std::int16_t> classes_of_mesh(const TriangleMesh& mesh, const ClassRules& rules, Diagnostics& diagnostics) {
  using Key = std::tuple<std::int32_t, std::int32_t, std::int32_t>;
  std::map<Key, std::int16_t> known;
  std::vector<bool> reported(mesh.objects.size(), false);
  std::vector<std::int16_t> out(mesh.size(), kVoid);
  const auto class_for = [&](std::size_t o, const std::string& group, const std::string& material) -> int {
    const std::string& object = mesh.objects[o];
    const auto fits = [](const std::string& pattern, const std::string& text) {
      return pattern.empty() || matches_glob(text, pattern);
    };
    for (const ClassRule& rule : rules.rules)
      if (fits(rule.object, object) && fits(rule.group, group) && fits(rule.material, material))
        return rules.table.index_of(rule.id);
    if (const ClassEntry* entry = find_class(rules.table, stem_of(object))) return rules.table.index_of(entry->id);
    if (!reported[o])
      diagnostics.error("classes.rule.missing", "object '" + object + "'",
                        "has no class" + (group.empty() ? "" : " (group '" + group + "')") +
                            (material.empty() ? "" : " (material '" + material + "')"),
                        "add a rule such as {object: \"" + object + "\", class: NAME} to the class table");
    reported[o] = true;
    return kVoid;
  };
  for (std::size_t i = 0; i < mesh.size(); ++i) {
    const auto [it, fresh] = known.emplace(Key{mesh.object_of[i], mesh.group_of[i], mesh.material_of[i]}, kVoid);
    if (fresh)
      it->second = static_cast<std::int16_t>(class_for(
          static_cast<std::size_t>(mesh.object_of[i]), mesh.groups[static_cast<std::size_t>(mesh.group_of[i])],
          mesh.material_of[i] < 0 ? "" : mesh.materials[static_cast<std::size_t>(mesh.material_of[i])].name));
    out[i] = it->second;
  }
  return out;
}

}  // namespace semfield
