#include "app/render/run_surface.h"

#include <fmt/format.h>
#include <zlib.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <ctime>
#include <new>
#include <regex>

#include "app/objects/object_files.h"
#include "core/error.h"
#include "core/files.h"
#include "eval/report/report.h"
#include "scene/camera_rig.h"
#include "scene/scene.h"
#include "surface/mesh/shape/simplify.h"
#include "surface/mesh/shape/smooth_borders.h"
#include "train/run_folder.h"

namespace semfield::app {

namespace {

constexpr double kSteps = 65535;
constexpr std::uint16_t kNoClass = 65535;

Box box_around(const Surface& surface, const ScenePage& page) {
  if (surface.positions.empty()) return page.bounds;
  Box box;
  for (const Vec3d& p : surface.positions) box.include(p);
  return box;
}

// Numbers behind each other as differences to the one before: neighbours in the file are neighbours in space, and small
// differences deflate well.
class Stream {
 public:
  template <class T, class Value>
  void differences(std::size_t count, const Value& value) {
    T before = 0;
    for (std::size_t i = 0; i < count; ++i) {
      const T now = value(i);
      put(static_cast<T>(now - before));
      before = now;
    }
  }
  template <class T>
  void put(T number) {
    const std::size_t at = bytes.size();
    bytes.resize(at + sizeof(T));
    std::memcpy(bytes.data() + at, &number, sizeof(T));
  }
  std::vector<std::uint8_t> bytes;
};

// Where the colours of entropy end: few vertices are so unsure that more would leave the others dark.
double most_entropy(const Surface& surface) {
  std::vector<float> entropy = surface.attributes.entropy;
  return entropy.empty() ? 1 : std::max(0.01, static_cast<double>(quantile(entropy, 0.99)));
}

std::vector<std::uint8_t> packed(const Surface& surface, const ScenePage& page, const Box& box) {
  Stream stream;
  std::vector<std::uint32_t> corners;
  for (const Triangle& t : surface.triangles) corners.insert(corners.end(), t.begin(), t.end());
  const std::size_t count = surface.positions.size();
  stream.differences<std::uint32_t>(corners.size(), [&](std::size_t i) { return corners[i]; });
  for (int axis = 0; axis < 3; ++axis) {
    const double length = box.size()[axis];
    stream.differences<std::uint16_t>(count, [&](std::size_t i) {
      const double share = length > 0 ? (surface.positions[i][axis] - box.lo[axis]) / length : 0;
      return static_cast<std::uint16_t>(std::lround(share * kSteps));
    });
  }
  for (int axis = 0; axis < 3; ++axis)
    for (const Vec3d& normal : surface.normals) stream.put(static_cast<std::int8_t>(std::lround(127 * normal[axis])));
  const std::vector<std::int16_t>& label = surface.attributes.label;
  for (std::size_t i = 0; i < count; ++i)
    stream.put(label.empty() || label[i] == kVoid ? kNoClass : static_cast<std::uint16_t>(label[i]));
  for (std::size_t c = 0; c < 3; ++c)
    for (std::size_t i = 0; i < count; ++i) stream.put(surface.attributes.color[i][c]);
  const double most = most_entropy(surface);
  if (!label.empty())
    for (const float entropy : surface.attributes.entropy)
      stream.put(static_cast<std::uint8_t>(std::lround(255 * std::min(static_cast<double>(entropy) / most, 1.0))));
  if (page.objects)
    for (const std::uint16_t id : vertex_objects(surface, *page.objects)) stream.put(id);
  return std::move(stream.bytes);
}

std::vector<std::uint8_t> deflated(const std::vector<std::uint8_t>& bytes) {
  uLongf size = ::compressBound(static_cast<uLong>(bytes.size()));
  std::vector<std::uint8_t> out(size);
  if (::compress2(out.data(), &size, bytes.data(), static_cast<uLong>(bytes.size()), Z_BEST_COMPRESSION) != Z_OK)
    throw std::bad_alloc();
  out.resize(size);
  return out;
}

Json list_of(Vec3d v) { return {v.x, v.y, v.z}; }

Json facts_of(const Surface& surface, const ClassTable& classes, const ScenePage& page, const Box& box) {
  Json out{{"title", page.title},
           {"about", page.about},
           {"run", page.run},
           {"step", page.step},
           {"unit", page.metric ? "m" : "units"},
           {"vertices", surface.positions.size()},
           {"triangles", surface.triangles.size()},
           {"low", list_of(box.lo)},
           {"high", list_of(box.hi)},
           {"turn", turn_to_y(page.up)},
           {"labels", page.labels},
           {"entropy", most_entropy(surface)},
           {"classes", Json::array()},
           {"objects", Json::array()}};
  if (page.eye) out["eye"] = list_of(*page.eye);
  if (page.eye) out["ahead"] = list_of(page.ahead);
  if (page.objects) out["objects"] = page_objects(*page.objects, classes);
  if (!page.labels) return out;
  for (const ClassEntry& entry : classes.entries())
    if (!entry.ignore) out["classes"].push_back({{"id", entry.id}, {"name", entry.name}, {"color", entry.color}});
  return out;
}

std::string page_part(const std::string& name, const char* ending) {
  return read_text_file(shared_file("app/serve/page/" + name + ending));
}

// The viewer as one file around `facts`, which asks nobody for anything: its modules, each behind those that it
// imports, without the words that make them modules.
std::string one_file(const std::string& title, const Json& facts, const std::string& mesh) {
  const std::regex module_words("^import .*|^export ", std::regex::multiline);
  std::string script = "\"use strict\";\n";
  for (const char* name : {"dom", "api", "pointer", "page", "camera", "drawing", "live", "objects", "view"})
    script += std::regex_replace(page_part(name, ".js"), module_words, "");
  const std::string policy =
      "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; connect-src 'none'; img-src blob: "
      "data:";
  return filled_page(
      page_part("view", ".html"),
      {{"<title>Semfield</title>", "<meta http-equiv=\"Content-Security-Policy\" content=\"" + policy + "\">\n<title>" +
                                       html_escape(title) + "</title>"},
       {"<link rel=\"icon\" href=\"./icon.svg\" type=\"image/svg+xml\">", "<link rel=\"icon\" href=\"data:,\">"},
       {"<link rel=\"stylesheet\" href=\"./style.css\">", "<style>\n" + page_part("style", ".css") + "</style>"},
       {"<script type=\"module\" src=\"./view.js\"></script>",
        "<script type=\"application/json\" id=\"facts\">" + script_json(json_text(facts)) +
            "</script>\n<script type=\"text/plain\" id=\"mesh\">" + mesh + "</script>\n<script>\n" + script +
            "</script>"}});
}

std::string today() {
  const std::time_t now = std::time(nullptr);
  std::tm utc{};
  ::gmtime_r(&now, &utc);
  return fmt::format("{:04}-{:02}-{:02}", utc.tm_year + 1900, utc.tm_mon + 1, utc.tm_mday);
}

// Of 512 in the box, how many are in the frame's picture.
int points_in_view(const FrameInfo& frame, const Box& box) {
  constexpr int kSide = 8;
  int seen = 0;
  for (int i = 0; i < kSide * kSide * kSide; ++i) {
    const Vec3d share{(i % kSide + 0.5) / kSide, (i / kSide % kSide + 0.5) / kSide, (i / kSide / kSide + 0.5) / kSide};
    Vec3d place = box.lo;
    for (int a = 0; a < 3; ++a) place[a] += share[a] * box.size()[a];
    const Vec3d there = frame.world_from_camera.apply_inverse(place);
    if (!frame.camera.sees(there)) continue;
    double u = 0, v = 0;
    frame.camera.project(there, u, v);
    seen += u >= 0 && v >= 0 && u < frame.camera.width_px && v < frame.camera.height_px ? 1 : 0;
  }
  return seen;
}

}  // namespace

ScenePage scene_page_of(const Session& session, const std::string& run_dir, std::int64_t step,
                        std::optional<Vec3d> up) {
  const SceneInfo& info = session.scene.info;
  const std::vector<int> frames = session.scene.frames_of(Split::train);
  fs::path folder = fs::path(run_dir).lexically_normal();
  if (!folder.has_filename()) folder = folder.parent_path();
  ScenePage page;
  page.run = folder.filename().string();
  page.title = info.name.empty() ? page.run : info.name;
  page.step = step;
  page.labels = session.pipeline->has_semantics();
  page.metric = info.metric;
  page.bounds = session.extent.bounds;
  if (!up) up = upright_of(session);
  page.up = up.value_or(page.up);
  page.about = {
      fmt::format("Run '{}': {} steps of training on {} photographs.", page.run, step, frames.size()),
      fmt::format("Source: {}.", session.config.dataset.entry->name),
      fmt::format("Made by Semfield {}. Positions are in the input's world.", this_environment().version),
      "The rights of the photographs hold for this file. Its viewer is part of Semfield (Apache License 2.0)."};
  page.objects = objects_of_run(folder.string(), info.classes.valid_count());
  const bool inward = session.config.rendering.far != FarMode::background && session.scene.rig.inward;
  if (inward || frames.empty()) return page;
  const auto seen = [&](int f) { return points_in_view(info.frames[static_cast<std::size_t>(f)], page.bounds); };
  const int most = *std::max_element(frames.begin(), frames.end(), [&](int a, int b) { return seen(a) < seen(b); });
  const Pose& camera = info.frames[static_cast<std::size_t>(most)].world_from_camera;
  page.eye = camera.t;
  page.ahead = camera.axis(2);
  return page;
}

Json page_objects(const ObjectSet& objects, const ClassTable& classes) {
  Json out = Json::array();
  for (const ObjectRow& row : objects.rows) {
    if (row.points == 0) continue;
    Json one = Json::parse(object_row_json(row, classes));
    one["color"] = ClassTable::default_color(row.id);
    for (const char* key : {"agreement", "area", "centroid"}) one.erase(key);
    out.push_back(std::move(one));
  }
  return out;
}

std::vector<std::uint16_t> vertex_objects(const Surface& surface, const ObjectSet& objects) {
  std::vector<Vec3d> middle(surface.positions.size());
  std::vector<double> triangles(middle.size());
  for (const Triangle& t : surface.triangles) {
    for (const std::uint32_t v : t) {
      middle[v] = middle[v] + (surface.positions[t[0]] + surface.positions[t[1]] + surface.positions[t[2]]) * (1 / 3.0);
      triangles[v] += 1;
    }
  }
  for (std::size_t v = 0; v < middle.size(); ++v)
    middle[v] = triangles[v] > 0 ? middle[v] * (1 / triangles[v]) : surface.positions[v];
  const std::vector<std::int32_t> ids = objects.at(middle);
  return {ids.begin(), ids.end()};
}

std::string scene_page_text(const Surface& surface, const ClassTable& classes, const ScenePage& page) {
  const Box box = box_around(surface, page);
  return one_file(page.title, facts_of(surface, classes, page, box), base64(deflated(packed(surface, page, box))));
}

void write_scene_page(const std::string& path, const Surface& surface, const ClassTable& classes,
                      const ScenePage& page) {
  ScenePage dated = page;
  dated.about.push_back("Written on " + today() + ".");
  write_file_atomic(path, scene_page_text(surface, classes, dated));
}

std::pair<std::string, std::string> scene_parts(const Surface& surface, const ClassTable& classes,
                                                const ScenePage& page, const Json& more) {
  const Box box = box_around(surface, page);
  Json facts = facts_of(surface, classes, page, box);
  facts.update(more);
  const std::vector<std::uint8_t> mesh = deflated(packed(surface, page, box));
  return {json_text(facts), std::string(mesh.begin(), mesh.end())};
}

namespace {

constexpr long long kDefaultResolution = 256;
constexpr int kSightLines = 4096;

void say(const SurfaceNews& news, const std::string& text) {
  if (news.note) news.note(text);
}

// A surface of depth may lie on the bounds, and what is solid behind it outside of them.
VoxelGrid grid_of(const SurfaceWishes& wishes, Box bounds, bool of_density) {
  const Vec3d size = bounds.size();
  const auto cells = static_cast<double>(wishes.resolution.value_or(kDefaultResolution));
  const double spacing = wishes.voxel.value_or(std::max({size.x, size.y, size.z}) / cells);
  const double margin = of_density ? 0 : kTruncationCells * spacing;
  bounds.lo = bounds.lo - Vec3d{margin, margin, margin};
  bounds.hi = bounds.hi + Vec3d{margin, margin, margin};
  return VoxelGrid::covering(bounds, spacing);
}

SurfaceRequest request_of(const SurfaceWishes& wishes, const Session& s, const VoxelGrid& grid,
                          std::span<const RayCamera> cameras) {
  SurfaceRequest request;
  request.grid = grid;
  request.opaque_border = s.limits.clip && s.config.rendering.far == FarMode::background;
  if (wishes.level) {
    request.level_per_m = *wishes.level;
    return request;
  }
  request.level_per_m =
      choose_level(*s.pipeline, request, depth_views(*s.pipeline, cameras, s.limits, kSightLines), s.limits);
  return request;
}

void find_in_depth(RunSurface& found, const Session& s, const SurfaceWishes& wishes, std::span<const RayCamera> cameras,
                   const SurfaceNews& news) {
  const std::vector<FrameInfo>& frames = s.scene.info.frames;
  const bool guessed = std::none_of(frames.begin(), frames.end(), [](const FrameInfo& f) { return f.has_depth; });
  if (guessed)
    say(news,
        fmt::format("no depth images: the depth that {} photographs alone give has gaps and bumps. The surface is "
                    "what {} views or more agree on, smoothed",
                    cameras.size(), kLeastGuesses));
  else
    say(news, "the scene has depth images: --surface sensor makes a surface of them, often a more complete one");
  const std::vector<DepthView> views =
      depth_views(*s.pipeline, cameras, s.limits, wishes.depth_rays, [&](std::size_t done) {
        if (news.views) news.views(static_cast<double>(done), static_cast<double>(cameras.size()));
      });
  found.surface = fused_surface(views, s.limits, found.grid, guessed);
  found.described = "in the depth of the training views";
}

void find_in_density(RunSurface& found, const Session& s, const std::string& run_dir, const SurfaceWishes& wishes,
                     std::span<const RayCamera> cameras, const SurfaceNews& news) {
  const SurfaceRequest request = request_of(wishes, s, found.grid, cameras);
  found.level = request.level_per_m;
  found.described = fmt::format("at a density of {:.4g} / {}", request.level_per_m, s.scene.info.metric ? "m" : "unit");
  say(news, "surface " + found.described);
  found.surface = density_surface(*s.pipeline, request);
  if (wishes.keep_unseen) return;
  const std::size_t all = found.surface.triangles.size();
  keep_triangles(found.surface,
                 triangles_in_sight(found.surface, sights_of(found.surface, cameras, s.limits, found.grid.spacing)));
  found.unseen = all - found.surface.triangles.size();
  if (found.unseen == 0) return;
  if (found.surface.triangles.empty()) {
    throw Error(
        ErrorKind::data, "mesh.surface.unseen",
        fmt::format("{}: no training camera sees any of the {} faces {}", run_dir, found.unseen, found.described),
        "train longer, or keep them with --keep-unseen");
  }
  say(news, fmt::format("{} of {} faces that no training camera sees are left out; --keep-unseen keeps them",
                        found.unseen, all));
}

// At most so many faces, and smooth borders. Those are cut last, for a cut border has two sides that collapses would
// pull apart; so what the cuts will add is taken away before.
void finish(Surface& surface, std::optional<long long> faces, const ObjectSet* objects, const SurfaceNews& news) {
  const auto cut = [&](Surface& whole) {
    if (objects != nullptr) whole.attributes.instance = objects->at(whole.positions);
    smooth_borders(whole);
    return whole.triangles.size();
  };
  if (!faces) {
    cut(surface);
    return;
  }
  const std::size_t before = surface.triangles.size();
  const auto most = static_cast<std::size_t>(*faces);
  for (std::size_t wanted = most;;) {
    simplify(surface, wanted);
    Surface whole = surface;
    const std::size_t left = cut(whole);
    if (left > most && surface.triangles.size() <= wanted) {
      wanted = std::min(wanted - 1, wanted * most / left);
      continue;
    }
    surface = std::move(whole);
    if (left < before)
      say(news, fmt::format("{} of {} faces are left{}", left, before,
                            left > most ? ": fewer would tear the surface or turn faces over" : ""));
    return;
  }
}

}  // namespace

std::vector<RayCamera> training_cameras(const Session& session) {
  std::vector<RayCamera> cameras;
  for (const int f : session.scene.frames_of(Split::train)) {
    const FrameInfo& info = session.scene.info.frames[static_cast<std::size_t>(f)];
    cameras.push_back({info.camera, info.world_from_camera, session.plan.undistortion});
  }
  return cameras;
}

// Cameras that stand inside of what they see leave much of it unseen. What is alone in empty space is seen from all
// around, and its density is the finer source.
std::string surface_source(const SurfaceWishes& wishes, const Session& session) {
  const bool of_density = wishes.level || wishes.keep_unseen;
  if ((wishes.source == "depth" || wishes.source == "sensor") && of_density)
    throw Error(ErrorKind::usage, "mesh.surface.options",
                "--surface " + wishes.source + ": " + (wishes.level ? "--level" : "--keep-unseen") +
                    " belongs to the surface of the density",
                "leave one of the two out");
  if (!wishes.source.empty()) return wishes.source;
  return !of_density && session.config.rendering.far == FarMode::background ? "depth" : "density";
}

RunSurface make_run_surface(const Session& session, const std::string& run_dir, const SurfaceWishes& wishes,
                            std::span<const DepthView> sensor, const ObjectSet* objects, const SurfaceNews& news) {
  RunSurface found;
  found.source = surface_source(wishes, session);
  found.grid = grid_of(wishes, session.extent.bounds, found.source == "density");
  say(news, fmt::format("{} x {} x {} points, {:.4g} {} apart", found.grid.nx, found.grid.ny, found.grid.nz,
                        found.grid.spacing, session.scene.info.metric ? "m" : "units"));
  const std::vector<RayCamera> cameras = training_cameras(session);
  if (found.source == "sensor") {
    found.surface = fused_surface(sensor, session.limits, found.grid);
    found.described = "in the depth images of the training frames";
  } else if (found.source == "depth") {
    find_in_depth(found, session, wishes, cameras, news);
  } else {
    find_in_density(found, session, run_dir, wishes, cameras, news);
  }
  Surface& surface = found.surface;
  found.components = drop_small_components(surface, wishes.keep_components);
  if (surface.triangles.empty()) {
    throw Error(ErrorKind::data, "mesh.surface.none", fmt::format("{}: no surface {}", run_dir, found.described),
                found.source == "density" ? "lower --level, or --keep-components, or train longer"
                                          : "train longer, or take --surface density");
  }
  if (wishes.close_holes) {
    found.closed = close_holes(surface, *wishes.close_holes);
    say(news, fmt::format("{} holes closed", found.closed));
  }
  PhotoColors photos;
  for (const int f : session.scene.frames_of(Split::train))
    photos.photos.push_back(&session.scene.frames[static_cast<std::size_t>(f)]);
  const std::vector<Sights> sights = sights_of(surface, cameras, session.limits, found.grid.spacing, &photos);
  PointAttributes& known = surface.attributes;
  known = render_attributes(*session.pipeline, surface, cameras, sights, session.limits, session.plan.class_of_logit);
  known.color = std::move(photos.color);
  // What no photograph shows is as what lies nearest to it.
  const std::vector<std::uint32_t> nearest = reach_of(edges_of(surface), photos.known).nearest;
  for (std::size_t v = 0; v < nearest.size(); ++v) {
    known.color[v] = known.color[nearest[v]];
    if (!known.has_labels() || sights[v].any()) continue;
    known.label[v] = known.label[nearest[v]];
    known.entropy[v] = known.entropy[nearest[v]];
  }
  finish(surface, wishes.faces, objects, news);
  return found;
}

std::optional<Vec3d> upright_of(const Session& session) {
  std::vector<Pose> poses;
  for (const RayCamera& camera : training_cameras(session)) poses.push_back(camera.world_from_camera);
  return up_of_cameras(poses);
}

std::string report_scene(const Session& session, const std::string& run_dir, std::int64_t step,
                         const AppContext& context) {
  constexpr long long kCells = 64;  // along the longest side
  constexpr std::int64_t kMostRays = 60'000, kLeastRays = 15'000;
  constexpr std::int64_t kShare = 10;  // of the rays of training: one of so many
  const std::int64_t rays = std::min(kMostRays, step * session.config.train.rays / kShare);
  if (rays < kLeastRays) return {};
  SurfaceWishes wishes;
  wishes.resolution = kCells;
  wishes.depth_rays = rays;
  try {
    const ScenePage page = scene_page_of(session, run_dir, step);
    const ObjectSet* const objects = page.objects ? &*page.objects : nullptr;
    const RunSurface found = make_run_surface(session, run_dir, wishes, {}, objects, {});
    return scene_page_text(found.surface, session.scene.info.classes, page);
  } catch (const Error& e) {
    if (e.kind() != ErrorKind::data && e.kind() != ErrorKind::no_input) throw;
    print_note(context, "no view in 3D in the report: " + e.message());
    return {};
  }
}

}  // namespace semfield::app
