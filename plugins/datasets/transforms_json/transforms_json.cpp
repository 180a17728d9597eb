// transforms.json scenes.
#include "datasets/transforms_json/transforms_json.h"

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <map>

#include "formats/image_io.h"
#include "formats/input_limits.h"
#include "formats/npz.h"
#include "loading/camera_fit.h"
#include "loading/depth_images.h"
#include "loading/frame_masks.h"
#include "plugin/module.h"
#include "scene/alpha.h"
#include "scene/frame_split.h"
#include "scene/scene_checks.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {
constexpr std::int64_t kMostChannelCells = 1 << 20;  // of one axis
}

void describe(ParamVisitor& visit, TransformsJsonParams& p) {
  SEMFIELD_PARAM(
      visit, p, root,
      "folder with transforms.json (or Blender's transforms_train.json and transforms_test.json), or the file itself");
  SEMFIELD_PARAM(visit, p, test_every,
                 "every N-th frame, by name, is held out for tests where the index names no test frame; 0 = none",
                 {0, 1e6});
  SEMFIELD_PARAM(visit, p, label_key, "key of a frame that names its label image; empty = no labels");
  SEMFIELD_PARAM(visit, p, classes, "class table (.yaml, .csv, .json); empty = the file's own, or the one next to it");
  SEMFIELD_PARAM(visit, p, unknown_labels, "how a label id outside the class table is read: as an error, or as void");
  SEMFIELD_PARAM(visit, p, missing, kMissingSentence);
  SEMFIELD_PARAM(visit, p, depth_unit_m, "metres of one step of a depth image; 0 = what the file says, else 0.001",
                 {0, 1000});
  SEMFIELD_PARAM(visit, p, alpha_background, "grey that shows through transparent pixels, 0 to 255; -1 = drop alpha",
                 {-1, 255});
  SEMFIELD_PARAM(visit, p, alpha_masks,
                 "transparent pixels are missing data and are masked; else they show alpha_background, as empty space");
  SEMFIELD_PARAM(visit, p, masks, kMasksSentence);
  SEMFIELD_PARAM(visit, p, metric, "poses are in metres (they are taken to be when the scene has depth)");
  SEMFIELD_PARAM(
      visit, p, channels,
      "further channels by name, which losses may read: the key NAME_path of a frame names a .npy of [h, w, k] "
      "numbers, whose grid covers the image");
}

// Its grid; nothing but the header is read.
FrameChannelInfo channel_info(const std::string& name, const std::string& file) {
  const std::vector<std::int64_t> shape = npy_shape(file);
  const bool fits = shape.size() == 3 && std::all_of(shape.begin(), shape.end(),
                                                     [](std::int64_t n) { return n > 0 && n <= kMostChannelCells; });
  if (!fits)
    throw Error(
        ErrorKind::data, "scene.channel.shape",
        "'" + file + "': the shape of a channel is [height, width, numbers of a cell], got " + shape_text(shape),
        "write a .npy with three axes");
  return {name, static_cast<std::int32_t>(shape[0]), static_cast<std::int32_t>(shape[1]),
          static_cast<std::int32_t>(shape[2])};
}

void validate(const TransformsJsonParams& p, Diagnostics& diagnostics) {
  if (p.root.empty())
    diagnostics.error("scene.root.unnamed", "root", "the scene's folder is not given", "set scene.root");
  check_test_every(p.test_every, diagnostics);
}

std::string recognise(const std::string& path, TransformsJsonParams& p) {
  std::error_code ignored;
  const fs::path file(path);
  p.root = path;
  if (fs::is_regular_file(file, ignored) && file.extension() == ".json" &&
      file.filename().string().starts_with("transforms")) {
    // The usual names stand for the whole folder, whose other file may hold the tests.
    const std::string name = file.filename().string();
    if (name == "transforms.json" || name == "transforms_train.json") p.root = file.parent_path().string();
    return name;
  }
  for (const char* name : {"transforms.json", "transforms_train.json"}) {
    if (fs::is_regular_file(file / name, ignored)) return name;
  }
  return "";
}

TransformsJson::TransformsJson(const TransformsJsonParams& params, const DatasetBuild& build)
    : params_(params), root_((fs::path(build.config_dir) / params.root).string()) {
  if (!params.classes.empty()) class_file_ = (fs::path(build.config_dir) / params.classes).string();
}

namespace {

// Pixel centres at +0.5 already; fx from fl_x or fx = (w / 2) / tan(angle / 2).
Camera camera_of(const TransformsLens& lens, std::int32_t width, std::int32_t height) {
  const auto from_angle = [](double size, double angle) {
    return angle > 0 && angle < M_PI ? 0.5 * size / std::tan(0.5 * angle) : 0.0;
  };
  Camera c;
  c.width_px = width;
  c.height_px = height;
  c.lens = lens.kind;
  if (lens.kind == LensKind::equirectangular) {
    // Focal lengths of nerfstudio's panoramas are half the width and the height; ours are pixels per radian.
    c.fx = (lens.fl_x != 0 ? lens.fl_x : 0.5 * width) / M_PI;
    c.fy = (lens.fl_y != 0 ? lens.fl_y : height) / M_PI;
    c.cx = lens.cx.value_or(0.5 * width);
    c.cy = lens.cy.value_or(0.5 * height);
    return c;
  }
  c.fx = lens.fl_x != 0 ? lens.fl_x : from_angle(width, lens.camera_angle_x);
  c.fy = lens.fl_y != 0                               ? lens.fl_y
         : lens.camera_angle_y != 0 && lens.fl_x == 0 ? from_angle(height, lens.camera_angle_y)
                                                      : c.fx;
  c.cx = lens.cx.value_or(0.5 * width);
  c.cy = lens.cy.value_or(0.5 * height);
  c.k1 = lens.k1;
  c.k2 = lens.k2;
  c.k3 = lens.k3;
  c.k4 = lens.k4;
  c.p1 = lens.p1;
  c.p2 = lens.p2;
  return c;
}

// How large an image may be is for `limits` to say; here it has to be a size at all.
bool whole_size(double value) { return value >= 1 && value <= 2147483647.0 && value == std::floor(value); }

// What cannot be read is reported with the headers.
bool is_real(const std::string& depth) {
  try {
    return has_real_depth(depth);
  } catch (const Error&) {
    return false;
  }
}

// The camera of one frame; the image's header tells the size where the file does not. False when reported.
bool frame_camera(const TransformsFrame& in, const std::string& place, CameraFit& sizes, Camera& out,
                  Diagnostics& diagnostics) {
  ImageSize size;
  if (in.lens.w != 0 || in.lens.h != 0) {
    if (!whole_size(in.lens.w) || !whole_size(in.lens.h)) {
      diagnostics.error("scene.image.size", place, "image size 'w' x 'h' is not a pair of whole numbers of pixels",
                        "write the size of the image, or leave both out");
      return false;
    }
    try {
      check_input_limit(static_cast<std::int64_t>(std::max(in.lens.w, in.lens.h)), input_limits().image_axis_px,
                        "image size 'w' x 'h': ", "pixels along an axis", "image_axis_px");
    } catch (const Error& e) {
      diagnostics.error(e.code(), place, e.message(), e.remedy());
      return false;
    }
    size = {static_cast<std::int32_t>(in.lens.w), static_cast<std::int32_t>(in.lens.h), 3, 8};
  } else {
    try {
      size = image_size(in.files.color);
    } catch (const Error& e) {
      diagnostics.error(e.code(), place, "colour image " + e.message(), e.remedy());
      return false;
    }
  }
  const TransformsLens& l = in.lens;
  if (l.fl_x == 0 && l.fl_y == 0 && l.camera_angle_x == 0 && l.camera_angle_y == 0 &&
      l.kind != LensKind::equirectangular) {
    diagnostics.error("scene.camera.missing", place,
                      "no focal length: neither the file nor the frame has 'fl_x', 'camera_angle_x' or a matrix 'K'",
                      "write 'fl_x', 'fl_y', 'cx' and 'cy' in pixels");
    return false;
  }
  out = camera_of(in.lens, size.width_px, size.height_px);
  return sizes.fit(in.files.color, place, out, diagnostics) && check_principal_point(out, place, diagnostics) &&
         check_camera(out, place, diagnostics);
}

}  // namespace

std::string TransformsJson::folder() const {
  return fs::is_regular_file(root_) ? fs::path(root_).parent_path().string() : root_;
}

// Frames that are in a split and have a pose, each image once.
std::vector<const TransformsFrame*> TransformsJson::used_frames(const TransformsIndex& index,
                                                                Diagnostics& diagnostics) const {
  std::vector<const TransformsFrame*> used;
  std::map<std::string, const TransformsFrame*> seen;
  std::size_t unused = 0;
  for (const TransformsFrame& in : index.frames) {
    unused += in.split == Split::unused ? 1 : 0;
    if (in.matrix.empty() || in.split == Split::unused) continue;
    const auto [other, fresh] = seen.emplace(fs::path(in.files.color).lexically_normal().string(), &in);
    if (!fresh) {
      const bool both = other->second->split != in.split;
      diagnostics.error("scene.frame.twice", in.place,
                        both ? "image is listed for training and for tests" : "image is listed twice",
                        "keep one of the two frames");
      continue;
    }
    used.push_back(&in);
  }
  if (unused > 0) {
    diagnostics.note("scene.frames.unused", root_,
                     std::to_string(unused) + " of " + std::to_string(index.frames.size()) +
                         " frames are in neither split, as the index says");
  }
  return used;
}

// As the index tells; where it names no test frame, every n-th of the sorted names is held out, so that the order of
// the export does not matter.
std::vector<Split> TransformsJson::splits_of(const std::vector<const TransformsFrame*>& frames,
                                             Diagnostics& diagnostics) const {
  const auto is_test = [](const TransformsFrame* in) { return in->split == Split::test; };
  std::vector<Split> splits;
  if (std::any_of(frames.begin(), frames.end(), is_test)) {
    for (const TransformsFrame* in : frames) splits.push_back(*in->split);
    if (params_.test_every != TransformsJsonParams{}.test_every)
      diagnostics.note("scene.split.given", root_, "the index names the test frames; scene.test_every is not used");
    return splits;
  }
  std::vector<std::string> order;
  for (const TransformsFrame* in : frames) order.push_back(in->file_path);
  std::sort(order.begin(), order.end());
  std::size_t held_out = 0;
  for (const TransformsFrame* in : frames) {
    const auto rank = std::lower_bound(order.begin(), order.end(), in->file_path) - order.begin();
    splits.push_back(HoldOut{params_.test_every}.split_of(static_cast<std::size_t>(rank), order.size()));
    held_out += splits.back() == Split::test ? 1 : 0;
  }
  const bool told = std::any_of(frames.begin(), frames.end(), [](const TransformsFrame* in) { return in->split; });
  if (told && held_out > 0) {
    diagnostics.note("scene.split.made", root_,
                     "the index names no test frame: " + std::to_string(held_out) + " of " +
                         std::to_string(frames.size()) + " are held out, one in " + std::to_string(params_.test_every) +
                         " (scene.test_every; 0 = none)");
  }
  return splits;
}

SceneInfo TransformsJson::open(Diagnostics& diagnostics) {
  info_ = {};
  info_.opengl_files = true;
  files_.clear();
  channels_.clear();
  const TransformsIndex index = read_transforms(root_, params_.label_key, params_.channels, diagnostics);
  const fs::path canonical = fs::weakly_canonical(root_);
  info_.name = (fs::is_regular_file(canonical) ? canonical.parent_path() : canonical).filename().string();
  depth_units_m_.clear();

  std::vector<std::string> skipped;
  FrameNames names;
  bool has_labels = false, has_depth = false, unit_told = true;
  int real_depth = 0;
  FrameFileCheck check(params_.missing, "label_key");
  CameraFit sizes;
  FrameMasks masks(folder(), params_.masks);
  const std::vector<const TransformsFrame*> used = used_frames(index, diagnostics);
  const std::vector<Split> splits = splits_of(used, diagnostics);
  check.expect(used.size());
  read_depth_camera(index, diagnostics);
  for (std::size_t i = 0; i < used.size(); ++i) {
    const TransformsFrame& in = *used[i];
    FrameInfo frame;
    frame.name = names.of(in.file_path);
    frame.source = in.files.color;
    frame.split = splits[i];
    const std::string place = frame_place(frame);
    if (!check_last_row(in.matrix, place, diagnostics)) continue;
    frame.world_from_camera = opencv_from_opengl(pose_from_rows(in.matrix));
    const PoseState state = check_pose(frame.world_from_camera, place, diagnostics);
    if (state == PoseState::not_finite) skipped.push_back(frame.name);
    FrameFiles files = in.files;
    masks.add_to(files);
    if (state != PoseState::good || !check.present(frame, files, diagnostics) ||
        !frame_camera(in, place, sizes, frame.camera, diagnostics)) {
      continue;
    }
    frame.has_depth = !files.depth.empty();
    frame.has_labels = !files.label.empty();
    frame.has_instances = !files.instance.empty();
    has_labels = has_labels || frame.has_labels;
    has_depth = has_depth || frame.has_depth;
    const std::int32_t colors = check.check_headers(frame, files, diagnostics, depth_camera()).channels;
    if ((colors == 2 || colors == 4) && params_.alpha_background >= 0 &&
        !in.channels.contains(std::string(kAlphaChannel)))
      frame.channels.push_back(alpha_info(frame.camera));
    for (const auto& [name, file] : in.channels) {
      try {
        frame.channels.push_back(channel_info(name, file));
      } catch (const Error& error) {
        diagnostics.error(error.code(), place, error.message(), error.remedy());
      }
    }
    info_.frames.push_back(frame);
    files_.push_back(files);
    channels_.push_back(in.channels);
    unit_told = unit_told && (!frame.has_depth || in.depth_unit_m > 0);
    real_depth += frame.has_depth && in.depth_unit_m > 0 && in.depth_unit_m != 1 && is_real(files.depth) ? 1 : 0;
    depth_units_m_.push_back(params_.depth_unit_m > 0 ? params_.depth_unit_m
                             : in.depth_unit_m > 0    ? in.depth_unit_m
                                                      : 0.001);
  }
  check.report(root_, info_.frames.size(), diagnostics);
  sizes.report(root_, diagnostics);
  masks.report(diagnostics);
  if (!diagnostics.has_errors() || !skipped.empty()) report_skipped(skipped, info_.frames.size(), root_, diagnostics);
  if (params_.depth_unit_m == 0 && !unit_told && !index.unclear_depth_key.empty())
    diagnostics.error("scene.depth.unit", root_,
                      "'" + index.unclear_depth_key +
                          "' may be the steps of a depth image per metre or the metres of a step, and is not read",
                      "write \"depth_unit_m\" with the metres of a step, or set scene.depth_unit_m");
  if (real_depth > 0)
    diagnostics.note("scene.depth.real", root_,
                     std::to_string(real_depth) +
                         " depth files hold real numbers, which are taken as they are: the unit that the index states "
                         "is of integers");
  info_.metric = params_.metric || has_depth;
  info_.limit = index.limit;
  load_classes(index, has_labels, diagnostics);
  return info_;
}

void TransformsJson::read_depth_camera(const TransformsIndex& index, Diagnostics& diagnostics) {
  depth_camera_.reset();
  if (!index.depth_lens) return;
  const std::string place = root_ + ": 'depth_camera'";
  const TransformsLens& lens = *index.depth_lens;
  if (!whole_size(lens.w) || !whole_size(lens.h) || lens.fl_x == 0) {
    diagnostics.error("scene.camera.missing", place, "has no size or no focal length",
                      "write 'w', 'h', 'fl_x', 'fl_y', 'cx' and 'cy' of the depth images, in pixels");
    return;
  }
  DepthCamera out{camera_of(lens, static_cast<std::int32_t>(lens.w), static_cast<std::int32_t>(lens.h)),
                  pose_from_rows(index.depth_from_color)};
  if (!check_camera(out.camera, place, diagnostics)) return;
  const PoseState state = check_pose(out.depth_from_color, place, diagnostics);
  if (state == PoseState::not_finite)
    diagnostics.error("scene.pose.format", place, "'depth_from_color' holds a value that is not finite",
                      "write 4 rows of 4 numbers");
  if (state == PoseState::good) depth_camera_ = out;
}

void TransformsJson::load_classes(const TransformsIndex& index, bool has_labels, Diagnostics& diagnostics) {
  const std::string folder = this->folder();
  const std::string path = !class_file_.empty()       ? class_file_
                           : !index.classes.empty()   ? index.classes
                           : index.class_list.empty() ? find_class_file({folder})
                                                      : "";
  if (!path.empty() || index.class_list.empty()) {
    info_.classes = load_class_file(path, {folder}, has_labels, diagnostics);
    return;
  }
  try {
    info_.classes = ClassTable(index.class_list);
  } catch (const Error& e) {
    diagnostics.error(e.code(), root_ + ": 'classes'", e.message(), e.remedy());
  }
}

void TransformsJson::read(int frame, FrameBuffer& out) const {
  const auto i = static_cast<std::size_t>(frame);
  const std::vector<std::string> wanted = out.wanted;
  FrameReadRules rules;
  rules.depth_unit_m = depth_units_m_.at(i);
  rules.depth_camera = depth_camera();
  rules.alpha_background = params_.alpha_background;
  rules.alpha_masks = params_.alpha_masks;
  rules.unknown_labels = params_.unknown_labels;
  const auto wants = [&](std::string_view name) {
    return std::find(wanted.begin(), wanted.end(), name) != wanted.end();
  };
  rules.alpha = wants(kAlphaChannel) && !channels_[i].contains(std::string(kAlphaChannel));
  read_frame_files(info_.frames.at(i), files_.at(i), rules, info_.classes, out);
  for (const FrameChannelInfo& told : info_.frames[i].channels) {
    if (!wants(told.name) || (told.name == kAlphaChannel && rules.alpha)) continue;
    NumpyArray array = read_npy(channels_[i].at(told.name), [](std::span<const std::int64_t>) {});
    out.channels.push_back({told.name, told.height, told.width, told.cols, std::move(array.values)});
  }
}

namespace {
void register_into(Registry& registry) {
  registry.add_dataset<TransformsJson, TransformsJsonParams>(
      "transforms_json", "Posed images with a transforms.json of nerfstudio, instant-ngp or Blender.");
}
}  // namespace

SEMFIELD_PLUGIN_MODULE(transforms_json, "1.0", register_into)

}  // namespace semfield
