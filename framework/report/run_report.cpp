#include "report/run_report.h"

#include <fmt/format.h>

#include "eval/image_output.h"
#include "eval/pixel_stride.h"
#include "formats/image_io.h"
#include "report/report.h"
#include "system/files.h"

namespace semfield {

namespace {

// The six pictures of a strip, under the names that a report looks for.
void write_strip(const RunFolder& folder, const Session& s, int frame, const RenderedFrame& maps) {
  const FrameInfo& info = s.scene.info.frames[static_cast<std::size_t>(frame)];
  const StoredFrame& truth = s.scene.frames[static_cast<std::size_t>(frame)];
  const MapSize size{maps.width_px, maps.height_px};
  const auto path = [&](const char* kind) { return folder.render_path("test", info.name, kind); };
  const auto rgb = [&](const char* kind, const std::vector<std::uint8_t>& pixels) {
    write_png_rgb(path(kind), size.width_px, size.height_px, pixels);
  };
  const Camera& camera = info.camera;
  rgb("rgb_truth", strided(truth.rgb, camera.width_px, camera.height_px, 3, maps.stride));
  write_color(path("rgb"), size, maps.rgb);
  const DepthRange range = robust_depth_range(truth.depth_m.empty() ? maps.depth_m : truth.depth_m.expand());
  rgb("depth_vis", depth_colors(maps.depth_m, range.near_m, range.far_m));
  if (maps.label.empty()) return;
  if (!truth.label.empty())
    rgb("label_truth_vis",
        label_colors(strided(truth.label.expand(), camera.width_px, camera.height_px, 1, maps.stride),
                     s.scene.info.classes));
  write_label_ids(path("label"), size, maps.label, s.scene.info.classes);
  rgb("label_vis", label_colors(maps.label, s.scene.info.classes));
  rgb("entropy_vis", entropy_colors(maps.entropy, static_cast<int>(s.plan.class_of_logit.size())));
}

std::string score_text(const FrameScore& score) {
  std::string out = score.miou_present ? fmt::format("mIoU (present) {:.2f}", *score.miou_present) : std::string();
  if (score.psnr_db) out += fmt::format("{}PSNR {:.1f} dB", out.empty() ? "" : ", ", *score.psnr_db);
  return out;
}

}  // namespace

std::string write_run_report(const RunFolder& folder, const Session& session, const ReportFrames& frames,
                             std::string scene) {
  std::vector<WorstFrame> worst;
  for (const auto& [score, maps] : frames.strips()) write_strip(folder, session, score.frame, maps);
  for (const auto& [score, maps] : frames.worst()) {
    write_strip(folder, session, score.frame, maps);
    worst.push_back({score.name, score_text(score)});
  }
  write_file_atomic(folder.worst_frames_path(), worst_frames_json(worst));
  ReportInput input = read_report_input({folder.path()}, static_cast<int>(frames.strips().size()));
  input.scene = std::move(scene);
  write_file_atomic(folder.report_path(), make_report(input));
  return folder.report_path();
}

}  // namespace semfield
