// report.html: the page around its sections.
#include "report/report.h"

#include <fmt/format.h>

#include <array>

#include "core/check.h"
#include "report/html.h"
#include "report/report_parts.h"
#include "report/report_sections.h"

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

}  // namespace semfield
