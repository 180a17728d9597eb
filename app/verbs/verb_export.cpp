// export: label maps of a run's field for labelling tools, or the run as one page to send.
#include <fmt/format.h>

#include <cstdio>
#include <filesystem>
#include <functional>
#include <optional>

#include "app/json_output.h"
#include "app/render/run_surface.h"
#include "app/scene/inspect_report.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "core/error.h"
#include "eval/image_output.h"
#include "formats/image_io.h"
#include "labels/frame_match.h"
#include "labels/label_export.h"
#include "labels/mask_outlines.h"
#include "run/run_folder.h"
#include "run/run_scores.h"
#include "scene/classes/class_table.h"
#include "scene/scene.h"
#include "serve/view_pictures.h"
#include "system/files.h"

namespace semfield::app {

namespace {

struct ExportVerbOptions : Options {
  explicit ExportVerbOptions(const Declaration& at) : Options(at) { excludes("--to", "--out"); }
  const std::string& run = operand("run", "run folder");
  const std::string& split = choice("--split SPLIT", "test", {"test", "train"}, "frames to export");
  const std::string& format = choice(
      "--format FORMAT", "coco", {"coco", "coco_rle", "labelme", "png"},
      "coco (polygons), coco_rle (run lengths), labelme, or png (label images with class ids, and classes.yaml)");
  const std::string& size = choice(
      "--size SIZE", "stored", {"stored", "trained"},
      "size of the labels: stored, that of the images in their files, along whose edges the labels are brought; or "
      "trained, the size at which the run loads them");
  const std::optional<long long>& min_area = value_in<std::optional<long long>>(
      "--min-area N", {}, 0, 1e9,
      "merge regions of fewer pixels into the class around them; 0: none (default: 1/4096 of an image's pixels)");
  const std::string& out = value("--out PATH", "file to write for COCO, folder for labelme and png");
  const std::string& to =
      value("--to FILE",
            "instead of labels, one page that any browser opens without a network: FILE.html, with the mesh, its "
            "classes and the objects that were found");
  const std::vector<std::string>& set = run_settings();
};

constexpr long long kPageFaces = 2'000'000;      // about 20 MB
constexpr std::int64_t kPixelsOfARegion = 4096;  // of an image, for one of the least region that stands by itself

// The stored image of a frame, "" when its dataset has none.
std::string image_of(const FrameInfo& info) { return is_file(info.source) ? info.source : std::string(); }

// What a frame's labels are rendered at, and what becomes of them.
class Exporter {
 public:
  Exporter(const ExportVerbOptions& options, const Session& session)
      : options_(options), session_(session), pictures_(picture_names(session.scene.info.frames)) {
    if (options.format == "coco" || options.format == "coco_rle") {
      coco_.emplace(classes(), options.format == "coco" ? CocoMasks::polygons : CocoMasks::run_lengths);
      return;
    }
    create_output_folder(options.out);
  }

  void add(int number, const std::function<void(double)>& progress) {
    const FrameInfo& info = session_.scene.info.frames[static_cast<std::size_t>(number)];
    const std::optional<StoredSize> stored = options_.size == "stored" ? stored_size_of(info) : std::nullopt;
    const Camera& camera = stored ? stored->camera : info.camera;
    FrameOptions rendering{stored ? stored->stride : 1, progress};
    rendering.color = false;
    RenderedFrame rendered =
        render_named_frame(*session_.pipeline, info.name, {camera, info.world_from_camera, session_.plan.undistortion},
                           session_.limits, session_.plan.class_of_logit, {}, rendering);
    LabelledFrame frame{info.name, image_of(info), camera.width_px, camera.height_px, {}};
    frame.label = stored ? labels_at(*stored, std::move(rendered)) : std::move(rendered.label);
    for (std::int16_t& label : frame.label)
      if (label >= 0 && is_unnamed_class(classes().valid(label).name)) label = kVoid;
    const std::int64_t all = std::ssize(frame.label);
    const SmallRegions small = fill_small_regions(frame.label, frame.width_px, frame.height_px,
                                                  options_.min_area.value_or(all / kPixelsOfARegion));
    if (const std::optional<Annotations>& clicks = session_.config.labels.clicks)
      clicks->clear_ignored(number, frame.width_px, frame.height_px, frame.label);
    // Tools draw over the image as they show it.
    frame.label = as_shown(std::move(frame.label), frame.width_px, frame.height_px, info.orientation);
    if (turned_by_quarter(info.orientation)) std::swap(frame.width_px, frame.height_px);
    frame.picture = pictures_[static_cast<std::size_t>(number)];
    filled_.regions += small.regions;
    filled_.pixels += small.pixels;
    pixels_ += all;
    ++frames_;
    write(frame);
  }

  void finish() {
    if (coco_) {
      coco_->write(options_.out);
      shapes_ = coco_->annotations();
    } else if (options_.format == "png") {
      write_file_atomic((std::filesystem::path(options_.out) / "classes.yaml").string(),
                        named_classes(classes()).to_yaml());
    }
  }
  int frames() const { return frames_; }
  std::int64_t shapes() const { return shapes_; }
  /// A sentence about regions that took the class around them; "" without any.
  std::string told() const {
    if (filled_.regions == 0) return {};
    return fmt::format(
        "{} regions of fewer than {} pixels took the class around them: {} of {} pixels", filled_.regions,
        options_.min_area ? std::to_string(*options_.min_area) : fmt::format("1/{} of an image's", kPixelsOfARegion),
        filled_.pixels, pixels_);
  }

 private:
  const ClassTable& classes() const { return session_.scene.info.classes; }
  void write(const LabelledFrame& frame) {
    if (coco_) {
      coco_->add(frame);
    } else if (options_.format == "png") {
      write_label_ids((std::filesystem::path(options_.out) / (output_name(frame.name) + "_label.png")).string(),
                      {frame.width_px, frame.height_px}, frame.label, classes());
      ++shapes_;
    } else {
      shapes_ += write_labelme(options_.out, frame, classes());
    }
  }

  const ExportVerbOptions& options_;
  const Session& session_;
  std::vector<std::string> pictures_;  // by frame
  std::optional<CocoExport> coco_;
  SmallRegions filled_;
  std::int64_t shapes_ = 0, pixels_ = 0;
  int frames_ = 0;
};

// The page that `semfield mesh` writes as HTML.
int export_page(const ExportVerbOptions& options, AppContext& context) {
  if (!options.to.ends_with(".html"))
    throw Error(ErrorKind::usage, "export.page.ending", "--to " + options.to + ": this is not the name of a page",
                "end it with .html; meshes and points are written by `semfield mesh --out`");
  const OpenedRun run = run_of(options.run, options.set, OpenFor::rendering, context);
  SurfaceWishes wishes;
  wishes.faces = kPageFaces;
  RunSurface found;
  {
    ProgressLine progress(context, "depth of", "views");
    found = make_run_surface(run.session, options.run, wishes, {},
                             {[&](const std::string& note) { print_note(context, note); },
                              [&](double done, double of) { progress.show(done, of); }});
  }
  const std::filesystem::path file(options.to);
  if (file.has_parent_path()) create_folders(file.parent_path().string());
  const ScenePage page = scene_page_of(run.session, run.run_dir, run.step);
  write_scene_page(options.to, found.surface, run.session.scene.info.classes, page);
  const std::size_t objects = page.objects ? page.objects->rows.size() : 0;
  const double megabytes = static_cast<double>(std::filesystem::file_size(file)) * 1e-6;
  const std::size_t faces = found.surface.triangles.size();
  print_results(
      context,
      {{"run", options.run},
       {"step", run.step},
       {"faces", faces},
       {"objects", objects},
       {"megabytes", megabytes},
       {"out", options.to}},
      fmt::format("export: faces={} objects={} megabytes={:.1f} out={}", faces, objects, megabytes, options.to));
  return 0;
}

int run(const ExportVerbOptions& options, AppContext& context) {
  if (!options.to.empty()) return export_page(options, context);
  if (options.out.empty())
    throw Error(ErrorKind::usage, "usage.flag.missing", "neither --out nor --to",
                "name a file or folder for labels with --out, or a page with --to scene.html");
  OpenedRun run = run_of(options.run, options.set, OpenFor::rendering, context);
  Session& s = run.session;
  if (s.plan.class_of_logit.empty())
    throw Error(ErrorKind::data, "run.semantics.none", options.run + ": the run has no semantics", "train with labels");
  const std::vector<int> frames = s.scene.frames_of(options.split == "test" ? Split::test : Split::train);
  if (frames.empty())
    throw Error(ErrorKind::data, "scene.split.empty", options.run + ": no frames in split '" + options.split + "'",
                "see `semfield inspect`");
  Exporter exporter(options, s);
  {
    ProgressLine progress(context, "exported");
    for (const int f : frames) {
      const auto part_done = [&](double share) {
        progress.show(exporter.frames() + share, static_cast<double>(frames.size()));
      };
      exporter.add(f, part_done);
    }
  }
  exporter.finish();
  if (const std::string told = exporter.told(); !told.empty()) print_note(context, told);
  print_results(context,
                {{"run", options.run},
                 {"step", run.step},
                 {"split", options.split},
                 {"frames", exporter.frames()},
                 {"shapes", exporter.shapes()},
                 {"format", options.format},
                 {"out", options.out}},
                fmt::format("export: frames={} shapes={} format={} out={}", exporter.frames(), exporter.shapes(),
                            options.format, options.out));
  return 0;
}

}  // namespace

Verb verb_export() {
  return make_verb<ExportVerbOptions>(
      "export", 130, "write the labels of a run's field for labelling tools, or the run as one page", run);
}

}  // namespace semfield::app
