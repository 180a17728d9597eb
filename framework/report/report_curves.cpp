// Error against run time: curves, and how soon they came near their ends.
#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>

#include "core/error.h"
#include "report/html.h"
#include "report/report_comparison.h"
#include "report/report_convergence.h"
#include "report/report_parts.h"
#include "report/report_sections.h"
#include "report/report_svg.h"

namespace semfield {

namespace {

std::string time_cell(const std::optional<LevelTime>& time, bool best) {
  if (!time) return value_cell(std::nullopt, 0, false);
  return fmt::format("<td class=\"num{}\">{}{}{}</td>", best ? " best" : "", time->at_first ? "≤ " : "",
                     duration_text(time->not_after_s),
                     !time->at_first ? ""
                     : time->only    ? "<small class=\"d\">its only evaluation</small>"
                                     : "<small class=\"d\">its first evaluation</small>");
}

// Seconds after which each run first reached the level that the weakest run ended at.
std::string time_to_level(const ReportInput& input, const std::string& split) {
  if (input.runs.size() < 2 || !unranked_because(input, split).empty()) return {};
  const std::vector<std::vector<const MetricsRow*>> rows = level_rows(input, split);
  std::string body;
  for (const std::string_view key : {"psnr", "miou_present", "absrel"}) {
    const ReportMetric& metric = report_metric(key);
    std::optional<double> level;
    bool everywhere = true;
    for (const auto& evaluations : rows) {
      const auto value = evaluations.empty() ? std::nullopt : evaluations.back()->get(key);
      if (!value || !std::isfinite(*value)) {
        everywhere = false;
      } else if (!level || metric.better * (*value - *level) < 0) {
        level = value;
      }
    }
    if (!everywhere || !level) continue;
    std::vector<std::optional<LevelTime>> times;
    for (const auto& evaluations : rows) times.push_back(time_of_level(evaluations, key, metric.better, *level));
    const int best = first_for_certain(times);
    body +=
        fmt::format("<tr><th scope=\"row\">{} {} {}{}</th>", html_escape(metric.label), metric.better > 0 ? "≥" : "≤",
                    figure_text(*level, metric.digits), metric.unit.empty() ? "" : fmt::format(" {}", metric.unit));
    for (std::size_t i = 0; i < times.size(); ++i) body += time_cell(times[i], best == static_cast<int>(i));
    body += "</tr>\n";
  }
  if (body.empty()) return {};
  return "<h3>Time to a common level</h3>\n<p class=\"hint\">Training time of the first evaluation at the level that "
         "every run ended at or beyond. A run came there between that evaluation and the one before; “≤” says that "
         "there was none before. Bold: first for certain.</p>\n" +
         table_panel("Time to reach a level", fmt::format("<tr><th scope=\"col\">Level</th>{}</tr>", run_heads(input)),
                     body);
}

// The part of the split that every curve is of: "" for all of it; none when runs differ.
std::optional<std::string> common_part(const ReportInput& input, const std::string& split) {
  std::optional<std::string> common;
  for (const ReportRun& run : input.runs) {
    const std::vector<const MetricsRow*> rows = curve_rows(run, split);
    if (rows.empty()) continue;
    const std::string part = sample_text(*rows.front());
    if (common && *common != part) return std::nullopt;
    common = part;
  }
  return common.value_or("");
}

// What the values at the lines' ends are of.
std::string parts_sentence(const ReportInput& input, const std::string& split) {
  if (const auto common = common_part(input, split)) {
    if (common->empty()) return {};
    std::string out = fmt::format(" Evaluations while training are of a sample: {}.", *common);
    const std::vector<const MetricsRow*> last = eval_rows(input.runs.front(), split);
    if (input.runs.size() == 1 && !last.empty() && sample_text(*last.back()) != *common)
      out += fmt::format(" The figures above are of {}, so they differ from the ends of the curves.",
                         part_text(*last.back()));
    return out;
  }
  std::vector<std::string> parts;
  for (const ReportRun& run : input.runs) {
    const std::vector<const MetricsRow*> rows = curve_rows(run, split);
    if (rows.empty()) continue;
    const std::string part = sample_text(*rows.front());
    parts.push_back(html_escape(run.name) + ": " + (part.empty() ? "all frames" : "a sample, " + part));
  }
  return " The curves are of different parts of the split: " + join(parts, "; ") + ".";
}

struct Curve {
  std::string key, title, note;
  bool from_training, log_y;
  int digits;
};

// One for each term of the list `losses` too, in the order in which rows name them.
std::vector<Curve> curves_of(const ReportInput& input) {
  std::vector<Curve> curves{{"loss", "Training loss", "logarithmic", true, true, 3},
                            {"psnr", "PSNR", "dB, higher is better", false, false, 3},
                            {"miou_present", "mIoU (present)", "higher is better", false, false, 3},
                            {"absrel", "Depth AbsRel", "logarithmic, lower is better", false, true, 2}};
  constexpr std::string_view kTerm = "loss_";
  for (const ReportRun& run : input.runs) {
    for (const MetricsRow& row : run.rows) {
      for (const auto& [key, value] : row.values) {
        if (row.kind != "train" || !value || !key.starts_with(kTerm) || key == "loss_color" || key == "loss_semantic")
          continue;
        const auto same = [&key = key](const Curve& curve) { return curve.key == key; };
        if (std::any_of(curves.begin(), curves.end(), same)) continue;
        curves.push_back({key, "Loss: " + key.substr(kTerm.size()), "logarithmic, before its weight", true, true, 3});
      }
    }
  }
  return curves;
}

struct TimeUnit {
  double seconds;
  const char* label;
};

TimeUnit time_unit(double longest_s) {
  if (longest_s <= 600) return {1, "seconds of training"};
  return longest_s <= 3 * 3600 ? TimeUnit{60, "minutes of training"} : TimeUnit{3600, "hours of training"};
}

// Values over seconds of training.
std::vector<PlotPoint> points_of(const ReportRun& run, const Curve& curve, const std::string& split) {
  std::vector<const MetricsRow*> rows;
  if (curve.from_training) {
    for (const MetricsRow& row : run.rows) {
      if (row.kind == "train") rows.push_back(&row);
    }
  } else {
    rows = curve_rows(run, split);
  }
  std::vector<PlotPoint> points;
  for (const MetricsRow* row : rows) {
    const auto value = row->get(curve.key);
    if (value && std::isfinite(*value)) points.push_back({row->train_s, *value});
  }
  return points;
}

constexpr std::array<double, 2> kShares{0.9, 0.95};

PlotSeries series_of(const ReportRun& run, int color, const Curve& curve, const std::string& split, double unit_s) {
  PlotSeries series{run.name, color, {}};
  const std::vector<PlotPoint> points = points_of(run, curve, split);
  for (const PlotPoint& p : thin_points(points, 240)) series.points.push_back({p.x / unit_s, p.y});
  if (curve.from_training) return series;
  for (const double share : kShares) {
    const auto seconds = time_to_share(points, report_metric(curve.key).better, share);
    if (seconds)
      series.marks.push_back(
          {*seconds / unit_s, share != kShares[0],
           fmt::format("{}: {} of the way after {}", run.name, percent_text(share), duration_text(*seconds))});
  }
  return series;
}

std::string plots(const ReportInput& input, const std::string& split, const TimeUnit& unit, bool log_x) {
  const std::string part = common_part(input, split).value_or("");
  std::string figures;
  for (const Curve& curve : curves_of(input)) {
    PlotSpec spec{curve.title, unit.label, curve.log_y, !curve.from_training, curve.digits, {}};
    spec.log_x = log_x;
    for (std::size_t i = 0; i < input.runs.size(); ++i)
      spec.series.push_back(series_of(input.runs[i], static_cast<int>(i), curve, split, unit.seconds));
    if (std::all_of(spec.series.begin(), spec.series.end(), [](const PlotSeries& s) { return s.points.empty(); }))
      continue;
    figures += fmt::format(
        "<figure class=\"panel\"><figcaption>{}<span>{}</span></figcaption>\n{}</figure>\n", curve.title,
        curve.from_training || part.empty() ? curve.note : fmt::format("{}; {}", curve.note, part), line_plot(spec));
  }
  return figures;
}

// A logarithmic axis shows more where times span a decade.
bool spans_a_decade(const ReportInput& input) {
  double first = INFINITY, last = 0;
  for (const ReportRun& run : input.runs) {
    for (const MetricsRow& row : run.rows) {
      if (row.train_s <= 0) continue;
      first = std::min(first, row.train_s);
      last = std::max(last, row.train_s);
    }
  }
  return last >= 10 * first;
}

std::string convergence_table(const ReportInput& input, const std::string& split) {
  const std::vector<Curve> all = curves_of(input);
  std::vector<const Curve*> curves;
  for (const Curve& curve : all) {
    const auto evaluated = [&](const ReportRun& run) { return !points_of(run, curve, split).empty(); };
    if (!curve.from_training && std::any_of(input.runs.begin(), input.runs.end(), evaluated)) curves.push_back(&curve);
  }
  if (curves.empty()) return {};
  std::string groups = "<th scope=\"col\" rowspan=\"2\">Run</th>", heads;
  for (const Curve* curve : curves) {
    const ReportMetric& metric = report_metric(curve->key);
    groups += fmt::format("<th scope=\"colgroup\" colspan=\"3\" class=\"grp\">{}{}</th>", metric.label,
                          metric.unit.empty() ? "" : fmt::format(", {}", metric.unit));
    heads +=
        "<th scope=\"col\" class=\"num\">last</th><th scope=\"col\" class=\"num\">t90</th><th scope=\"col\" "
        "class=\"num\">t95</th>";
  }
  std::string body;
  for (const ReportRun& run : input.runs) {
    body += fmt::format("<tr><th scope=\"row\">{}</th>", html_escape(run.name));
    for (const Curve* curve : curves) {
      const std::vector<PlotPoint> points = points_of(run, *curve, split);
      const ReportMetric& metric = report_metric(curve->key);
      body += points.empty() ? value_cell(std::nullopt, 0, false)
                             : fmt::format("<td class=\"num\">{}<small class=\"d\">from {}</small></td>",
                                           figure_text(points.back().y, metric.digits),
                                           figure_text(points.front().y, metric.digits));
      for (const double share : kShares) {
        const auto seconds = time_to_share(points, metric.better, share);
        body += seconds ? fmt::format("<td class=\"num\">{}</td>", duration_text(*seconds))
                        : value_cell(std::nullopt, 0, false);
      }
    }
    body += "</tr>\n";
  }
  return "<h3>Time to the last value</h3>\n<p class=\"hint\">t90 and t95 are the training time at which a curve, read "
         "as straight lines between evaluations, first covers 90&#160;% and 95&#160;% of the way "
         "from its first to its last value; a later dip does not count. In the plots: ring and diamond. Every run is "
         "held against its own last value, so a run that ends low can be quick. A dash: fewer than two evaluations, or "
         "the last is no better than the first.</p>\n" +
         table_panel("Time to 90 % and 95 % of the last value", fmt::format("<tr>{}</tr><tr>{}</tr>", groups, heads),
                     body);
}

}  // namespace

std::string curves_section(const ReportInput& input, const std::string& split) {
  double longest = 0;
  for (const ReportRun& run : input.runs) longest = std::max(longest, trained_s(run));
  const TimeUnit unit = time_unit(longest);
  const std::string linear = plots(input, split, unit, false);
  if (linear.empty()) return {};
  std::string out =
      open_section(
          "curves", "Error against run time",
          fmt::format("Time is training alone; evaluation and output are not counted. The number at a line’s end is "
                      "its last value.{}",
                      parts_sentence(input, split))) +
      legend(input);
  if (spans_a_decade(input)) {  // two drawings and a box between them: the page needs no script
    out +=
        "<input class=\"pick\" type=\"checkbox\" id=\"log-time\"><label for=\"log-time\">logarithmic "
        "time</label>\n<div class=\"plots one\">\n" +
        linear + "</div>\n<div class=\"plots two\">\n" + plots(input, split, unit, true) + "</div>\n";
  } else {
    out += "<div class=\"plots\">\n" + linear + "</div>\n";
  }
  return out + convergence_table(input, split) + time_to_level(input, split) + "</section>\n";
}

}  // namespace semfield
