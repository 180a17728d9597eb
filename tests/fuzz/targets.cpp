// What the targets share: bytes as files in a folder of this process, several files in one input, datasets by name.

#include "tests/fuzz/targets.h"

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <set>
#include <sstream>
#include <stdexcept>

#include "app/serve/http_server.h"
#include "app/serve/page_requests.h"
#include "config/config_words.h"
#include "config/settings/run_config.h"
#include "core/files.h"
#include "datasets/obj_room/obj_room.h"
#include "eval/report/sweep.h"
#include "formats/image_io.h"
#include "formats/npz.h"
#include "formats/safetensors.h"
#include "labels/clicks.h"
#include "plugin/loader.h"
#include "plugin/registry.h"
#include "scene/camera.h"
#include "scene/classes/class_table.h"
#include "scene/loading/frame_files.h"
#include "scene/loading/packed_scene.h"
#include "surface/objects/object_set.h"
#include "tests/labels/reader_case.h"
#include "tests/scene/image_bytes.h"
#include "train/checkpoint.h"
#include "train/metrics_log.h"

namespace semfield::fuzz {
namespace {

/// A folder of this process, in memory where the machine offers that; removed when the process ends.
const std::string& folder();
/// An 8-bit grey PNG of a few pixels at `name`, written once a process.
std::string put_image(const std::string& name, int width_px = 4, int height_px = 3);

struct Folder {
  Folder() {
    const fs::path parent = fs::is_directory("/dev/shm") ? fs::path("/dev/shm") : fs::temp_directory_path();
    std::string name = (parent / "semfield_fuzz_XXXXXX").string();
    if (::mkdtemp(name.data()) == nullptr) throw std::runtime_error("no folder for the files of the fuzzer");
    path = name;
  }
  ~Folder() {
    std::error_code ignored;
    fs::remove_all(path, ignored);
  }
  std::string path;
};

const std::string& folder() {
  static const Folder made;
  return made.path;
}

/// Writes `folder()/name`, making folders on the way, and returns its path.
std::string put(const std::string& name, std::string_view bytes) {
  const fs::path path = fs::path(folder()) / name;
  std::FILE* file = std::fopen(path.c_str(), "wb");
  if (file == nullptr) {
    fs::create_directories(path.parent_path());
    file = std::fopen(path.c_str(), "wb");
  }
  if (file == nullptr || (!bytes.empty() && std::fwrite(bytes.data(), 1, bytes.size(), file) != bytes.size()))
    throw std::runtime_error("cannot write " + path.string());
  std::fclose(file);
  return path.string();
}

std::string put_image(const std::string& name, int width_px, int height_px) {
  static std::set<std::string> written;
  const std::string path = (fs::path(folder()) / name).string();
  if (!written.insert(name).second) return path;
  fs::create_directories(fs::path(path).parent_path());
  const std::vector<std::uint8_t> pixels(static_cast<std::size_t>(width_px) * static_cast<std::size_t>(height_px), 1);
  write_png_gray8(path, width_px, height_px, pixels);
  return path;
}

/// The input cut at its lines "=====": several files in one input. At least `count` parts, the missing ones empty.
std::vector<std::string_view> parts_of(std::string_view bytes, std::size_t count) {
  constexpr std::string_view kCut = "=====\n";
  std::vector<std::string_view> out;
  while (out.size() + 1 < count) {
    const std::size_t at = bytes.find(kCut);
    if (at == std::string_view::npos) break;
    out.push_back(bytes.substr(0, at));
    bytes.remove_prefix(at + kCut.size());
  }
  out.push_back(bytes);
  out.resize(std::max(count, out.size()));
  return out;
}

/// Runs `body`. An Error with a message is a refusal and gives false; Error(internal) and one without words are no
/// refusals and are passed on as std::logic_error.
bool accepted(const std::function<void()>& body) {
  try {
    body();
    return true;
  } catch (const Error& e) {
    if (e.kind() == ErrorKind::internal)
      throw std::logic_error(std::string("an input is no fault of ours: ") + e.what());
    if (e.message().empty()) throw std::logic_error("refused without a word");
    return false;
  }
}

/// Throws std::logic_error unless `holds`.
void promise(bool holds, const char* what) {
  if (!holds) throw std::logic_error(what);
}

/// Every linked plugin.
Registry& registry() {
  static Registry& made = []() -> Registry& {
    static Registry all;
    register_linked_plugins(all);
    return all;
  }();
  return made;
}

/// Opens the dataset `name` with the parameters `yaml` in folder(), and reads every frame when it has no errors.
void open_dataset(const std::string& name, const std::string& yaml) {
  const PluginEntry& entry = registry().get(PluginKind::dataset, name);
  const std::unique_ptr<PluginParams> params = entry.new_params();
  Diagnostics settings;
  read_params(
      parse_config_text(yaml, "scene"), "scene", [&](ParamVisitor& visit) { params->describe(visit); }, settings);
  promise(!settings.has_errors(), "the parameters of the target itself are wrong");
  accepted([&] {
    const std::unique_ptr<Dataset> dataset = entry.dataset(*params, DatasetBuild{folder()});
    Diagnostics diagnostics;
    const SceneInfo info = dataset->open(diagnostics);
    for (const Diagnostic& d : diagnostics.all()) promise(!d.message.empty(), "a finding without a word");
    if (diagnostics.has_errors()) return;
    for (std::size_t i = 0; i < info.frames.size(); ++i) {
      const FrameInfo& frame = info.frames[i];
      promise(frame.camera.width_px > 0 && frame.camera.height_px > 0, "an accepted frame has no size");
      promise(frame.camera.fx > 0 && frame.camera.fy > 0, "an accepted frame has no focal length");
      for (int a = 0; a < 3; ++a) {
        promise(std::isfinite(frame.world_from_camera.t[a]), "an accepted pose is not finite");
        for (const double v : frame.world_from_camera.r[a])
          promise(std::abs(v) < 1.01, "an accepted pose has no rotation");
      }
      FrameBuffer buffer;
      accepted([&] { dataset->read(static_cast<int>(i), buffer); });
    }
  });
}

// Configurations, what a run left behind, and the table of all targets.

// Configuration files: the tree, composition with includes and values of the command line, runs and sweeps.

void written_reads_back(std::string_view yaml) {
  ConfigNode tree;
  if (!accepted([&] { tree = parse_config_text(yaml, "main.yaml"); })) return;
  ConfigNode again, inline_again;
  promise(accepted([&] { again = parse_config_text(write_config(tree), "written"); }),
          "what is written cannot be read");
  promise(equal_config(tree, again), "what is written reads back as something else");
  promise(accepted([&] { inline_again = parse_config_value(write_config_inline(tree), "--set a"); }),
          "what is written in one line cannot be read");
  promise(equal_config(tree, inline_again), "what is written in one line reads back as something else");
}

std::vector<std::string> lines_of(std::string_view text) {
  std::vector<std::string> out;
  std::istringstream in{std::string(text)};
  for (std::string line; std::getline(in, line);) out.push_back(line);
  return out;
}

// Parts: the file, a file part.yaml that it may include, lines of --set.
void fuzz_config(std::string_view bytes) {
  const auto parts = parts_of(bytes, 3);
  written_reads_back(parts[0]);
  const std::string main = put("main.yaml", parts[0]);
  put("part.yaml", parts[1]);
  accepted([&] {
    const ConfigNode tree = compose_config(main, lines_of(parts[2]));
    if (tree.find("plugins") != nullptr) return;  // would load code
    Diagnostics diagnostics;
    const RunConfig run = read_run_config(tree, registry(), diagnostics);
    if (diagnostics.has_errors()) return;
    const ConfigNode resolved = resolved_config(run);
    Diagnostics second;
    ConfigNode read_back = parse_config_text(write_config(resolved), "run.yaml");
    const RunConfig same = read_run_config(read_back, registry(), second);
    promise(!second.has_errors(), "a resolved configuration is refused");
    promise(equal_config(resolved, resolved_config(same)), "a resolved configuration reads back as another run");
  });
}

// Parts: the sweep, a base configuration part.yaml.
void fuzz_sweep(std::string_view bytes) {
  const auto parts = parts_of(bytes, 2);
  const std::string main = put("sweep.yaml", parts[0]);
  put("part.yaml", parts[1]);
  accepted([&] { (void)read_sweep(main); });
}

// What a run left behind: checkpoints and metrics.

void fuzz_checkpoint(std::string_view bytes) {
  for (const bool with_checksums : {true, false}) {
    TensorFile::Limits limits{.require_checksums = with_checksums};
    accepted([&] {
      const TensorFile file = TensorFile::decode(std::string(bytes), "a.safetensors", limits);
      for (const TensorRef& tensor : file.tensors()) {
        std::uint64_t count = 1;
        for (const std::int64_t axis : tensor.shape) count *= static_cast<std::uint64_t>(axis);
        promise(tensor.bytes.size() == count * tensor_type_bytes(tensor.type), "bytes that do not fill the shape");
        accepted([&] { (void)file.floats(tensor.name, static_cast<std::int64_t>(count)); });
      }
      accepted([&] { (void)read_checkpoint_facts(file); });
      (void)read_checkpoint_facts(file, 2);
    });
  }
}

void fuzz_metrics(std::string_view bytes) {
  accepted([&] {
    const std::vector<MetricsRow> rows = parse_metrics(bytes, "metrics.jsonl");
    std::string written;
    for (const MetricsRow& row : rows) written += metrics_line(row) + "\n";
    std::vector<MetricsRow> again;
    promise(accepted([&] { again = parse_metrics(written, "written"); }), "what is written cannot be read");
    promise(again.size() == rows.size(), "what is written has other rows");
  });
}

// Parts: edits.json, then found.safetensors, which may hold any bytes; its checksums are corrected.
void fuzz_objects(std::string_view bytes) {
  constexpr int kClasses = 3;
  const auto parts = parts_of(bytes, 2);
  const std::string edits_file = put("objects/edits.json", parts[0]);
  std::string found(parts[1]);
  accepted([&] {
    const TensorFile::Limits limits{.refuse_nonfinite = false, .require_checksums = false};
    const TensorFile file = TensorFile::decode(found, "found.safetensors", limits);
    if (file.find("") == nullptr) found = encode_safetensors(file.tensors(), file.metadata());
  });
  const std::string found_file = put("objects/found.safetensors", found);
  ObjectSet set;
  if (!accepted([&] { set = read_object_set(found_file, kClasses); })) return;
  const auto is_whole = [](const ObjectSet& one) {
    for (const std::int32_t id : one.id) promise(id >= 0 && id <= std::ssize(one.rows), "an object without a row");
    for (const std::int16_t index : one.class_of) promise(index >= kVoid && index < kClasses, "a class that is none");
    for (const ObjectRow& row : one.rows)
      promise(row.class_index >= kVoid && row.class_index < kClasses && row.points >= 0 && row.views >= 0,
              "a row that cannot be");
  };
  is_whole(set);
  const std::string written = folder() + "/objects/written.safetensors";
  write_object_set(written, set);
  promise(read_object_set(written, kClasses).digest() == set.digest(), "objects that read back as others");
  accepted([&] {
    ObjectEdits edits = read_object_edits(edits_file);
    const std::string text = put("objects/again.json", object_edits_text(edits));
    promise(object_edits_text(read_object_edits(text)) == object_edits_text(edits), "edits that read back as others");
    edits.digest = set.digest();
    apply_edits(set, edits, edits_file);
  });
  is_whole(set);
}

// Label files, class tables and what the labelling page's server is sent.

// Label files of every reader that `scene.labels.from` offers, and NumPy arrays.

// Opens with and without a class table and reads the labels of one frame, 'a' of 4 x 3 pixels.
void read_labels(std::string_view type, const std::string& yaml) {
  const ClassTable room(
      {{0, "void", {0, 0, 0}, true}, {1, "wall", {10, 20, 30}, false}, {4, "chair", {40, 50, 60}, false}});
  FrameInfo frame{.name = "a", .source = "/nowhere/a.png", .camera = {.width_px = 4, .height_px = 3}};
  for (const ClassTable& known : {room, ClassTable()}) {
    const std::unique_ptr<LabelReader> reader = testing_labels::make_reader(std::string(type), yaml);
    accepted([&] {
      Diagnostics diagnostics;
      const ClassTable own = reader->open(known, diagnostics);
      if (diagnostics.has_errors()) return;
      reader->match({frame}, diagnostics);
      if (diagnostics.has_errors() || !reader->has(frame)) return;
      const ClassTable& classes = known.empty() || reader->adds_classes() ? own : known;
      const LabelRaster raster = reader->read(frame, classes);
      const std::size_t pixels = static_cast<std::size_t>(raster.width_px) * static_cast<std::size_t>(raster.height_px);
      promise(raster.hard.empty() || raster.hard.size() == pixels, "a raster of another size");
      promise(raster.soft.empty() || raster.soft.size() == pixels * static_cast<std::size_t>(classes.valid_count()),
              "probabilities of another size");
      for (const std::int16_t index : raster.hard)
        promise(index >= kVoid && index < classes.valid_count(), "a label that is no class");
    });
  }
}

void fuzz_labelme(std::string_view bytes) {
  put("labelme/a.json", bytes);
  read_labels("labelme", "folder: " + folder() + "/labelme");
}

void fuzz_coco(std::string_view bytes) { read_labels("coco", "file: " + put("coco.json", bytes)); }

void fuzz_clicks(std::string_view bytes) { read_labels("clicks", "file: " + put("clicks.csv", bytes)); }

void fuzz_label_event(std::string_view bytes) {
  accepted([&] {
    const LabelEvent event = parse_label_event(bytes);
    const std::string line = label_event_json(event);
    promise(line.find('\n') == std::string::npos, "an event of more than one line");
    promise(line.size() <= kMostEventBytes, "an event that is longer than it may be");
    promise(parse_label_event(line) == event, "an event that reads back as another one");
  });
}

void fuzz_click_log(std::string_view bytes) { read_labels("clicks", "file: " + put("clicks.jsonl", bytes)); }

// Parts: a table of colours, then the image.
void fuzz_label_image(std::string_view bytes) {
  const auto parts = parts_of(bytes, 2);
  put("label_image/a.png", parts[1]);
  const std::string colors = put("colors.csv", parts[0]);
  const std::string start = "folder: " + folder() + "/label_image\n";
  read_labels("images", start + "kind: ids");
  read_labels("images", start + "kind: palette\nunknown: void");
  read_labels("images", start + "kind: color\nfile: " + colors);
}

void fuzz_npy(std::string_view bytes) {
  const std::string path = put("npy/a.npy", bytes);
  accepted([&] {
    const NumpyArray array = read_npy(path, {});
    std::size_t count = 1;
    for (const std::int64_t axis : array.shape) count *= static_cast<std::size_t>(axis);
    promise(array.values.size() == count, "values that do not fill the shape");
  });
  accepted([&] {
    const NumpyValues found = read_npy_values(path, {});
    promise(found.is_whole == npy_is_whole(path), "a header that is read in two ways");
    promise(npy_shape(path) == found.shape, "a shape that is read in two ways");
  });
  accepted([&] {
    const Image<float> depth = read_depth(path);
    const ImageSize size = depth_size(path);
    promise(size.width_px == depth.width_px && size.height_px == depth.height_px, "depth of another size");
    for (const float z : depth.pixels) promise(z >= 0 && std::isfinite(z), "depth that is none");
  });
  put("npy/classes.json", R"(["wall", "chair"])");
  read_labels("npz", "{folder: " + folder() + "/npy, pattern: \"{name}.npy\"}");
}

// Parts: the archive, classes.json; the order of the two is that which lets the archive hold any bytes.
void fuzz_npz(std::string_view bytes) {
  const auto parts = parts_of(bytes, 2);
  put("npz/classes.json", parts[0]);
  const std::string path = put("npz/a.npz", parts[1]);
  accepted([&] {
    const NpzFile file(path);
    for (const std::string& key : file.keys()) {
      accepted([&] { (void)file.read(key, {}); });
      accepted([&] { (void)file.bytes(key, {}); });
      accepted([&] { (void)file.whole(key, {}); });
    }
  });
  read_labels("npz", "{folder: " + folder() + "/npz, confidence_key: confidence}");
}

// Class tables and the rules that give mesh parts their classes.

// The same bytes as every kind of table.
void fuzz_classes(std::string_view bytes) {
  for (const char* name : {"classes.yaml", "classes.csv", "info_semantic.json", "labelmap.txt", "labels.tsv"}) {
    const std::string path = put(name, bytes);
    accepted([&] {
      const ClassTable table = import_classes(path);
      promise(table.valid_count() <= 1024, "more classes than are allowed");
      for (const ClassEntry& entry : table.entries()) {
        promise(entry.id >= 0 && entry.id <= 65535, "an id that no label image can hold");
        promise(table.index_of(entry.id) == (entry.ignore ? kVoid : table.index_of(entry.id)),
                "an ignored class counts");
      }
      const std::string written = put("written.yaml", table.to_yaml());
      ClassTable again;
      promise(table.empty() || accepted([&] { again = ClassTable::load(written); }), "what is written cannot be read");
      promise(again.entries().size() == table.entries().size(), "what is written has other classes");
    });
  }
}

void fuzz_class_rules(std::string_view bytes) {
  const std::string path = put("rules.yaml", bytes);
  accepted([&] {
    const ClassRules rules = load_class_rules(path);
    TriangleMesh mesh{.objects = {"chair_1", "wall__north", "lamp.003", ""}, .groups = {"", "g"}};
    mesh.materials.resize(1);
    mesh.materials[0].name = "Glass";
    for (std::int32_t t = 0; t < 4; ++t) {
      mesh.triangles.push_back({0, 0, 0});
      mesh.object_of.push_back(t);
      mesh.group_of.push_back(t % 2);
      mesh.material_of.push_back(t % 2 - 1);
    }
    Diagnostics diagnostics;
    for (const std::int16_t index : classes_of_mesh(mesh, rules, diagnostics))
      promise(index >= kVoid && index < rules.table.valid_count(), "a class that is none");
  });
}

// What the labelling page's server is sent: requests for pictures and exports, and queries.

// As the body of every kind of request, and as a query.
void fuzz_page(std::string_view bytes) {
  accepted([&] {
    const PictureRequest r = app::parse_picture_request(bytes);
    promise(r.view >= 0, "a picture of no view");
    promise(r.color || r.labels || r.entropy, "a picture without a map");
  });
  accepted([&] {
    const app::Json root = app::parse_request(bytes, {"run", "camera", "width", "height", "map"});
    const app::FreeCamera camera = app::read_request_camera(app::kRequest.at(root, "camera"));
    const Pose& pose = camera.world_from_camera;
    for (int a = 0; a < 3; ++a) {
      promise(std::abs(dot(pose.axis(a), pose.axis(a)) - 1) <= 1e-3, "a rotation that is none");
      promise(std::abs(pose.t[a]) <= 1e6, "a camera that is nowhere");
    }
    promise(camera.fov_deg >= 1 && camera.fov_deg <= 170, "a field of view that is none");
  });
  accepted([&] { promise(app::query_number(bytes, "view", 3, 100) <= 100, "a number above its bound"); });
}

// As what a connection brings: the same request comes out, however the bytes are cut.
void fuzz_http(std::string_view bytes) {
  constexpr std::size_t kMostBody = 64;
  const auto request = [&](std::size_t piece) -> std::string {
    std::size_t at = 0;
    app::HttpReader reader(kMostBody, [&](std::string& unread) {
      if (at >= bytes.size()) throw app::HttpRefusal{};
      unread += bytes.substr(at, piece);
      at += piece;
    });
    try {
      app::HttpRequest r = reader.read_head();
      reader.read_body(r);
      promise(r.body.size() <= kMostBody, "a body above its bound");
      promise(r.header_count("content-length") + r.header_count("transfer-encoding") <= 1, "a body of two lengths");
      std::string told = r.method + ' ' + r.path + '?' + r.query;
      for (const auto& [name, value] : r.headers) told += '\n' + name + ": " + value;
      return told + "\n\n" + r.body + '\n';
    } catch (const app::HttpRefusal& refusal) {
      promise(refusal.status == 0 || refusal.status == 400 || refusal.status == 411 || refusal.status == 413,
              "a refusal without a status");
      return "refused: " + refusal.complaint;
    }
  };
  const std::string whole = request(std::max<std::size_t>(bytes.size(), 1));
  for (const std::size_t piece : {1, 3, 17})
    promise(request(piece) == whole, "a request that depends on how it is cut");
}

// Scenes: poses, indexes of the dataset plugins, meshes, packed scenes, PNG.

void fuzz_poses(std::string_view bytes) {
  const std::string path = put("poses.txt", bytes);
  for (const CameraAxes axes :
       {CameraAxes::right_down_forward, CameraAxes::right_up_backward, CameraAxes::left_up_forward}) {
    accepted([&] {
      for (const Pose& pose : read_camera_file(path, axes)) {
        for (int a = 0; a < 3; ++a) {
          promise(std::isfinite(pose.t[a]), "an accepted centre is not finite");
          const Vec3d axis = pose.axis(a);
          promise(std::abs(dot(axis, axis) - 1) < 1e-6, "an accepted rotation is none");
        }
      }
    });
  }
}

void fuzz_cameras(std::string_view bytes) {
  const std::string path = put("cameras.json", bytes);
  CameraSet set;
  const bool read = accepted([&] {
    Diagnostics diagnostics;
    set = read_cameras(path, diagnostics);
  });
  if (!read) return;
  promise(!set.cameras.empty(), "an accepted file has a camera");
  for (const PlacedCamera& placed : set.cameras) {
    promise(placed.camera.fx > 0 && placed.camera.fy > 0, "an accepted camera has no focal length");
    promise(placed.far_m == 0 || placed.near_m < placed.far_m, "an accepted camera sees nothing");
    const Vec3d axis = placed.world_from_camera.axis(2);
    promise(std::abs(dot(axis, axis) - 1) < 1e-6, "an accepted rotation is none");
  }
  write_cameras(path, set);
  const std::string once = read_text_file(path);
  Diagnostics diagnostics;
  write_cameras(path, read_cameras(path, diagnostics));
  promise(once == read_text_file(path), "cameras are read back otherwise");
}

/// A scene made of an input: its parts in the files that hold them, and images as they should be.
struct SceneOfParts {
  const char *dataset, *settings;
  std::vector<std::vector<const char*>> parts;
  std::vector<const char*> images;
  void open(std::string_view bytes) const {
    const auto texts = parts_of(bytes, parts.size());
    for (std::size_t i = 0; i < parts.size(); ++i) {
      for (const char* file : parts[i]) put(file, texts[i]);
    }
    for (const char* image : images) put_image(image);
    open_dataset(dataset, settings);
  }
};

#define SCENE_OF_PARTS(name, ...)                   \
  void fuzz_##name(std::string_view bytes) {        \
    static const SceneOfParts kScene = __VA_ARGS__; \
    kScene.open(bytes);                             \
  }
SCENE_OF_PARTS(transforms, {"transforms_json",
                            "root: transforms",
                            {{"transforms/transforms.json"}, {"transforms/classes.yaml"}},
                            {"transforms/a.png", "transforms/b.png", "transforms/d.png", "transforms/l.png"}})
SCENE_OF_PARTS(llff, {"llff", "root: llff", {{"llff/poses_bounds.npy"}}, {"llff/images/a.png", "llff/images/b.png"}})
SCENE_OF_PARTS(record3d, {"record3d",
                          "root: record3d",
                          {{"record3d/metadata.json"}},
                          {"record3d/rgb/0.png", "record3d/rgb/2.png"}})
SCENE_OF_PARTS(polycam, {"polycam",
                         "root: polycam",
                         {{"polycam/keyframes/cameras/0.json", "polycam/keyframes/cameras/1.json"}},
                         {"polycam/keyframes/images/0.png", "polycam/keyframes/images/1.png"}})
SCENE_OF_PARTS(stray_scanner, {"stray_scanner",
                               "root: stray_scanner",
                               {{"stray_scanner/odometry.csv"}, {"stray_scanner/camera_matrix.csv"}},
                               {"stray_scanner/rgb/000000.png", "stray_scanner/rgb/000002.png"}})
SCENE_OF_PARTS(arkit_scenes, {"arkit_scenes",
                              "root: arkit_scenes",
                              {{"arkit_scenes/lowres_wide.traj"},
                               {"arkit_scenes/lowres_wide_intrinsics/7_1.000.pincam",
                                "arkit_scenes/lowres_wide_intrinsics/7_1.100.pincam"}},
                              {"arkit_scenes/lowres_wide/7_1.000.png", "arkit_scenes/lowres_wide/7_1.100.png"}})
SCENE_OF_PARTS(tum,
               {"tum", "root: tum", {{"tum/rgb.txt"}, {"tum/groundtruth.txt"}, {"tum/depth.txt"}}, {"tum/rgb/a.png"}})
SCENE_OF_PARTS(replica, {"replica",
                         "{root: replica, train_step: 2, train_offset: 0, test_step: 2, test_offset: 1}",
                         {{"replica/traj_w_c.txt"}, {"replica/info_semantic.json"}},
                         {"replica/rgb/rgb_0.png", "replica/semantic_class/semantic_class_0.png",
                          "replica/rgb/rgb_1.png", "replica/semantic_class/semantic_class_1.png",
                          "replica/rgb/rgb_2.png", "replica/semantic_class/semantic_class_2.png"}})
SCENE_OF_PARTS(replica_slam, {"replica",
                              "root: slam",
                              {{"slam/traj.txt"}, {"slam/cam_params.json"}},
                              {"slam/results/frame000000.png", "slam/results/depth000000.png",
                               "slam/results/frame000001.png", "slam/results/depth000001.png"}})
SCENE_OF_PARTS(scannet, {"scannet",
                         "root: scannet",
                         {{"scannet/pose/0.txt"},
                          {"scannet/intrinsic/intrinsic_color.txt", "scannet/intrinsic/intrinsic_depth.txt"},
                          {"scannet/scannetv2-labels.combined.tsv"}},
                         {"scannet/color/0.png", "scannet/depth/0.png", "scannet/label-filt/0.png"}})
SCENE_OF_PARTS(colmap_text, {"colmap",
                             "root: colmap_text",
                             {{"colmap_text/sparse/0/cameras.txt"},
                              {"colmap_text/sparse/0/images.txt"},
                              {"colmap_text/sparse/0/points3D.txt"}},
                             {"colmap_text/images/a.png"}})

// The first byte chooses the file, the others are as they should be.
void fuzz_colmap_binary(std::string_view bytes) {
  if (bytes.empty()) return;
  const auto put_numbers = [](std::string& out, auto... values) {
    (out.append(reinterpret_cast<const char*>(&values), sizeof values), ...);
  };
  using Count = std::uint64_t;
  using Id = std::uint32_t;
  std::string cameras, images, points;
  put_numbers(cameras, Count{1}, Id{1}, std::int32_t{1}, Count{4}, Count{3}, 3.0, 3.0, 2.0, 1.5);  // PINHOLE
  put_numbers(images, Count{1}, Id{1}, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, Id{1});
  images += std::string("a.png") + '\0';
  put_numbers(images, Count{0});
  put_numbers(points, Count{0});
  const char which = bytes.front();
  bytes.remove_prefix(1);
  (which == 'c' ? cameras : which == 'p' ? points : images) = bytes;
  put("colmap/sparse/0/cameras.bin", cameras);
  put("colmap/sparse/0/images.bin", images);
  put("colmap/sparse/0/points3D.bin", points);
  put_image("colmap/images/a.png");
  open_dataset("colmap", "root: colmap");
}

// Parts: the OBJ file, the MTL file a.mtl.
void fuzz_obj(std::string_view bytes) {
  const auto parts = parts_of(bytes, 2);
  const std::string path = put("obj/a.obj", parts[0]);
  put("obj/a.mtl", parts[1]);
  accepted([&] {
    Diagnostics diagnostics;
    const TriangleMesh mesh = load_obj(path, diagnostics);
    promise(mesh.size() > 0, "an accepted mesh has no triangle");
    for (std::size_t t = 0; t < mesh.size(); ++t) {
      for (const std::uint32_t v : mesh.triangles[t]) promise(v < mesh.positions.size(), "a corner without a vertex");
      promise(mesh.material_of[t] < static_cast<std::int32_t>(mesh.materials.size()), "a material that is none");
      promise(mesh.object_of[t] < static_cast<std::int32_t>(mesh.objects.size()), "an object that is none");
      promise(mesh.group_of[t] < static_cast<std::int32_t>(mesh.groups.size()), "a group that is none");
    }
  });
}

void fuzz_packed(std::string_view bytes) {
  put("scene.pack", bytes);
  open_dataset("packed", "file: scene.pack");
  put("scene.pack", testing_room::with_pack_checksums(std::string(bytes)));
  open_dataset("packed", "file: scene.pack");
}

void fuzz_png(std::string_view bytes) {
  for (const std::string& file : {std::string(bytes), testing_room::with_png_checksums(std::string(bytes))}) {
    const auto view = std::as_bytes(std::span<const char>(file));
    accepted([&] { (void)png_size(view); });
    accepted([&] {
      const PngImage image = decode_png(view);
      const std::size_t samples = static_cast<std::size_t>(image.width_px) * static_cast<std::size_t>(image.height_px) *
                                  static_cast<std::size_t>(image.channels);
      promise((image.bits == 16 ? image.words.size() : image.bytes.size()) == samples,
              "samples that do not fill the image");
    });
    const std::string path = put("image.png", file);
    accepted([&] { (void)image_size(path); });
    accepted([&] { (void)read_rgb(path, 128); });
    accepted([&] { (void)read_ids(path); });
  }
}

}  // namespace

std::span<const Target> targets() {
  static constexpr Target kTargets[] = {
#define TARGET(name) {#name, fuzz_##name},
#include "targets.inc"
  };
  return kTargets;
}

const Target* find_target(std::string_view name) {
  const auto all = targets();
  const auto found = std::find_if(all.begin(), all.end(), [&](const Target& t) { return t.name == name; });
  return found == all.end() ? nullptr : &*found;
}

}  // namespace semfield::fuzz
