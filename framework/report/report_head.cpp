// The head of the report: what the runs are, what to mind about them, and their largest figures.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "core/error.h"
#include "report/html.h"
#include "report/report_comparison.h"
#include "report/report_parts.h"
#include "report/report_sections.h"

namespace semfield {

namespace {

std::string fact_of(const ReportRun& run, std::string_view name) {
  for (const auto& [key, value] : run.environment) {
    if (key == name) return value;
  }
  return {};
}

// "200 training (20 labelled), 30 test".
std::string frames_text(const ReportRun& run, const std::string& split) {
  std::vector<std::string> parts;
  if (run.labels) {
    parts.push_back(count_text(run.labels->train_frames) + " training");
    if (!run.labels->classes.empty())
      parts.back() += fmt::format(" ({} labelled)", count_text(run.labels->labelled_frames));
  }
  const std::vector<const MetricsRow*> rows = eval_rows(run, split);
  std::optional<double> held_out;
  if (!rows.empty() && split == "test") {
    held_out = rows.back()->get("split_frames");
    if (!held_out && sample_text(*rows.back()).empty()) held_out = rows.back()->get("frames");
  }
  if (held_out) parts.push_back(count_text(std::llround(*held_out)) + " test");
  return join(parts, ", ");
}

struct Fact {
  const char* name;
  std::string value;
};

std::vector<Fact> facts_of(const ReportRun& run, const std::string& split) {
  const std::string version = fact_of(run, "version"), device = fact_of(run, "device");
  std::vector<Fact> facts{{"Scene", run.scene},
                          {"Frames", frames_text(run, split)},
                          {"Started", fact_of(run, "started")},
                          {"Version", version.empty() ? "" : "Semfield " + version},
                          {"Device", device == "cpu" || device.empty() ? fact_of(run, "cpu") : device}};
  return facts;
}

std::int64_t last_step(const ReportRun& run) {
  std::int64_t step = 0;
  for (const MetricsRow& row : run.rows) step = std::max(step, row.step);
  return step;
}

std::string card(std::string_view label, const std::string& value, std::string_view unit, const std::string& note) {
  return fmt::format(
      "<div class=\"card\"><div class=\"k\">{}</div><div class=\"v\">{}{}</div><div class=\"n\">{}</div></div>\n",
      label, value, unit.empty() ? "" : fmt::format("<span class=\"u\">{}</span>", unit), html_escape(note));
}

}  // namespace

std::string facts_section(const ReportInput& input, const std::string& split) {
  std::vector<std::vector<Fact>> facts;
  for (const ReportRun& run : input.runs) facts.push_back(facts_of(run, split));
  // A fact that no run states is left out.
  const auto told = [&](std::size_t f) {
    return std::any_of(facts.begin(), facts.end(), [&](const auto& of_run) { return !of_run[f].value.empty(); });
  };
  if (input.runs.size() == 1) {
    std::string out;
    for (std::size_t f = 0; f < facts[0].size(); ++f) {
      if (told(f))
        out += fmt::format("<div><dt>{}</dt><dd>{}</dd></div>\n", facts[0][f].name, html_escape(facts[0][f].value));
    }
    return out.empty() ? out : "<dl class=\"facts\">\n" + out + "</dl>\n";
  }
  std::string head = "<tr><th scope=\"col\">Run</th>", body;
  for (std::size_t f = 0; f < facts[0].size(); ++f) {
    if (told(f)) head += fmt::format("<th scope=\"col\">{}</th>", facts[0][f].name);
  }
  for (std::size_t r = 0; r < facts.size(); ++r) {
    body += fmt::format("<tr><th scope=\"row\">{}</th>", html_escape(input.runs[r].name));
    for (std::size_t f = 0; f < facts[r].size(); ++f) {
      if (told(f)) body += fmt::format("<td>{}</td>", html_escape(facts[r][f].value));
    }
    body += "</tr>\n";
  }
  return "<div class=\"facts\">" + table_panel("Runs", head + "</tr>", body) + "</div>\n";
}

std::string notice_section(const ReportInput& input, const std::string& split) {
  std::vector<std::string> sentences;
  const std::vector<std::string> reasons =
      input.runs.size() > 1 ? unranked_because(input, split) : std::vector<std::string>();
  if (!reasons.empty()) sentences.push_back("The runs are not ranked: " + join(reasons, "; ") + ".");
  std::vector<std::string> sampled;
  for (const ReportRun& run : input.runs) {
    const std::string sample = sample_text(run, split);
    if (!sample.empty()) sampled.push_back(input.runs.size() > 1 ? run.name + ": " + sample : sample);
  }
  if (!sampled.empty())
    sentences.push_back(
        fmt::format("Figures are of a sample of the split “{}” ({}); `semfield eval` on the run folder "
                    "scores every pixel, and `semfield report` shows that then.",
                    split, join(sampled, "; ")));
  std::string out;
  for (const std::string& sentence : sentences) out += "<p class=\"notice\">" + html_escape(sentence) + "</p>\n";
  return out;
}

std::string cards_section(const ReportInput& input, const std::string& split) {
  std::string out = "<div class=\"cards\">\n";
  const bool several = input.runs.size() > 1;
  const bool ranked = unranked_because(input, split).empty();
  for (const std::string_view key : {"miou_present", "total_accuracy", "psnr", "psnr_fitted_colors",
                                     "psnr_refined_poses", "absrel"}) {
    if (several && !ranked) break;
    const ReportMetric& metric = report_metric(key);
    std::vector<std::optional<double>> values;
    for (const ReportRun& run : input.runs) values.push_back(last_value(run, split, key));
    int best = best_run(values, metric.better);
    for (std::size_t i = 0; best < 0 && i < values.size(); ++i) {
      if (values[i]) best = static_cast<int>(i);
    }
    if (best < 0) continue;
    const auto b = static_cast<std::size_t>(best);
    const std::string note = several ? "best: " + input.runs[b].name : std::string(metric.help);
    const std::string part = part_text(*eval_rows(input.runs[b], split).back());
    out += card(metric.label, figure_text(*values[b], key == "absrel" ? 2 : 3), metric.unit,
                part.empty() ? note : note + "; " + part);
  }
  const auto longest =
      std::max_element(input.runs.begin(), input.runs.end(),
                       [](const ReportRun& a, const ReportRun& b) { return trained_s(a) < trained_s(b); });
  out += card(several ? "Longest training" : "Training", duration_text(trained_s(*longest)), "",
              fmt::format("{}{} steps, evaluation not counted", several ? longest->name + ": " : "",
                          count_text(last_step(*longest))));
  return out + "</div>\n";
}

}  // namespace semfield
