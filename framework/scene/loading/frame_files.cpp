// Frames kept as image files.
#include "scene/loading/frame_files.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/check.h"
#include "core/files.h"
#include "formats/npz.h"

namespace semfield {

namespace {

template <class T>
void check_size(const Image<T>& image, const Camera& camera, const std::string& path) {
  if (image.width_px == camera.width_px && image.height_px == camera.height_px) return;
  throw Error(ErrorKind::data, "scene.image.size",
              fmt::format("'{}' is {} pixels, the camera {}", path, size_text(image.width_px, image.height_px),
                          size_text(camera.width_px, camera.height_px)),
              "colour, depth and labels of a frame need the size that its camera states");
}

// Ids of the pixels as the colour image stores them. `file` gets the size at which the file holds them.
Image<std::uint16_t> read_frame_ids(const FrameInfo& frame, const std::string& path, bool of_any_size,
                                    ImageSize& file) {
  const Camera& c = frame.camera;
  Image<std::uint16_t> image = read_ids(path);
  file = {c.width_px, c.height_px};
  if (of_any_size) {
    file = {image.width_px, image.height_px};
    return {c.width_px, c.height_px, 1, at_nearest_pixels(image.pixels, file, {c.width_px, c.height_px})};
  }
  check_size(image, shown_camera(frame), path);
  return {c.width_px, c.height_px, 1, as_stored(std::move(image.pixels), c.width_px, c.height_px, frame.orientation)};
}

void read_labels(const FrameInfo& frame, const std::string& path, const FrameReadRules& rules,
                 const ClassTable& classes, std::vector<std::int16_t>& out) {
  ImageSize file;
  const Image<std::uint16_t> image = read_frame_ids(frame, path, rules.labels_of_any_size, file);
  // As nearest_pixels: the pixel of the file that one was read at.
  const auto in_file = [&](std::size_t i) {
    const auto at = static_cast<std::int64_t>(i), width = std::int64_t{image.width_px};
    return pixel_at((2 * (at % width) + 1) * file.width_px / (2 * width),
                    (2 * (at / width) + 1) * file.height_px / (2 * std::int64_t{image.height_px}), file.width_px);
  };
  const bool raw = !rules.class_of_raw.empty();
  out.resize(image.pixels.size());
  UnknownValues unknown;
  for (std::size_t i = 0; i < out.size(); ++i) {
    const std::uint16_t id = image.pixels[i];
    const int index = raw ? rules.class_of_raw[id] : classes.index_of(id);
    if (index == -2 && rules.unknown_labels == UnknownLabels::error)
      unknown.try_emplace(std::to_string(id), in_file(i));
    out[i] = index < 0 ? kVoid : static_cast<std::int16_t>(index);
  }
  if (!unknown.empty())
    throw UnknownLabelError(
        raw ? "raw id" : "label id", std::move(unknown), path, file.width_px,
        "add what is missing to the class table, or read it as void with --set scene.unknown_labels=void");
}

// The pixel of a second lens, of focal length f2 and centre c2, that sees the centre of each of `to` pixels of a first
// one (f1, c1); -1 outside its `from` pixels.
std::vector<std::int64_t> by_ray(double f2, double c2, std::int32_t from, double f1, double c1, std::int32_t to) {
  std::vector<std::int64_t> out;
  for (std::int32_t i = 0; i < to; ++i) {
    const double at = std::floor(f2 * (i + 0.5 - c1) / f1 + c2);
    out.push_back(at >= 0 && at < from ? static_cast<std::int64_t>(at) : -1);
  }
  return out;
}

// [H * W] of the colour camera.
std::vector<float> read_frame_depth(const Camera& color, const std::string& path, const FrameReadRules& rules) {
  Image<float> depth = read_depth(path, rules.depth_unit_m);
  if (!rules.confidence.empty()) {
    const Image<std::uint16_t> confidence = read_ids(rules.confidence);
    if (confidence.pixels.size() != depth.pixels.size())
      throw Error(
          ErrorKind::data, "scene.image.size",
          fmt::format("'{}' is {} pixels, its depth {}", rules.confidence,
                      size_text(confidence.width_px, confidence.height_px), size_text(depth.width_px, depth.height_px)),
          "export the recording again, or set scene.least_confidence=low");
    for (std::size_t p = 0; p < depth.pixels.size(); ++p)
      if (confidence.pixels[p] < rules.least) depth.pixels[p] = 0;
  }
  if (rules.depth == DepthGrid::apart) return drawn_depth(depth, rules.depth_camera, color);
  if (rules.depth == DepthGrid::picture)
    return at_nearest_pixels(depth.pixels, {depth.width_px, depth.height_px}, {color.width_px, color.height_px});
  if (rules.depth == DepthGrid::image) {
    check_size(depth, color, path);
    return std::move(depth.pixels);
  }
  const Camera& lens = rules.depth_camera.camera;
  const auto rows = by_ray(lens.fy, lens.cy, depth.height_px, color.fy, color.cy, color.height_px),
             cols = by_ray(lens.fx, lens.cx, depth.width_px, color.fx, color.cx, color.width_px);
  std::vector<float> out;
  out.reserve(rows.size() * cols.size());
  for (const std::int64_t row : rows)
    for (const std::int64_t col : cols)
      out.push_back(row < 0 || col < 0 ? 0.0f : depth.pixels[pixel_at(col, row, depth.width_px)]);
  return out;
}

// The pixels that a mask lets count [H * W], 0 = masked: those that are not black, or, of a JPEG, whose blacks are not
// exact, not dark.
Image<std::uint8_t> read_mask(const std::string& path) {
  const Image<std::uint8_t> image = read_rgb(path);
  const std::string extension = fs::path(path).extension().string();
  const std::uint8_t least = extension == ".jpg" || extension == ".jpeg" ? 128 : 1;
  Image<std::uint8_t> out{image.width_px, image.height_px, 1, std::vector<std::uint8_t>(image.pixels.size() / 3)};
  for (std::size_t i = 0; i < out.pixels.size(); ++i) {
    const std::uint8_t* const p = &image.pixels[3 * i];
    out.pixels[i] = std::max({p[0], p[1], p[2]}) >= least ? 1 : 0;
  }
  return out;
}

}  // namespace

Camera shown_camera(const FrameInfo& frame) {
  Camera camera = frame.camera;
  if (turned_by_quarter(frame.orientation)) std::swap(camera.width_px, camera.height_px);
  return camera;
}

void require_folder(const fs::path& folder, const std::string& remedy) {
  if (!fs::is_directory(folder))  // which throws for what cannot be looked at, and so is not missing
    throw Error(ErrorKind::no_input, "files.folder.missing", "folder '" + folder.string() + "' is missing", remedy);
}

std::string in_folder(const fs::path& folder, const std::string& name) {
  return fs::is_directory(folder) ? (folder / name).string() : "";
}

std::string ending_of(const std::string& path) { return lower_case(fs::path(path).extension().string()); }

std::vector<std::string> files_with(const std::string& folder, std::span<const std::string_view> extensions) {
  std::vector<std::string> found;
  if (!is_folder(folder)) return found;
  for (const fs::directory_entry& entry : sorted_folder(folder)) {
    if (entry.path().filename().string().starts_with(kMovingMask)) continue;
    if (std::find(extensions.begin(), extensions.end(), ending_of(entry.path().string())) != extensions.end())
      found.push_back(entry.path().string());
  }
  return found;
}

std::map<std::int64_t, std::string> numbered_photographs(const std::string& folder, Diagnostics& diagnostics) {
  std::map<std::int64_t, std::string> out;
  for (const std::string& path : files_with(folder, kPhotographs)) {
    std::int64_t number = 0;
    if (!parse_whole(fs::path(path).stem().string(), number) || number < 0 || number > 1'000'000'000) {
      diagnostics.error("scene.frame.name", "'" + path + "'", "the name is not a frame's number",
                        "name colour images <id>.jpg or <id>.png");
    } else if (const auto [other, fresh] = out.emplace(number, path); !fresh) {
      diagnostics.error("scene.frame.twice", "'" + path + "'", "is the same frame as '" + other->second + "'",
                        "keep one of the two");
    }
  }
  return out;
}

void read_frame_files(const FrameInfo& frame, const FrameFiles& files, const FrameReadRules& rules,
                      const ClassTable& classes, FrameBuffer& out) {
  try {
    out = {};
    out.width_px = frame.camera.width_px;
    out.height_px = frame.camera.height_px;
    std::vector<std::uint8_t> alpha;
    const bool wants_alpha = rules.alpha || rules.alpha_masks;
    Image<std::uint8_t> color = read_rgb(files.color, rules.alpha_background, wants_alpha ? &alpha : nullptr);
    check_size(color, frame.camera, files.color);
    out.rgb = std::move(color.pixels);
    for (const auto& [path, masked] : {std::pair{&files.mask, 0}, std::pair{&files.moving, 1}}) {
      if (path->empty()) continue;
      const Image<std::uint8_t> mask = read_mask(*path);
      check_size(mask, frame.camera, *path);
      if (out.used.empty()) out.used.assign(mask.pixels.size(), 1);
      for (std::size_t i = 0; i < out.used.size(); ++i) out.used[i] = mask.pixels[i] == masked ? 0 : out.used[i];
    }
    if (rules.alpha_masks && std::any_of(alpha.begin(), alpha.end(), [](std::uint8_t a) { return a != 255; })) {
      if (out.used.empty()) out.used.assign(alpha.size(), 1);
      for (std::size_t i = 0; i < alpha.size(); ++i) out.used[i] = alpha[i] == 255 ? out.used[i] : 0;
    }
    if (rules.alpha) out.channels.push_back(alpha_channel(color.width_px, color.height_px, alpha));
    if (!files.depth.empty()) out.depth_m = read_frame_depth(frame.camera, files.depth, rules);
    if (!files.label.empty() && !classes.empty()) read_labels(frame, files.label, rules, classes, out.label);
    if (!files.instance.empty()) {
      ImageSize file;
      const Image<std::uint16_t> image = read_frame_ids(frame, files.instance, rules.labels_of_any_size, file);
      out.instance.assign(image.pixels.begin(), image.pixels.end());
    }
  } catch (Error& e) {
    e.while_doing("frame '" + frame.name + "'");
    throw;  // not a copy: an UnknownLabelError stays one
  }
}

std::string with_slashes(std::string path) {
  std::replace(path.begin(), path.end(), '\\', '/');
  return path;
}

const std::string* FileNames::looks_like(const std::string& folder, const std::string& name) {
  const auto [found, fresh] = folders_.try_emplace(folder);
  if (fresh) {
    std::error_code unknown;
    for (fs::directory_iterator it(folder.empty() ? "." : folder, unknown), end; !unknown && it != end;
         it.increment(unknown)) {
      const std::string entry = it->path().filename().string();
      const auto [other, first] = found->second.emplace(decomposed(entry), entry);
      if (!first) other->second.clear();
    }
  }
  const auto entry = found->second.find(decomposed(name));
  return entry == found->second.end() || entry->second.empty() ? nullptr : &entry->second;
}

std::string FileNames::of(const std::string& path) {
  if (path.empty() || is_there(path)) return path;
  const std::string slashed = with_slashes(path);
  const bool ascii = std::all_of(slashed.begin(), slashed.end(), [](char c) { return (c & 0x80) == 0; });
  if (ascii || is_there(slashed)) return slashed;
  fs::path found;
  for (const fs::path& part : fs::path(slashed)) {
    const fs::path next = found / part;
    if (is_there(next.string())) {
      found = next;
      continue;
    }
    const std::string* const other = looks_like(found.string(), part.string());
    if (other == nullptr) return slashed;
    found /= *other;
  }
  return found.string();
}

namespace {

// [height, width] of the array, whose other axes have one place.
std::vector<std::int64_t> plane_of(std::span<const std::int64_t> shape) {
  std::vector<std::int64_t> plane;
  for (const std::int64_t axis : shape)
    if (axis != 1 || shape.size() == 2) plane.push_back(axis);
  if (plane.size() != 2)
    throw Error(ErrorKind::data, "scene.depth.shape", "the shape is " + shape_text(shape),
                "save depth as an array [height, width]");
  check_image_limits(plane[1], plane[0], 1, sizeof(float));
  return plane;
}

Image<float> read_depth_array(const std::string& path, double unit_m) {
  const NumpyValues array = read_npy_values(path, [](std::span<const std::int64_t> shape) { (void)plane_of(shape); });
  const std::vector<std::int64_t> plane = plane_of(array.shape);
  Image<float> out{static_cast<std::int32_t>(plane[1]), static_cast<std::int32_t>(plane[0]), 1, {}};
  out.pixels.reserve(array.values.size());
  const double ceiling = array.is_whole && array.element_bytes == 2 ? 65535 : std::numeric_limits<float>::max();
  for (const double value : array.values)
    out.pixels.push_back(value > 0 && value < ceiling ? static_cast<float>(value * (array.is_whole ? unit_m : 1)) : 0);
  return out;
}

}  // namespace

// A TIFF holds integers or real numbers, which have 32 bits.
bool has_real_depth(const std::string& path) {
  const std::string ending = ending_of(path);
  if (ending == ".npy") return !npy_is_whole(path);
  if (ending == ".tif" || ending == ".tiff") return image_size(path).bits > 16;
  return ending == ".exr" || ending == ".pfm";
}

ImageSize depth_size(const std::string& path) {
  if (ending_of(path) != ".npy") return image_size(path);
  return naming(path, [&]() -> ImageSize {
    const std::vector<std::int64_t> plane = plane_of(npy_shape(path));
    return {static_cast<std::int32_t>(plane[1]), static_cast<std::int32_t>(plane[0]), 1, 32};
  });
}

Image<float> read_depth(const std::string& path, double unit_m) {
  if (ending_of(path) == ".npy") return read_depth_array(path, unit_m);
  if (has_real_depth(path)) {
    Image<float> out = read_float(path);
    for (float& d : out.pixels)
      if (!std::isfinite(d) || d < 0) d = 0;
    return out;
  }
  const Image<std::uint16_t> image = read_ids(path);
  Image<float> out{image.width_px, image.height_px, 1, std::vector<float>(image.pixels.size())};
  for (std::size_t i = 0; i < out.pixels.size(); ++i)
    out.pixels[i] = image.pixels[i] == 65535 ? 0.0f : static_cast<float>(image.pixels[i] * unit_m);
  return out;
}

namespace {

constexpr double kEdge = 0.04;    // relative step of depth between neighbours
constexpr double kWidest = 1000;  // pixels of the colour image that a facet covers at most: beyond, the lens folds

struct Corner {
  double u = 0, v = 0, depth = 0;  // in the colour image; depth 0: not seen there
  double taken = 0;                // as the depth camera took it
};

// Draws pixel centres within the triangle; inverse depth is linear in the image of a pinhole.
void draw_triangle(Image<float>& out, const Corner& a, const Corner& b, const Corner& c) {
  const double least = std::min({a.taken, b.taken, c.taken}), most = std::max({a.taken, b.taken, c.taken});
  if (!(least > 0) || !(a.depth > 0) || !(b.depth > 0) || !(c.depth > 0) || most - least > kEdge * least) return;
  const double area = (b.u - a.u) * (c.v - a.v) - (c.u - a.u) * (b.v - a.v);
  const double u0 = std::min({a.u, b.u, c.u}), u1 = std::max({a.u, b.u, c.u});
  const double v0 = std::min({a.v, b.v, c.v}), v1 = std::max({a.v, b.v, c.v});
  if (area == 0 || !(u1 - u0 < kWidest) || !(v1 - v0 < kWidest)) return;
  const auto first = [](double at) { return std::max(0.0, std::ceil(at - 0.5)); };
  const auto last = [](double at, std::int32_t size) { return std::min(size - 1.0, std::floor(at - 0.5)); };
  for (double y = first(v0); y <= last(v1, out.height_px); ++y) {
    for (double x = first(u0); x <= last(u1, out.width_px); ++x) {
      const double u = x + 0.5, v = y + 0.5;
      const double wb = ((u - a.u) * (c.v - a.v) - (c.u - a.u) * (v - a.v)) / area;
      const double wc = ((b.u - a.u) * (v - a.v) - (u - a.u) * (b.v - a.v)) / area;
      if (wb < -1e-9 || wc < -1e-9 || wb + wc > 1 + 1e-9) continue;
      const double at = 1 / ((1 - wb - wc) / a.depth + wb / b.depth + wc / c.depth);
      float& here = out.pixels[pixel_at(static_cast<std::int64_t>(x), static_cast<std::int64_t>(y), out.width_px)];
      if (here == 0 || at < static_cast<double>(here)) here = static_cast<float>(at);
    }
  }
}

}  // namespace

std::vector<float> drawn_depth(const Image<float>& depth, const DepthCamera& from, const Camera& color) {
  SEMFIELD_CHECK(depth.width_px == from.camera.width_px && depth.height_px == from.camera.height_px,
                 "the depth image has another size than its camera");
  const auto corner = [&](std::int32_t x, std::int32_t y) {
    Corner out;
    const auto taken = static_cast<double>(depth.at(x, y));
    const Vec3d ray = from.camera.direction(x + 0.5, y + 0.5);
    const double per_distance = from.camera.depth_of(ray);
    if (!(taken > 0) || !(per_distance > 0)) return out;
    const Vec3d p = from.depth_from_color.apply_inverse(ray * (taken / per_distance));
    if (!color.sees(p) || !color.is_within_lens(p)) return out;
    color.project(p, out.u, out.v);
    out.depth = color.depth_of(p);
    out.taken = taken;
    return out;
  };
  Image<float> out{color.width_px, color.height_px, 1,
                   std::vector<float>(pixel_at(0, color.height_px, color.width_px))};
  std::vector<Corner> above, row;
  for (std::int32_t y = 0; y < depth.height_px; ++y) {
    row.clear();
    for (std::int32_t x = 0; x < depth.width_px; ++x) row.push_back(corner(x, y));
    for (std::size_t x = 0; y > 0 && x + 1 < row.size(); ++x) {
      const std::array<const Corner*, 4> quad{&above[x], &above[x + 1], &row[x + 1], &row[x]};
      // Along the diagonal whose ends are nearer to each other in depth; with a corner missing, what is left.
      const bool falling = std::abs(quad[0]->taken - quad[2]->taken) <= std::abs(quad[1]->taken - quad[3]->taken);
      const std::size_t turn =
          (quad[1]->taken > 0 && quad[3]->taken > 0 && (!falling || quad[0]->taken == 0 || quad[2]->taken == 0)) ? 1
                                                                                                                 : 0;
      const auto at = [&](std::size_t k) -> const Corner& { return *quad[(k + turn) % 4]; };
      draw_triangle(out, at(0), at(1), at(2));
      draw_triangle(out, at(0), at(2), at(3));
    }
    above.swap(row);
  }
  return std::move(out.pixels);
}

std::vector<fs::path> folders_like(const fs::path& folder, const fs::path& image) {
  std::vector<fs::path> tails, singles;
  fs::path tail;
  for (fs::path at = image.parent_path(); tails.size() < 3 && at.has_filename(); at = at.parent_path()) {
    tail = tail.empty() ? at.filename() : at.filename() / tail;
    if (!tails.empty()) singles.push_back(folder / at.filename());
    tails.insert(tails.begin(), folder / tail);
  }
  tails.insert(tails.end(), singles.begin(), singles.end());
  tails.push_back(folder);
  return tails;
}

}  // namespace semfield
