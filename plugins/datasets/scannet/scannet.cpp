// Exported ScanNet scenes: color/, depth/, pose/, intrinsic/, label-filt/, instance-filt/.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "config/params.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "formats/text_rows.h"
#include "loading/frame_files.h"
#include "plugin/dataset.h"
#include "plugin/module.h"
#include "scene/classes/class_table.h"
#include "scene/scene.h"
#include "system/files.h"

namespace semfield {

namespace fs = std::filesystem;

SEMFIELD_CHOICES(ScannetIds, "raw", "nyu40", "eigen13");

struct ScannetParams {
  std::string root;
  ScannetIds class_ids = ScannetIds::nyu40;
  std::string classes;
  std::string label_dir = "label-filt";
  std::int32_t max_frames = 300;
  std::int32_t test_every = 2;
  UnknownLabels unknown_labels = UnknownLabels::error;
  MissingFiles missing = MissingFiles::error;
};

void describe(ParamVisitor& visit, ScannetParams& p) {
  SEMFIELD_PARAM(visit, p, root, "folder of the exported scene: it holds color/, pose/, intrinsic/");
  SEMFIELD_PARAM(visit, p, class_ids,
                 "what trains: the 40 classes of NYUv2, the 13 of Eigen and Fergus, or the raw ids");
  SEMFIELD_PARAM(visit, p, classes,
                 "label table (scannetv2-labels.combined.tsv); empty = the one in root or in the folder above it");
  SEMFIELD_PARAM(visit, p, label_dir, "folder inside root of the label images <id>.png of raw ids; empty = no labels");
  SEMFIELD_PARAM(visit, p, max_frames, "frames to take, evenly spaced among those with a pose; 0 = all", {0, 1e6});
  SEMFIELD_PARAM(visit, p, test_every,
                 "every N-th of the frames taken is held out for tests, 2 = every other; 0 = none", {0, 1e6});
  SEMFIELD_PARAM(visit, p, unknown_labels, "how a raw id outside the label table is read: as an error, or as void");
  SEMFIELD_PARAM(visit, p, missing, kMissingSentence);
}

void validate(const ScannetParams& p, Diagnostics& diagnostics) {
  check_root_and_test_every(p.root, p.test_every, diagnostics);
}

std::string recognise(const std::string& path, ScannetParams& p) {
  p.root = path;
  for (const char* folder : {"color", "pose", "intrinsic"}) {
    if (!is_folder(fs::path(path) / folder)) return "";
  }
  return "an exported ScanNet scene";
}

namespace {

constexpr const char* kTableName = "scannetv2-labels.combined.tsv";
constexpr std::int16_t kUnknown = -2;
constexpr std::size_t kRawIds = 65536;

// The 16 numbers of a 4 x 4 matrix; nothing when reported.
std::optional<std::vector<double>> read_matrix(const std::string& path, const std::string& place,
                                               Diagnostics& diagnostics) {
  std::vector<double> numbers;
  try {
    const std::string text = read_text_file(path, 1 << 16);
    if (const std::string_view bad = parse_numbers(text, numbers); !bad.empty()) {
      diagnostics.error("scene.pose.format", place, "'" + path + "': '" + word_list(bad)[0] + "' is not a number",
                        "export the scene again");
      return std::nullopt;
    }
  } catch (const Error& e) {
    diagnostics.error(e.code(), place, e.message(), e.remedy());
    return std::nullopt;
  }
  if (numbers.size() != 16) {
    diagnostics.error("scene.pose.format", place,
                      "'" + path + "': expected 16 numbers, got " + std::to_string(numbers.size()),
                      "write a 4 x 4 matrix row by row");
    return std::nullopt;
  }
  return numbers;
}

// The pixel of a second camera, of focal length f2 and centre c2, that sees the centre of each of `to` pixels of a
// first one (f1, c1); -1 outside its `from` pixels.
std::vector<std::int64_t> by_ray(double f2, double c2, std::int32_t from, double f1, double c1, std::int32_t to) {
  std::vector<std::int64_t> out;
  for (std::int32_t i = 0; i < to; ++i) {
    const double at = std::floor(f2 * (i + 0.5 - c1) / f1 + c2);
    out.push_back(at >= 0 && at < from ? static_cast<std::int64_t>(at) : -1);
  }
  return out;
}

// out[row, col] = value(image pixel), or `outside`.
template <class T, class Pixel, class Value>
std::vector<T> resample(const Image<Pixel>& image, const std::vector<std::int64_t>& rows,
                        const std::vector<std::int64_t>& cols, T outside, Value value) {
  std::vector<T> out;
  out.reserve(rows.size() * cols.size());
  for (const std::int64_t row : rows) {
    for (const std::int64_t col : cols) {
      const std::int64_t pixel = row * image.width_px + col;
      out.push_back(row < 0 || col < 0 ? outside : value(static_cast<std::size_t>(pixel)));
    }
  }
  return out;
}

}  // namespace

/// A frame is delivered by the colour camera, at its size. Depth is looked up at the depth camera's pixel that the
/// colour pixel's ray falls into (both look from the pose, so z-depth is the same), labels and instances, which stand
/// for the colour picture at whatever size, at the nearest pixel.
class Scannet final : public Dataset {
 public:
  Scannet(const ScannetParams& params, const DatasetBuild& build)
      : params_(params),
        root_((fs::path(build.config_dir) / params.root).string()),
        table_file_(build.path_of(params.classes)) {}

  SceneInfo open(Diagnostics& diagnostics) override {
    info_ = {};
    files_.clear();
    index_of_raw_.assign(kRawIds,
                         kVoid);  // until the table is read: a table that fails is one error, not one per frame
    const fs::path root(root_);
    FrameFileCheck check(params_.missing, "label_dir");
    const std::vector<View> views = list_views(check, diagnostics);
    info_.name = fs::weakly_canonical(root).filename().string();
    has_ = {fs::is_directory(root / "depth"), !params_.label_dir.empty() && fs::is_directory(root / params_.label_dir),
            fs::is_directory(root / "instance-filt")};
    if (!params_.label_dir.empty() && params_.label_dir != ScannetParams{}.label_dir && !has_[1])
      diagnostics.error("labels.folder.missing", (root / params_.label_dir).string(), "label folder is missing",
                        "check scene.label_dir");
    if (views.empty()) {
      check.report(root_, 0, diagnostics);
      return info_;
    }

    std::vector<std::string> colors, depths;
    for (const View& view : views) {
      colors.push_back(view.color);
      depths.push_back((root / "depth" / (fs::path(view.color).stem().string() + ".png")).string());
    }
    color_ = read_camera("intrinsic_color.txt", colors, diagnostics);
    if (has_[0]) depth_ = read_camera("intrinsic_depth.txt", depths, diagnostics);
    check_extrinsics(diagnostics);
    check.expect(views.size());
    for (std::size_t rank = 0; rank < views.size(); ++rank)
      add_frame(views[rank], rank, views.size(), check, diagnostics);
    check.report(root_, info_.frames.size(), diagnostics);
    const auto unlabelled =
        std::count_if(info_.frames.begin(), info_.frames.end(), [](const FrameInfo& f) { return !f.has_labels; });
    if (has_[1] && unlabelled > 0) {
      diagnostics.note(
          "labels.frames.missing", (root / params_.label_dir).string(),
          std::to_string(unlabelled) + " of " + std::to_string(info_.frames.size()) + " frames have no label image");
    }
    if (has_[1]) load_classes(diagnostics);
    return info_;
  }

  void read(int frame, FrameBuffer& out) const override {
    const auto i = static_cast<std::size_t>(frame);
    const FrameInfo& info = info_.frames.at(i);
    const FrameFiles& files = files_.at(i);
    const Camera& c = info.camera;
    read_frame_files(info, {files.color, "", "", ""}, FrameReadRules{}, info_.classes, out);
    try {
      if (!files.depth.empty()) {
        const Image<float> image = read_depth(files.depth);
        out.depth_m = resample(image, by_ray(depth_.fy, depth_.cy, image.height_px, c.fy, c.cy, c.height_px),
                               by_ray(depth_.fx, depth_.cx, image.width_px, c.fx, c.cx, c.width_px), 0.0f,
                               [&](std::size_t p) { return image.pixels[p]; });
      }
      if (!files.label.empty()) {
        const Image<std::uint16_t> image = read_ids(files.label);
        UnknownValues unknown;
        const auto index = [&](std::size_t p) {
          const std::int16_t found = index_of_raw_[image.pixels[p]];
          if (found != kUnknown) return found;
          if (params_.unknown_labels == UnknownLabels::error) unknown.try_emplace(std::to_string(image.pixels[p]), p);
          return kVoid;
        };
        out.label = resample(image, nearest_pixels(image.height_px, c.height_px),
                             nearest_pixels(image.width_px, c.width_px), kVoid, index);
        if (!unknown.empty())
          throw UnknownLabelError("raw id", std::move(unknown), files.label, image.width_px, kUnknownLabelRemedy);
      }
      if (!files.instance.empty()) {
        const Image<std::uint16_t> image = read_ids(files.instance);
        out.instance =
            resample(image, nearest_pixels(image.height_px, c.height_px), nearest_pixels(image.width_px, c.width_px),
                     std::int32_t{0}, [&](std::size_t p) { return std::int32_t{image.pixels[p]}; });
      }
    } catch (Error& e) {
      e.while_doing("frame '" + info.name + "'");
      throw;  // not a copy: an UnknownLabelError stays one
    }
  }

 private:
  struct View {
    int number = 0;  ///< <id> of color/<id>.jpg
    std::string color;
    Pose pose;
  };
  std::vector<View> list_views(FrameFileCheck& check, Diagnostics& diagnostics) const {
    const fs::path root(root_);
    for (const fs::path& folder : {root, root / "color", root / "pose", root / "intrinsic"})
      require_folder(folder, "check scene.root; it names the folder of one exported scene");
    std::vector<View> out;
    std::vector<std::string> skipped;
    for (const auto& [number, path] : numbered_photographs((root / "color").string(), diagnostics)) {
      const std::string stem = fs::path(path).stem().string(), pose = (root / "pose" / (stem + ".txt")).string();
      FrameInfo frame;
      frame.name = stem;
      frame.source = path;
      if (!check.present(frame, "pose", pose, diagnostics)) continue;
      const auto matrix = read_matrix(pose, frame_place(frame), diagnostics);
      if (!matrix) continue;
      if (std::all_of(matrix->begin(), matrix->end(), [](double v) { return std::isfinite(v); })) {
        if (!check_last_row(*matrix, frame_place(frame), diagnostics)) continue;
        out.push_back({static_cast<int>(number), path, pose_from_rows(*matrix)});
      } else {
        skipped.push_back(stem);
      }
    }
    report_skipped(skipped, out.size(), (root / "pose").string(), diagnostics);
    if (params_.max_frames > 0 && out.size() > static_cast<std::size_t>(params_.max_frames)) {
      const auto taken = static_cast<std::size_t>(params_.max_frames);
      diagnostics.note("scene.frames.taken", root_,
                       std::to_string(taken) + " of " + std::to_string(out.size()) +
                           " frames with a pose are taken, evenly spaced (scene.max_frames)");
      for (std::size_t k = 0; k < taken; ++k) out[k] = out[k * out.size() / taken];
      out.resize(taken);
    }
    return out;
  }

  // ScanNet counts pixel centres as whole numbers (its depth camera has cx = 319.5 at 640 pixels): 0.5 is added.
  Camera read_camera(const std::string& file, const std::vector<std::string>& images, Diagnostics& diagnostics) const {
    const std::string path = (fs::path(root_) / "intrinsic" / file).string();
    Camera camera;
    for (const std::string& image : images) {
      try {
        const ImageSize size = image_size(image);
        camera.width_px = size.width_px;
        camera.height_px = size.height_px;
        break;
      } catch (const Error&) {
        continue;  // its header is checked with its frame
      }
    }
    if (camera.width_px == 0) return camera;
    const auto m = read_matrix(path, path, diagnostics);
    if (!m) return camera;
    if ((*m)[1] != 0 || (*m)[4] != 0 || (*m)[8] != 0 || (*m)[9] != 0 || (*m)[10] != 1) {
      diagnostics.error("scene.camera.format", path, "is not a pinhole camera without skew",
                        "write rows 'fx 0 cx 0', '0 fy cy 0', '0 0 1 0', '0 0 0 1'");
      return camera;
    }
    camera.fx = (*m)[0];
    camera.fy = (*m)[5];
    camera.cx = (*m)[2] + 0.5;
    camera.cy = (*m)[6] + 0.5;
    if (!check_principal_point(camera, path, diagnostics) || !check_camera(camera, path, diagnostics)) return camera;
    if (std::abs(camera.cx / camera.width_px - 0.5) > 0.2 || std::abs(camera.cy / camera.height_px - 0.5) > 0.2) {
      diagnostics.warning("scene.camera.center", path,
                          "its principal point is far from the middle of images of " + std::to_string(camera.width_px) +
                              " x " + std::to_string(camera.height_px) + " pixels",
                          "if the images were made smaller on export, scale the intrinsics with them");
    }
    return camera;
  }

  void check_extrinsics(Diagnostics& diagnostics) const {
    for (const char* name : {"extrinsic_color.txt", "extrinsic_depth.txt"}) {
      const std::string path = (fs::path(root_) / "intrinsic" / name).string();
      if (!fs::exists(path)) continue;
      const auto m = read_matrix(path, path, diagnostics);
      if (!m) continue;
      double off = 0;
      for (std::size_t i = 0; i < 16; ++i) off = std::max(off, std::abs((*m)[i] - (i % 5 == 0 ? 1.0 : 0.0)));
      if (!(off < 1e-4)) {
        diagnostics.warning("scene.scannet.shifted", path,
                            "is not the identity; colour and depth are taken to be seen from the same pose",
                            "expect depth and colour to be shifted against each other");
      }
    }
  }

  void add_frame(const View& view, std::size_t rank, std::size_t views, FrameFileCheck& check,
                 Diagnostics& diagnostics) {
    const std::string stem = fs::path(view.color).stem().string();
    const auto file_in = [&](const std::string& folder) {
      return (fs::path(root_) / folder / (stem + ".png")).string();
    };
    FrameInfo frame;
    frame.name = stem;
    frame.source = view.color;
    frame.camera = color_;
    frame.world_from_camera = view.pose;
    if (check_pose(frame.world_from_camera, frame_place(frame), diagnostics) != PoseState::good) return;
    FrameFiles files{view.color, has_[0] ? file_in("depth") : "", has_[1] ? file_in(params_.label_dir) : "",
                     has_[2] ? file_in("instance-filt") : ""};
    if (has_[1] && !fs::exists(files.label)) files.label.clear();  // not every frame is labelled
    if (!check.present(frame, files, diagnostics)) return;
    files.tell_channels(frame);
    // Which is held out: 1, 3, 5, ... of the default 2.
    frame.split = HoldOut{params_.test_every, params_.test_every - 1}.split_of(rank, views);
    check.check_headers(frame, {files.color, "", "", ""}, diagnostics);
    // The other channels have sizes of their own: depth that of its camera, the rest the shape of the colour picture.
    FrameInfo other = frame;
    other.camera = depth_;
    check.check_headers(other, {"", files.depth, "", ""}, diagnostics);
    check_shape(files.label, frame, "label_dir", diagnostics);
    check_shape(files.instance, frame, "", diagnostics);
    info_.frames.push_back(frame);
    files_.push_back(files);
  }

  void load_classes(Diagnostics& diagnostics) {
    const fs::path root = fs::weakly_canonical(root_);
    std::string path = table_file_;
    for (const fs::path& folder : {root, root.parent_path()}) {
      if (path.empty() && fs::exists(folder / kTableName)) path = (folder / kTableName).string();
    }
    if (path.empty()) {
      return diagnostics.error("labels.classes.none", root_,
                               std::string("labels without ") + kTableName + " in the scene's folder or above it",
                               "copy the file there, or set scene.classes");
    }
    try {
      info_.classes = load_scannet_classes(path, params_.class_ids);
      if (info_.classes.valid_count() == 0) {
        const auto choice = static_cast<std::size_t>(params_.class_ids);
        return diagnostics.error("classes.tsv.damaged", path,
                                 "has no ids of '" + std::string(ChoiceNames<ScannetIds>::names[choice]) + "' classes",
                                 "choose other class_ids, or restore the table as ScanNet distributes it");
      }
      index_of_raw_.assign(kRawIds, kUnknown);
      index_of_raw_[0] = kVoid;
      for (const ScannetLabel& label : read_scannet_tsv(path)) {
        index_of_raw_[static_cast<std::size_t>(label.id)] =
            static_cast<std::int16_t>(info_.classes.index_of(label.id_in(params_.class_ids)));
      }
    } catch (const Error& e) {
      diagnostics.error(e.code(), "", e.message(), e.remedy());
    }
  }

  ScannetParams params_;
  std::string root_, table_file_;
  Camera color_, depth_;
  std::array<bool, 3> has_{};  ///< depth, labels, instances: the folder is there
  SceneInfo info_;
  std::vector<FrameFiles> files_;
  std::vector<std::int16_t> index_of_raw_;  ///< [65536] class index, kVoid, or kUnknown
};

SEMFIELD_PLUGIN_MODULE(scannet, "1.0", [](Registry& registry) {
  registry.add_dataset<Scannet, ScannetParams>(
      "scannet", "Exported ScanNet scenes: poses, colour, depth, raw labels by their table, instances.");
})

}  // namespace semfield
