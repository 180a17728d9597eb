// report.html: the page around its sections.
#include "report/report.h"

#include <fmt/format.h>

#include <array>

#include "core/check.h"
#include "eval/evaluator.h"
#include "eval/image_output.h"
#include "formats/image_io.h"
#include "report/html.h"
#include "report/report_sections.h"
#include "system/files.h"

namespace semfield {

std::string report_split(const std::vector<MetricsRow>& rows) {
  std::string last, held_out;
  for (const MetricsRow& row : rows) {
    if (row.kind != "eval") continue;
    last = row.split.substr(0, row.split.size() - (row.split.ends_with(kSampleSuffix) ? kSampleSuffix.size() : 0));
    if (last != "train") held_out = last;
  }
  return held_out.empty() ? last : held_out;
}

std::string make_report(const ReportInput& input) {
  SEMFIELD_CHECK(!input.runs.empty(), "a report is about at least one run");
  const std::string split = input.split.empty() ? report_split(input.runs.front().rows) : input.split;
  const std::string of_first =
      input.runs.size() > 1 ? " Pictures are of " + html_escape(input.runs.front().name) + "." : std::string();
  struct Part {
    const char *id, *name;
    std::string html;
  };
  const std::array<Part, 12> parts{{
      {"scene", "3D", scene_section(input)},
      {"frames", "Frames", frames_section(input.strips, of_first)},
      {"clicks", "Clicks", clicks_section(input, of_first)},
      {"figures", "Figures", figures_section(input, split)},
      {"curves", "Error against run time", curves_section(input, split)},
      {"labels", "Labels", labels_section(input, split)},
      {"classes", "Classes", classes_section(input, split)},
      {"confusion", "Confusions", confusion_section(input)},
      {"calibration", "Calibration", calibration_section(input)},
      {"worst", "Worst frames", worst_section(input, of_first)},
      {"left-out", "Left out", left_out_section(input)},
      {"setup", "Set-up", environment_section(input)},
  }};
  const std::string title = html_escape(input.title.empty() ? "Semfield run" : input.title);
  std::string page = fmt::format(
      "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n"
      "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n<meta name=\"color-scheme\" "
      "content=\"light dark\">\n"
      "<meta http-equiv=\"Content-Security-Policy\" content=\"{}\">\n"
      "<title>{} – Semfield report</title>\n<style>",
      content_policy(input), title);
  page += report_style();
  page += fmt::format("</style>\n</head>\n<body>\n<header class=\"top\">\n<h1>{}</h1>\n", title);
  if (!input.subtitle.empty()) page += fmt::format("<p class=\"lead\">{}</p>\n", html_escape(input.subtitle));
  page += facts_section(input, split);
  page += "<nav aria-label=\"Sections\">\n";
  for (const Part& part : parts) {
    if (!part.html.empty()) page += fmt::format("<a href=\"#{}\">{}</a>\n", part.id, part.name);
  }
  page += "</nav>\n" + notice_section(input, split) + cards_section(input, split) + "</header>\n<main>\n";
  for (const Part& part : parts) page += part.html;
  page +=
      "</main>\n<footer>Made by Semfield from the run folder’s files; the same files give the same "
      "bytes.</footer>\n</body>\n</html>\n";
  return page;
}

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
