// Exported ScanNet scenes: color/, depth/, pose/, intrinsic/, label-filt/, instance-filt/.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "config/params.h"
#include "core/files.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "formats/text_rows.h"
#include "plugin/module.h"
#include "scene/classes/class_table.h"
#include "scene/loading/frame_files.h"
#include "scene/loading/posed_photographs.h"
#include "scene/scene.h"

namespace semfield {

SEMFIELD_CHOICES(ScannetIds, "raw", "nyu40", "eigen13");

/// Its keys are those of PhotographParams but `every`, `least_confidence` and `masks`.
struct ScannetParams : PhotographParams {
  ScannetParams() {
    label_dir = "label-filt";
    test_every = 2;
  }
  ScannetIds class_ids = ScannetIds::nyu40;
  std::int32_t max_frames = 300;
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
  std::string text;
  std::vector<double> numbers;
  if (!noting(diagnostics, place, [&] { text = read_text_file(path, 1 << 16); })) return std::nullopt;
  if (const std::string_view bad = parse_numbers(text, numbers); !bad.empty()) {
    diagnostics.error("scene.pose.format", place, "'" + path + "': '" + word_list(bad)[0] + "' is not a number",
                      "export the scene again");
    return std::nullopt;
  }
  if (numbers.size() == 16) return numbers;
  diagnostics.error("scene.pose.format", place, fmt::format("'{}': expected 16 numbers, got {}", path, numbers.size()),
                    "write a 4 x 4 matrix row by row");
  return std::nullopt;
}

/// A frame is delivered by the colour camera, at its size. Depth is looked up at the depth camera's pixel that the
/// colour pixel's ray falls into (both look from the pose, so z-depth is the same), labels and instances, which stand
/// for the colour picture at whatever size, at the nearest pixel.
class Scannet {
 public:
  Scannet(const ScannetParams& params, PosedPhotographs& files) : params_(params), files_(files), root_(files.root()) {}

  SceneInfo open(Diagnostics& diagnostics) {
    std::vector<PosedPhotograph> views = list_views(diagnostics);
    const bool has_labels = !params_.label_dir.empty() && fs::is_directory(root_ / params_.label_dir);
    if (!params_.label_dir.empty() && params_.label_dir != ScannetParams{}.label_dir && !has_labels)
      diagnostics.error("labels.folder.missing", (root_ / params_.label_dir).string(), "label folder is missing",
                        "check scene.label_dir");
    PhotographRules rules;
    rules.with_masks = rules.labels_by_name = false;
    rules.classes = ClassTable();
    if (views.empty()) return files_.open({}, std::move(rules), diagnostics);
    for (std::size_t rank = 0; rank < views.size(); ++rank) {
      PosedPhotograph& view = views[rank];
      const std::string file = fs::path(view.color).stem().string() + ".png";
      view.depth = in_folder(root_ / "depth", file);
      // Not every frame is labelled.
      if (const fs::path label = root_ / params_.label_dir / file; has_labels && fs::exists(label))
        view.label = label.string();
      view.instance = in_folder(root_ / "instance-filt", file);
      // Which is held out: 1, 3, 5, ... of the default 2.
      view.split = HoldOut{params_.test_every, params_.test_every - 1}.split_of(rank, views.size());
      view.intrinsics = Intrinsics::exact;
    }
    const Camera color = read_camera("intrinsic_color.txt", views, &FrameFiles::color, diagnostics);
    for (PosedPhotograph& view : views) view.camera = color;
    rules.read.depth = DepthGrid::same_place;
    if (!views.front().depth.empty())
      rules.read.depth_camera.camera = read_camera("intrinsic_depth.txt", views, &FrameFiles::depth, diagnostics);
    check_extrinsics(diagnostics);
    rules.read.labels_of_any_size = true;
    if (has_labels) load_classes(rules, diagnostics);
    SceneInfo info = files_.open(std::move(views), std::move(rules), diagnostics);
    const auto unlabelled =
        std::count_if(info.frames.begin(), info.frames.end(), [](const FrameInfo& f) { return !f.has_labels; });
    if (has_labels && unlabelled > 0)
      diagnostics.note("labels.frames.missing", (root_ / params_.label_dir).string(),
                       fmt::format("{} of {} frames have no label image", unlabelled, info.frames.size()));
    return info;
  }

 private:
  std::vector<PosedPhotograph> list_views(Diagnostics& diagnostics) const {
    for (const fs::path& folder : {root_, root_ / "color", root_ / "pose", root_ / "intrinsic"})
      require_folder(folder, "check scene.root; it names the folder of one exported scene");
    std::vector<PosedPhotograph> out;
    std::vector<std::string> skipped;
    for (const auto& [number, path] : numbered_photographs((root_ / "color").string(), diagnostics)) {
      const std::string stem = fs::path(path).stem().string(), pose = (root_ / "pose" / (stem + ".txt")).string();
      FrameInfo frame;
      frame.name = stem;
      frame.source = path;
      if (!files_.check().present(frame, "pose", pose, diagnostics)) continue;
      const auto matrix = read_matrix(pose, frame_place(frame), diagnostics);
      if (!matrix) continue;
      if (!std::all_of(matrix->begin(), matrix->end(), [](double v) { return std::isfinite(v); })) {
        skipped.push_back(stem);
      } else if (check_last_row(*matrix, frame_place(frame), diagnostics)) {
        out.emplace_back().color = path;
        out.back().matrix = *matrix;
      }
    }
    report_skipped(skipped, out.size(), (root_ / "pose").string(), diagnostics);
    if (params_.max_frames > 0 && out.size() > static_cast<std::size_t>(params_.max_frames)) {
      const auto taken = static_cast<std::size_t>(params_.max_frames);
      diagnostics.note(
          "scene.frames.taken", root_.string(),
          fmt::format("{} of {} frames with a pose are taken, evenly spaced (scene.max_frames)", taken, out.size()));
      for (std::size_t k = 0; k < taken; ++k) out[k] = PosedPhotograph(out[k * out.size() / taken]);
      out.resize(taken);
    }
    return out;
  }

  // ScanNet counts pixel centres as whole numbers (its depth camera has cx = 319.5 at 640 pixels): 0.5 is added.
  Camera read_camera(const std::string& file, const std::vector<PosedPhotograph>& views,
                     std::string FrameFiles::*images, Diagnostics& diagnostics) const {
    const std::string path = (root_ / "intrinsic" / file).string();
    Camera camera;
    set_first_size(camera, views, images);
    if (camera.width_px == 0) return camera;
    const auto m = read_matrix(path, path, diagnostics);
    if (!m) return camera;
    if ((*m)[1] != 0 || (*m)[4] != 0 || (*m)[8] != 0 || (*m)[9] != 0 || (*m)[10] != 1) {
      diagnostics.error("scene.camera.format", path, "is not a pinhole camera without skew",
                        "write rows 'fx 0 cx 0', '0 fy cy 0', '0 0 1 0', '0 0 0 1'");
      return camera;
    }
    camera = {camera.width_px, camera.height_px, (*m)[0], (*m)[5], (*m)[2] + 0.5, (*m)[6] + 0.5};
    if (!check_principal_point(camera, path, diagnostics) || !check_camera(camera, path, diagnostics)) return camera;
    if (std::abs(camera.cx / camera.width_px - 0.5) > 0.2 || std::abs(camera.cy / camera.height_px - 0.5) > 0.2)
      diagnostics.warning("scene.camera.center", path,
                          "its principal point is far from the middle of images of " +
                              size_text(camera.width_px, camera.height_px) + " pixels",
                          "if the images were made smaller on export, scale the intrinsics with them");
    return camera;
  }

  void check_extrinsics(Diagnostics& diagnostics) const {
    for (const char* name : {"extrinsic_color.txt", "extrinsic_depth.txt"}) {
      const std::string path = (root_ / "intrinsic" / name).string();
      if (!fs::exists(path)) continue;
      const auto m = read_matrix(path, path, diagnostics);
      if (!m) continue;
      double off = 0;
      for (std::size_t i = 0; i < 16; ++i) off = std::max(off, std::abs((*m)[i] - (i % 5 == 0 ? 1.0 : 0.0)));
      if (!(off < 1e-4))
        diagnostics.warning("scene.scannet.shifted", path,
                            "is not the identity; colour and depth are taken to be seen from the same pose",
                            "expect depth and colour to be shifted against each other");
    }
  }

  void load_classes(PhotographRules& rules, Diagnostics& diagnostics) const {
    const fs::path root = fs::weakly_canonical(root_);
    std::string path = files_.class_file();
    for (const fs::path& folder : {root, root.parent_path()})
      if (path.empty() && fs::exists(folder / kTableName)) path = (folder / kTableName).string();
    if (path.empty())
      return diagnostics.error("labels.classes.none", root_.string(),
                               fmt::format("labels without {} in the scene's folder or above it", kTableName),
                               "copy the file there, or set scene.classes");
    try {
      rules.classes = load_scannet_classes(path, params_.class_ids);
      const auto choice = static_cast<std::size_t>(params_.class_ids);
      if (rules.classes->valid_count() == 0)
        return diagnostics.error("classes.tsv.damaged", path,
                                 fmt::format("has no ids of '{}' classes", ChoiceNames<ScannetIds>::names[choice]),
                                 "choose other class_ids, or restore the table as ScanNet distributes it");
      std::vector<std::int16_t>& class_of_raw = rules.read.class_of_raw;
      class_of_raw.assign(kRawIds, kUnknown);
      class_of_raw[0] = kVoid;
      for (const ScannetLabel& label : read_scannet_tsv(path))
        class_of_raw[static_cast<std::size_t>(label.id)] =
            static_cast<std::int16_t>(rules.classes->index_of(label.id_in(params_.class_ids)));
    } catch (const Error& e) {
      diagnostics.error(e.code(), "", e.message(), e.remedy());
    }
  }

  const ScannetParams& params_;
  PosedPhotographs& files_;
  fs::path root_;
};

}  // namespace

SceneInfo find_photographs(const ScannetParams& params, PosedPhotographs& files, Diagnostics& diagnostics) {
  return Scannet(params, files).open(diagnostics);
}

SEMFIELD_PLUGIN_MODULE(scannet, "1.0", [](Registry& registry) {
  registry.add_dataset<PhotographDataset<ScannetParams>, ScannetParams>(
      "scannet", "Exported ScanNet scenes: poses, colour, depth, raw labels by their table, instances.");
})

}  // namespace semfield
