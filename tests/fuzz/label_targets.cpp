// Label files of every reader that `scene.labels.from` offers, and NumPy arrays.
#include <cstdint>
#include <string>

#include "config/config_tree.h"
#include "config/params_read.h"
#include "formats/npz.h"
#include "labels/clicks/label_event.h"
#include "labels/label_steps.h"
#include "tests/fuzz/inputs.h"
#include "tests/fuzz/targets.h"
#include "tests/labels/label_plugins.h"

namespace semfield::fuzz {

namespace {

// Opens with and without a class table and reads the labels of one frame, 'a' of 4 x 3 pixels.
void read_labels(std::string_view type, const std::string& yaml) {
  const ClassTable room(
      {{0, "void", {0, 0, 0}, true}, {1, "wall", {10, 20, 30}, false}, {4, "chair", {40, 50, 60}, false}});
  FrameInfo frame;
  frame.name = "a";
  frame.source = "/nowhere/a.png";
  frame.camera.width_px = 4;
  frame.camera.height_px = 3;
  for (const ClassTable& known : {room, ClassTable()}) {
    const std::unique_ptr<LabelReader> reader = testing_labels::make_reader(std::string(type), yaml);
    accepted([&] {
      Diagnostics diagnostics;
      const ClassTable own = reader->open(known, diagnostics);
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
  put("npy/classes.json", R"(["wall", "chair"])");
  read_labels("npz", "{folder: " + folder() + "/npy, pattern: \"{name}.npy\"}");
}

// Parts: the archive, classes.json; the order of the two is that which lets the archive hold any bytes.
void fuzz_npz(std::string_view bytes) {
  const auto parts = parts_of(bytes, 2);
  put("npz/classes.json", parts[0]);
  const std::string path = put("npz/a.npz", parts[1]);
  accepted([&] {
    for (const std::string& key : npz_keys(path)) accepted([&] { (void)read_npz(path, key, {}); });
  });
  read_labels("npz", "{folder: " + folder() + "/npz, confidence_key: confidence}");
}

}  // namespace semfield::fuzz
