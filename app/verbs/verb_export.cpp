// export: label maps of a run's field for labelling tools.
#include <fmt/format.h>

#include <cstdio>
#include <filesystem>
#include <optional>

#include "app/json_output.h"
#include "app/progress_line.h"
#include "app/verb.h"
#include "core/findings.h"
#include "formats/image_io.h"
#include "labels/label_export.h"
#include "labels/small_regions.h"
#include "run/open_run.h"
#include "run/run_folder.h"

namespace semfield::app {

namespace {

struct ExportVerbOptions {
  std::string run;
  std::string split = "test";
  std::string format = "coco";  ///< coco, coco_rle or labelme
  std::string out;              ///< file for COCO, folder for labelme
  long long min_area = 0;       ///< pixels; smaller regions take the class around them
  std::vector<std::string> set;
};

// The stored image of a frame, "" when its dataset has none.
std::string image_of(const FrameInfo& info) {
  std::error_code ignored;
  return std::filesystem::is_regular_file(info.source, ignored) ? info.source : std::string();
}

// Labelling tools lay the labels over the stored image; a run may have been trained at another size.
void note_other_size(const FrameInfo& info, const AppContext& context) {
  const std::string image = image_of(info);
  if (image.empty()) return;
  const ImageSize size = image_size(image);
  const Camera& camera = info.camera;
  if (size.width_px == camera.width_px && size.height_px == camera.height_px) return;
  print_note(context, "labels are " + std::to_string(camera.width_px) + " x " + std::to_string(camera.height_px) +
                          ", the stored images " + std::to_string(size.width_px) + " x " +
                          std::to_string(size.height_px) +
                          ": to export at that size, give --set scene.load.downscale=1");
}

int run(const ExportVerbOptions& options, AppContext& context) {
  Diagnostics diagnostics;
  OpenedRun run = open_run(options.run, options.set, context.registry, diagnostics, OpenFor::rendering);
  context.adopt(run.session.config);
  for (const Diagnostic& finding : folded(diagnostics)) print_note(context, finding.text());
  Session& s = run.session;
  if (s.plan.class_of_logit.empty())
    throw Error(ErrorKind::data, options.run + ": the run has no semantics", "train with labels");
  const std::vector<int> frames = s.scene.frames_of(options.split == "test" ? Split::test : Split::train);
  if (frames.empty())
    throw Error(ErrorKind::data, options.run + ": no frames in split '" + options.split + "'",
                "see `semfield inspect`");
  std::optional<CocoExport> coco;
  if (options.format == "labelme") {
    std::error_code failed;
    std::filesystem::create_directories(options.out, failed);
    if (failed)
      throw Error(ErrorKind::cannot_create, options.out + ": cannot create the folder: " + failed.message(),
                  "choose another --out");
  } else {
    coco.emplace(s.scene.info.classes, options.format == "coco" ? CocoMasks::polygons : CocoMasks::run_lengths);
  }
  std::int64_t shapes = 0;
  SmallRegions filled;
  std::int64_t pixels = 0;
  int done = 0;
  note_other_size(s.scene.info.frames[static_cast<std::size_t>(frames.front())], context);
  ProgressLine progress(context, "exported");
  const auto part_done = [&](double share) { progress.show(done + share, static_cast<double>(frames.size())); };
  for (const int f : frames) {
    const FrameInfo& info = s.scene.info.frames[static_cast<std::size_t>(f)];
    const RayCamera camera{info.camera, info.world_from_camera, s.plan.undistortion};
    RenderedFrame rendered =
        render_named_frame(*s.pipeline, info.name, camera, s.limits, s.plan.class_of_logit, {}, {1, part_done});
    LabelledFrame frame{info.name, image_of(info), rendered.width_px, rendered.height_px, std::move(rendered.label)};
    const SmallRegions small = fill_small_regions(frame.label, frame.width_px, frame.height_px, options.min_area);
    filled.regions += small.regions;
    filled.pixels += small.pixels;
    pixels += std::ssize(frame.label);
    if (coco) {
      coco->add(frame);
    } else {
      shapes += write_labelme(options.out, frame, s.scene.info.classes);
    }
    ++done;
  }
  if (coco) {
    coco->write(options.out);
    shapes = coco->annotations();
  }
  if (options.min_area > 0)
    print_note(context, fmt::format("{} regions of fewer than {} pixels took the class around them: {} of {} pixels",
                                    filled.regions, options.min_area, filled.pixels, pixels));
  if (context.json) {
    print_json(context, {{"run", options.run},
                         {"step", run.step},
                         {"split", options.split},
                         {"frames", done},
                         {"shapes", shapes},
                         {"format", options.format},
                         {"out", options.out}});
    return 0;
  }
  std::printf("export: frames=%d shapes=%lld format=%s out=%s\n", done, static_cast<long long>(shapes),
              options.format.c_str(), options.out.c_str());
  return 0;
}

void words(VerbWords& verb, ExportVerbOptions& options) {
  verb.operand("run", options.run, "run folder");
  verb.choice("--split SPLIT", options.split, {"test", "train"}, "frames to export");
  verb.choice("--format FORMAT", options.format, {"coco", "coco_rle", "labelme"},
              "coco (polygons), coco_rle (run lengths) or labelme");
  verb.value_in("--min-area N", options.min_area, 0, 1e9, "merge regions of fewer pixels into the class around them");
  verb.required("--out PATH", options.out, "file to write for COCO, folder for labelme");
  verb.run_settings(options.set);
}

}  // namespace

Verb verb_export() {
  return with_json(
      make_verb<ExportVerbOptions>("export", 130, "write the labels of a run's field for labelling tools", words, run));
}

}  // namespace semfield::app
