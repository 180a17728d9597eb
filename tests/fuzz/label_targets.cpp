// Label files, class tables and what the labelling page's server is sent.
#include <algorithm>

#include "app/serve/http_server.h"
#include "app/serve/page_requests.h"
#include "config/config_tree.h"
#include "config/params.h"
#include "datasets/obj_room/obj_room.h"
#include "formats/npz.h"
#include "labels/clicks/click_log.h"
#include "labels/label_files.h"
#include "loading/depth_images.h"
#include "scene/classes/class_import.h"
#include "tests/fuzz/inputs.h"
#include "tests/fuzz/targets.h"
#include "tests/labels/label_plugins.h"

namespace semfield::fuzz {

// Label files of every reader that `scene.labels.from` offers, and NumPy arrays.

namespace {

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

}  // namespace

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
    promise((r.view >= 0) != r.camera.has_value(), "a picture of a view and of a camera");
    promise(r.at.has_value() != (r.color || r.labels || r.entropy), "neither a map nor a point, or both");
    promise(!r.at || (r.camera && r.at->x >= 0 && r.at->x <= 1 && r.at->y >= 0 && r.at->y <= 1), "a point outside");
    promise(r.most_px == 0 || (r.most_px >= 16 && r.most_px <= app::kMostPictureSide), "a picture of a wrong size");
    if (!r.camera) return;
    const Pose& pose = r.camera->world_from_camera;
    for (int a = 0; a < 3; ++a) {
      promise(std::abs(dot(pose.axis(a), pose.axis(a)) - 1) <= 1e-3, "a rotation that is none");
      promise(std::abs(pose.t[a]) <= 1e6, "a camera that is nowhere");
    }
    promise(r.camera->fov_deg >= 1 && r.camera->fov_deg <= 170, "a field of view that is none");
  });
  accepted([&] { (void)app::parse_export_request(bytes); });
  accepted([&] { promise(app::query_number(bytes, "view", 3, 100) <= 100, "a number above its bound"); });
}

// As what a connection brings: the same requests come out, however the bytes are cut.
void fuzz_http(std::string_view bytes) {
  constexpr std::size_t kMostBody = 64;
  const auto requests = [&](std::size_t piece) {
    app::HttpReader reader(kMostBody);
    std::string told;
    for (std::size_t at = 0; at < bytes.size(); at += piece) {
      reader.take(bytes.substr(at, piece));
      for (; reader.state() == app::HttpReader::State::whole; reader.next()) {
        const app::HttpRequest& r = reader.request();
        promise(r.body.size() <= kMostBody, "a body above its bound");
        promise(r.header_count("content-length") + r.header_count("transfer-encoding") <= 1, "a body of two lengths");
        told += r.method + ' ' + r.path + '?' + r.query + ' ' + (reader.keeps() ? "keeps" : "ends");
        for (const auto& [name, value] : r.headers) told += '\n' + name + ": " + value;
        told += "\n\n" + r.body + '\n';
      }
      if (reader.state() != app::HttpReader::State::refused) continue;
      promise(reader.status() == 400 || reader.status() == 413, "a refusal without a status");
      return told + "refused: " + reader.complaint();
    }
    return told;
  };
  const std::string whole = requests(std::max<std::size_t>(bytes.size(), 1));
  for (const std::size_t piece : {1, 3, 17})
    promise(requests(piece) == whole, "a request that depends on how it is cut");
}
}  // namespace semfield::fuzz
