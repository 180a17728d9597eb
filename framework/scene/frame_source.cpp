// Loading a scene: open, read in parallel, scale, count.
#include "scene/frame_source.h"

#include <algorithm>
#include <cmath>
#include <optional>
#include <set>

#include "core/check.h"
#include "core/parallel.h"
#include "scene/image_io.h"
#include "scene/scene_checks.h"

namespace semfield {

namespace {

// Nearest source pixel of target pixel i: the one that holds its centre.
std::vector<std::size_t> nearest(std::int32_t source, std::int32_t target) {
  std::vector<std::size_t> out(static_cast<std::size_t>(target));
  for (std::int64_t i = 0; i < target; ++i) {
    out[static_cast<std::size_t>(i)] = static_cast<std::size_t>((2 * i + 1) * source / (2 * std::int64_t{target}));
  }
  return out;
}

template <class T>
std::vector<T> pick(const std::vector<T>& in, std::int32_t width, const std::vector<std::size_t>& cols,
                    const std::vector<std::size_t>& rows) {
  if (in.empty()) return {};
  std::vector<T> out;
  out.reserve(cols.size() * rows.size());
  for (const std::size_t y : rows) {
    const T* row = in.data() + y * static_cast<std::size_t>(width);
    for (const std::size_t x : cols) out.push_back(row[x]);
  }
  return out;
}

std::string size_text(std::int32_t width, std::int32_t height) {
  return std::to_string(width) + " x " + std::to_string(height);
}

void check_buffer(const FrameBuffer& b, const FrameInfo& f) {
  const std::size_t pixels = static_cast<std::size_t>(f.camera.width_px) * static_cast<std::size_t>(f.camera.height_px);
  const auto fits = [pixels](std::size_t size, bool wanted) { return size == (wanted ? pixels : 0); };
  if (b.width_px != f.camera.width_px || b.height_px != f.camera.height_px || b.rgb.size() != pixels * 3 ||
      !fits(b.depth_m.size(), f.has_depth) || !fits(b.label.size(), f.has_labels) ||
      !fits(b.instance.size(), f.has_instances)) {
    throw Error(ErrorKind::internal, "dataset delivered other channels or sizes than open() told",
                "this is a defect of the dataset plugin");
  }
}

}  // namespace

void describe(ParamVisitor& visit, SceneLoadOptions& p) {
  SEMFIELD_PARAM(visit, p, width_px, "width to load frames at, pixels; 0 = as stored, or in proportion to height_px",
                 {0, 16384});
  SEMFIELD_PARAM(visit, p, height_px, "height to load frames at, pixels; 0 = as stored, or in proportion to width_px",
                 {0, 16384});
  SEMFIELD_PARAM(visit, p, downscale, "divides width and height of every frame", {1, 64});
  SEMFIELD_PARAM(visit, p, near_m,
                 "nearest distance along a ray that is sampled, metres; 0 = from the dataset or derived", {0, 1e6});
  SEMFIELD_PARAM(visit, p, far_m,
                 "farthest distance along a ray that is sampled, metres; 0 = from the dataset or derived", {0, 1e6});
  SEMFIELD_PARAM(visit, p, bounds, "world box of the content, metres: [x0, y0, z0, x1, y1, z1]; empty = derived",
                 {-1e7, 1e7});
}

void validate(const SceneLoadOptions& p, Diagnostics& diagnostics) {
  if (p.downscale != 1 && (p.width_px > 0 || p.height_px > 0)) {
    diagnostics.error("scene.downscale", "downscale and width_px or height_px exclude each other", "keep one of them");
  }
  if (p.near_m > 0 && p.far_m > 0 && p.near_m >= p.far_m)
    diagnostics.error("scene.near_m", "near_m must be below far_m", "swap them");
  if (!p.bounds.empty() && p.bounds.size() != 6) {
    diagnostics.error("scene.bounds", "expected 6 numbers, got " + std::to_string(p.bounds.size()),
                      "write [x0, y0, z0, x1, y1, z1]");
  }
  for (std::size_t i = 0; i < 3 && p.bounds.size() == 6; ++i) {
    if (!(p.bounds[i] < p.bounds[i + 3]))
      diagnostics.error("scene.bounds", "the first corner must be below the second on every axis", "swap them");
  }
}

bool scaled_camera(const Camera& camera, const SceneLoadOptions& options, Camera& out) {
  double width = camera.width_px / options.downscale, height = camera.height_px / options.downscale;
  if (options.width_px > 0) width = options.width_px;
  if (options.height_px > 0) height = options.height_px;
  if (options.width_px > 0 && options.height_px == 0) height = width * camera.height_px / camera.width_px;
  if (options.height_px > 0 && options.width_px == 0) width = height * camera.width_px / camera.height_px;
  const auto w = static_cast<std::int32_t>(std::max(1L, std::lround(width)));
  const auto h = static_cast<std::int32_t>(std::max(1L, std::lround(height)));
  if (w > camera.width_px || h > camera.height_px) return false;
  out = camera.resized(w, h);
  return true;
}

FrameBuffer resize_frame(const FrameBuffer& frame, std::int32_t width, std::int32_t height) {
  if (width == frame.width_px && height == frame.height_px) return frame;
  FrameBuffer out;
  out.width_px = width;
  out.height_px = height;
  out.rgb = resize_area({frame.width_px, frame.height_px, 3, frame.rgb}, width, height).pixels;
  const std::vector<std::size_t> cols = nearest(frame.width_px, width), rows = nearest(frame.height_px, height);
  out.depth_m = pick(frame.depth_m, frame.width_px, cols, rows);
  out.label = pick(frame.label, frame.width_px, cols, rows);
  out.instance = pick(frame.instance, frame.width_px, cols, rows);
  return out;
}

std::vector<int> LoadedScene::frames_of(Split split) const {
  std::vector<int> out;
  for (std::size_t i = 0; i < info.frames.size(); ++i) {
    if (info.frames[i].split == split) out.push_back(static_cast<int>(i));
  }
  return out;
}

void count_class_pixels(LoadedScene& scene) {
  const auto classes = static_cast<std::size_t>(scene.info.classes.valid_count());
  scene.class_pixels.assign(scene.frames.size(), {});
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    if (scene.frames[i].label.empty()) continue;
    std::vector<std::int64_t>& counts = scene.class_pixels[i];
    counts.assign(classes + 1, 0);
    for (const std::int16_t c : scene.frames[i].label) ++counts[c < 0 ? classes : static_cast<std::size_t>(c)];
  }
}

LoadedScene load_scene(const SceneReader& reader, const SceneLoadOptions& options, Diagnostics& diagnostics) {
  LoadedScene scene;
  validate(options, diagnostics);
  scene.info = reader.open(diagnostics);
  std::vector<FrameInfo>& frames = scene.info.frames;
  if (frames.empty() && !diagnostics.has_errors())
    diagnostics.error(scene.info.name, "the scene has no frames", "check the path");
  scene.frames.resize(frames.size());

  // A frame whose files already failed a check would only fail again.
  std::set<std::string> failed;
  for (const Diagnostic& d : diagnostics.all()) {
    if (d.severity == Severity::error) failed.insert(d.where);
  }
  std::vector<std::optional<Error>> errors(frames.size());
  bool stretched = false;
  std::vector<Camera> cameras(frames.size());
  for (std::size_t i = 0; i < frames.size(); ++i) {
    const std::string place = frame_place(frames[i]);
    if (failed.count(place) > 0) continue;
    if (!scaled_camera(frames[i].camera, options, cameras[i])) {
      diagnostics.error(place,
                        "frame is " + size_text(frames[i].camera.width_px, frames[i].camera.height_px) +
                            " pixels, smaller than the size asked for",
                        "ask for at most the stored size");
      continue;
    }
    const double stretch = cameras[i].fx / frames[i].camera.fx * frames[i].camera.fy / cameras[i].fy;
    stretched = stretched || std::abs(stretch - 1) > 0.01;
  }
  if (stretched)
    diagnostics.warning("scene.width_px", "the size asked for changes the aspect ratio; cameras follow it",
                        "give width_px or height_px alone");

  parallel_for(static_cast<std::int64_t>(frames.size()), [&](std::int64_t index) {
    const auto i = static_cast<std::size_t>(index);
    if (cameras[i].width_px == 0) return;
    try {
      FrameBuffer whole;
      reader.read(static_cast<int>(i), whole);
      check_buffer(whole, frames[i]);
      if (!options.with_instances) whole.instance = {};
      const bool same = cameras[i].width_px == whole.width_px && cameras[i].height_px == whole.height_px;
      scene.frames[i] = same ? std::move(whole) : resize_frame(whole, cameras[i].width_px, cameras[i].height_px);
    } catch (const Error& e) {
      errors[i] = e;
    }
  });
  for (std::size_t i = 0; i < frames.size(); ++i) {
    if (errors[i]) diagnostics.error(frame_place(frames[i]), errors[i]->message(), errors[i]->remedy());
    if (cameras[i].width_px > 0) frames[i].camera = cameras[i];
    if (!options.with_instances) frames[i].has_instances = false;
  }
  count_class_pixels(scene);
  derive_extent(scene, options, diagnostics);
  if (!options.with_depth) {
    for (std::size_t i = 0; i < frames.size(); ++i) {
      scene.frames[i].depth_m = {};
      frames[i].has_depth = false;
    }
  }
  return scene;
}

}  // namespace semfield
