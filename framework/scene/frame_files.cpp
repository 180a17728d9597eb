// Frames kept as image files.
#include "scene/frame_files.h"

#include <cmath>
#include <filesystem>

#include "scene/image_io.h"
#include "scene/scene_checks.h"

namespace semfield {

namespace {

std::string size_text(std::int32_t width, std::int32_t height) {
  return std::to_string(width) + " x " + std::to_string(height);
}

void check_file(const FrameInfo& frame, const char* what, const std::string& path, Diagnostics& diagnostics) {
  if (path.empty()) return;
  std::error_code ignored;
  if (!std::filesystem::exists(path, ignored)) {
    diagnostics.error(frame_place(frame), std::string(what) + " '" + path + "' is missing",
                      "restore the file, or drop the frame from the index");
    return;
  }
  try {
    const ImageSize size = image_size(path);
    if (size.width_px != frame.camera.width_px || size.height_px != frame.camera.height_px) {
      diagnostics.error(frame_place(frame),
                        std::string(what) + " '" + path + "' is " + size_text(size.width_px, size.height_px) +
                            " pixels, the camera " + size_text(frame.camera.width_px, frame.camera.height_px),
                        "colour, depth and labels of a frame need the size that its camera states");
    }
  } catch (const Error& e) {
    diagnostics.error(frame_place(frame), std::string(what) + " " + e.message(), e.remedy());
  }
}

template <class T>
void check_size(const Image<T>& image, const FrameInfo& frame, const std::string& path) {
  if (image.width_px == frame.camera.width_px && image.height_px == frame.camera.height_px) return;
  throw Error(ErrorKind::data,
              "'" + path + "' is " + size_text(image.width_px, image.height_px) + " pixels, the camera " +
                  size_text(frame.camera.width_px, frame.camera.height_px),
              "colour, depth and labels of a frame need the size that its camera states");
}

void read_depth(const FrameInfo& frame, const std::string& path, double unit_m, std::vector<float>& out) {
  const std::string extension = std::filesystem::path(path).extension().string();
  if (extension == ".exr" || extension == ".tiff" || extension == ".tif" || extension == ".pfm") {
    Image<float> image = read_float(path);
    check_size(image, frame, path);
    for (float& d : image.pixels) {
      if (!std::isfinite(d) || d < 0) d = 0;
    }
    out = std::move(image.pixels);
    return;
  }
  const Image<std::uint16_t> image = read_ids(path);
  check_size(image, frame, path);
  out.resize(image.pixels.size());
  for (std::size_t i = 0; i < out.size(); ++i) {
    out[i] = image.pixels[i] == 65535 ? 0.0f : static_cast<float>(image.pixels[i] * unit_m);
  }
}

void read_labels(const FrameInfo& frame, const std::string& path, bool unknown_void, const ClassTable& classes,
                 std::vector<std::int16_t>& out) {
  const Image<std::uint16_t> image = read_ids(path);
  check_size(image, frame, path);
  out.resize(image.pixels.size());
  for (std::size_t i = 0; i < out.size(); ++i) {
    const int index = classes.index_of(image.pixels[i]);
    if (index == -2 && !unknown_void) {
      const std::size_t width = static_cast<std::size_t>(image.width_px);
      throw Error(ErrorKind::data,
                  "'" + path + "': label id " + std::to_string(image.pixels[i]) + " at x " + std::to_string(i % width) +
                      ", y " + std::to_string(i / width) + " is not in the class table",
                  "add the id to the class table, or set unknown_labels: void");
    }
    out[i] = index < 0 ? kVoid : static_cast<std::int16_t>(index);
  }
}

}  // namespace

void check_frame_files(const FrameInfo& frame, const FrameFiles& files, Diagnostics& diagnostics) {
  check_file(frame, "colour image", files.color, diagnostics);
  check_file(frame, "depth image", files.depth, diagnostics);
  check_file(frame, "label image", files.label, diagnostics);
  check_file(frame, "instance image", files.instance, diagnostics);
}

void read_frame_files(const FrameInfo& frame, const FrameFiles& files, const FrameReadRules& rules,
                      const ClassTable& classes, FrameBuffer& out) {
  try {
    out = {};
    out.width_px = frame.camera.width_px;
    out.height_px = frame.camera.height_px;
    Image<std::uint8_t> color = read_rgb(files.color, rules.alpha_background);
    check_size(color, frame, files.color);
    out.rgb = std::move(color.pixels);
    if (!files.depth.empty()) read_depth(frame, files.depth, rules.depth_unit_m, out.depth_m);
    if (!files.label.empty() && !classes.empty())
      read_labels(frame, files.label, rules.unknown_labels_void, classes, out.label);
    if (!files.instance.empty()) {
      const Image<std::uint16_t> image = read_ids(files.instance);
      check_size(image, frame, files.instance);
      out.instance.assign(image.pixels.begin(), image.pixels.end());
    }
  } catch (Error& e) {
    throw e.while_doing("frame '" + frame.name + "'");
  }
}

std::string find_class_file(const std::vector<std::string>& folders) {
  std::error_code ignored;
  for (const std::string& folder : folders) {
    for (const char* name : {"classes.yaml", "classes.yml", "classes.csv", "info_semantic.json"}) {
      const std::filesystem::path path = std::filesystem::path(folder) / name;
      if (std::filesystem::is_regular_file(path, ignored)) return path.string();
    }
  }
  return {};
}

ClassTable load_class_file(const std::string& path, const std::vector<std::string>& folders, bool has_labels,
                           Diagnostics& diagnostics) {
  const std::string found = path.empty() ? find_class_file(folders) : path;
  try {
    if (!found.empty()) {
      ClassTable table = ClassTable::load(found);
      if (has_labels && table.empty()) diagnostics.error(found, "no classes in it", "write one {id, name} a class");
      return table;
    }
  } catch (const Error& e) {
    const bool named = e.message().find(found) != std::string::npos;
    diagnostics.error(named ? "" : found, e.message(), e.remedy());
    return {};
  }
  if (has_labels) {
    diagnostics.error(
        folders.front(),
        "labels without a class table: no classes.yaml, classes.csv or info_semantic.json in the scene's folder",
        "write classes.yaml with one {id, name} a class, or set scene.classes");
  }
  return {};
}

std::string unique_frame_name(const std::string& image_path, std::set<std::string>& taken) {
  const std::filesystem::path path(image_path);
  std::string name = path.stem().string();
  if (taken.count(name) > 0) {
    name = (path.parent_path().filename() / path.stem()).string();
    for (char& c : name) c = c == '/' ? '_' : c;
  }
  const std::string base = name;
  for (int i = 2; taken.count(name) > 0; ++i) name = base + "_" + std::to_string(i);
  taken.insert(name);
  return name;
}

}  // namespace semfield
