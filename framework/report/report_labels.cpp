// Error against the number of labels.
#include <fmt/format.h>

#include <algorithm>
#include <array>

#include "core/error.h"
#include "report/html.h"
#include "report/report_comparison.h"
#include "report/report_parts.h"
#include "report/report_sections.h"
#include "report/report_svg.h"

namespace semfield {

namespace {

// A scene without classes has no labels to report.
bool has_labels(const ReportRun& run) { return run.labels && !run.labels->classes.empty(); }

struct Abscissa {
  const char* label;
  std::int64_t LabelCounts::*count;
};
constexpr Abscissa kPixels{"labelled pixels in training", &LabelCounts::labelled_px},
    kFrames{"labelled frames in training", &LabelCounts::labelled_frames};

// Each run is a point of its own: what else differs between runs is not known here, so no line joins them.
std::string plots(const ReportInput& input, const std::string& split, const Abscissa& abscissa) {
  std::int64_t least = INT64_MAX, most = 0;
  for (const ReportRun& run : input.runs) {
    if (!has_labels(run)) continue;
    least = std::min(least, (*run.labels).*abscissa.count);
    most = std::max(most, (*run.labels).*abscissa.count);
  }
  std::string figures;
  for (const std::string_view key : {"miou", "total_accuracy"}) {
    PlotSpec spec{std::string(report_metric(key).label), abscissa.label, false, true, 3, {}};
    spec.log_x = least > 0 && most >= 10 * least;
    for (std::size_t i = 0; i < input.runs.size(); ++i) {
      const ReportRun& run = input.runs[i];
      const auto value = last_value(run, split, key);
      if (has_labels(run) && value)
        spec.series.push_back(
            {run.name, static_cast<int>(i), {{static_cast<double>((*run.labels).*abscissa.count), *value}}});
    }
    if (spec.series.empty()) continue;
    figures +=
        fmt::format("<figure class=\"panel\"><figcaption>{}<span>{}</span></figcaption>\n{}</figure>\n", spec.title,
                    spec.log_x ? "logarithmic number of labels" : "higher is better", line_plot(spec));
  }
  return figures;
}

std::string step_names(const LabelCounts& labels) {
  std::vector<std::string> names;
  for (const TrainingLabels::Step& step : labels.steps) names.push_back(step.type);
  return join(names, ", ");
}

// A paragraph per step: "RUN, DEGRADATION: pixels changed 12345, pixels drawn 20000."
std::string step_facts(const ReportInput& input) {
  std::string out;
  for (const ReportRun& run : input.runs) {
    if (!run.labels) continue;
    for (const TrainingLabels::Step& step : run.labels->steps) {
      std::vector<std::string> facts;
      for (const auto& [name, value] : step.facts) facts.push_back(name + " " + value);
      if (facts.empty()) continue;
      out += fmt::format("<p class=\"hint after\">{}, {}: {}.</p>\n", html_escape(run.name), html_escape(step.type),
                         html_escape(join(facts, ", ")));
    }
  }
  return out;
}

// A paragraph a round of self-training.
std::string round_facts(const ReportInput& input) {
  std::string out;
  for (const ReportRun& run : input.runs) {
    if (!run.labels) continue;
    for (const SelfTrainingRound& round : run.labels->rounds)
      out += fmt::format("<p class=\"hint after\">{}, {}.</p>\n", html_escape(run.name), html_escape(round.text()));
  }
  return out;
}

struct Column {
  const char *head, *hint;
  std::string split, key;
};

std::string table(const ReportInput& input, const std::string& split) {
  // The last two are of runs with report.training_frames: what the labels were worth, and what was made of them.
  const std::array<Column, 4> all{{{"mIoU", "", split, "miou"},
                                   {"Total accuracy", "", split, "total_accuracy"},
                                   {"mIoU of the labels", "against the scene’s own", "train", "given_miou"},
                                   {"mIoU at their poses", "of the field", "train", "miou"}}};
  std::vector<Column> columns;
  for (const Column& column : all) {
    const auto has = [&](const ReportRun& run) { return run.labels && last_value(run, column.split, column.key); };
    if (std::any_of(input.runs.begin(), input.runs.end(), has)) columns.push_back(column);
  }
  std::string head =
      "<tr><th scope=\"col\">Run</th><th scope=\"col\" class=\"num\">Labelled frames</th>"
      "<th scope=\"col\" class=\"num\">Labelled pixels</th><th scope=\"col\" class=\"num\">Classes with labels</th>";
  for (const Column& column : columns)
    head +=
        fmt::format("<th scope=\"col\" class=\"num\">{}<small class=\"d\">{}</small></th>", column.head, column.hint);
  std::string body;
  for (const ReportRun& run : input.runs) {
    if (!has_labels(run)) continue;
    const LabelCounts& labels = *run.labels;
    const auto taught = std::count_if(labels.classes.begin(), labels.classes.end(),
                                      [](const LabelCounts::Class& c) { return c.pixels > 0; });
    const std::string steps = step_names(labels);
    const double share =
        labels.train_px > 0 ? static_cast<double>(labels.labelled_px) / static_cast<double>(labels.train_px) : 0;
    body += fmt::format(
        "<tr><th scope=\"row\">{}{}</th><td class=\"num\">{} of {}</td><td class=\"num\">{}<small class=\"d\">{} of "
        "all</small></td><td class=\"num\">{} of {}</td>",
        html_escape(run.name), steps.empty() ? "" : fmt::format("<small class=\"d\">{}</small>", html_escape(steps)),
        count_text(labels.labelled_frames), count_text(labels.train_frames), count_text(labels.labelled_px),
        percent_text(share), taught, labels.classes.size());
    for (const Column& column : columns) body += value_cell(last_value(run, column.split, column.key), 4, false);
    body += "</tr>\n";
  }
  return table_panel("Labels of each run", head + "</tr>", body) + step_facts(input) + round_facts(input);
}

}  // namespace

std::string labels_section(const ReportInput& input, const std::string& split) {
  const auto known = std::count_if(input.runs.begin(), input.runs.end(), has_labels);
  if (known == 0) return {};
  std::string out = open_section(
      "labels", known > 1 ? "Error against number of labels" : "Labels in training",
      known > 1 ? "One point for each run, at its last evaluation; runs may differ in more than their labels."
                : "What the semantic head learned from.");
  if (known > 1 && unranked_because(input, split).empty()) {
    const std::string pixels = plots(input, split, kPixels);
    if (!pixels.empty()) {
      out += legend(input) +
             "<input class=\"pick\" type=\"checkbox\" id=\"label-frames\"><label for=\"label-frames\">count labelled "
             "frames</label>\n<div class=\"plots one\">\n" +
             pixels + "</div>\n<div class=\"plots two\">\n" + plots(input, split, kFrames) + "</div>\n";
    }
  }
  return out + table(input, split) +
         missing_runs(input, "Left out, because their folders hold no labels.json (made by an older version):",
                      [](const ReportRun& run) { return !run.labels; }) +
         missing_runs(input, "Left out, because their scenes have no classes:",
                      [](const ReportRun& run) { return run.labels && !has_labels(run); }) +
         "</section>\n";
}

}  // namespace semfield
