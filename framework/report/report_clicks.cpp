// What was clicked on the labelling page: classes, and pictures of frames.
#include <fmt/format.h>

#include "report/html.h"
#include "report/report_parts.h"
#include "report/report_sections.h"

namespace semfield {

namespace {

std::string class_rows(const LabellingRecord& record) {
  std::string body;
  for (const LabellingRecord::Class& c : record.classes)
    body += fmt::format(
        "<tr><th scope=\"row\">{} {}<span class=\"none\"> {}</span></th><td class=\"num\">{}</td><td "
        "class=\"num\">{}</td><td class=\"num\">{}</td></tr>\n",
        swatch(c.color), html_escape(c.name), c.id, count_text(c.clicks), percent_text(c.area_share),
        percent_text(c.confidence));
  return body;
}

}  // namespace

std::string clicks_section(const ReportInput& input, const std::string& of_first) {
  std::string tables;
  for (const ReportRun& run : input.runs) {
    if (!run.clicked) continue;
    const LabellingRecord& record = *run.clicked;
    tables += fmt::format("<p class=\"hint after\">{}{} click{} in {} of {} frames, at step {}.</p>\n",
                          input.runs.size() > 1 ? html_escape(run.name) + ": " : std::string(),
                          count_text(record.clicks), record.clicks == 1 ? "" : "s", count_text(record.clicked_frames),
                          count_text(record.frames), count_text(record.step));
    tables +=
        table_panel("Classes of the clicks",
                    "<tr><th scope=\"col\">Class</th><th scope=\"col\" class=\"num\">Clicks</th><th scope=\"col\" "
                    "class=\"num\">Surface</th><th scope=\"col\" class=\"num\">Sure</th></tr>",
                    class_rows(record));
  }
  if (tables.empty()) return {};
  return open_section("clicks", "Clicks",
                      "What was named on the labelling page. Surface: share of what the views show; sure: mean "
                      "probability of the class there.") +
         tables +
         (input.clicked.empty() ? std::string()
                                : "<p class=\"hint after\">Frames with the most clicks, which are drawn on the "
                                  "photographs." +
                                      of_first + "</p>\n" + strip_panels(input.clicked)) +
         "</section>\n";
}

}  // namespace semfield
