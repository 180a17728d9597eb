// The parts of the report.
#include "train/report_sections.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>

#include "train/html.h"
#include "train/report_svg.h"

namespace semfield {

namespace {

constexpr std::array<ReportMetric, 19> kMetrics{{
    {"miou", "mIoU", "", 4, 1, "mean over classes with a non-empty union"},
    {"miou_present", "mIoU, present classes", "", 4, 1, "mean over classes that occur in truth"},
    {"total_accuracy", "Total accuracy", "", 4, 1, "share of pixels with the right class"},
    {"average_accuracy", "Average accuracy", "", 4, 1, "mean recall over classes in truth"},
    {"psnr", "PSNR", "dB", 4, 1, "from the squared error pooled over the split"},
    {"ssim", "SSIM", "", 4, 1, "mean over images"},
    {"absrel", "AbsRel", "", 3, -1, "depth: mean |error| / truth"},
    {"absdiff", "AbsDiff", "m", 3, -1, "depth: mean |error|"},
    {"sqrel", "SqRel", "m", 3, -1, "depth: mean error² / truth"},
    {"rmse", "RMSE", "m", 3, -1, "depth"},
    {"delta1", "δ < 1.25", "", 4, 1, "depth: share of pixels within that factor"},
    {"delta2", "δ < 1.25²", "", 4, 1, "depth: share of pixels within that factor"},
    {"delta3", "δ < 1.25³", "", 4, 1, "depth: share of pixels within that factor"},
    {"coverage", "Depth coverage", "", 4, 1, "share of valid truth with a prediction"},
    {"ece", "ECE", "", 3, -1, "expected calibration error, 15 bins"},
    {"nll", "NLL", "nats", 3, -1, "of the true class, a pixel"},
    {"rays_per_s", "Rays a second", "", 3, 1, "last training row"},
    {"samples_per_ray", "Samples a ray", "", 3, 0, "last training row"},
    {"loss", "Training loss", "", 3, 0, "last training row"},
}};

std::string open_section(std::string_view id, std::string_view title, std::string_view hint) {
  return fmt::format("<section id=\"{}\" aria-labelledby=\"{}-h\">\n<h2 id=\"{}-h\">{}</h2>\n{}", id, id, id, title,
                     hint.empty() ? "" : fmt::format("<p class=\"hint\">{}</p>\n", hint));
}

// The value a table shows: the last evaluation, or the last training row for what only training knows.
std::optional<double> table_value(const ReportRun& run, const std::string& split, std::string_view key) {
  if (const auto value = last_value(run, split, key)) return value;
  if (key != "rays_per_s" && key != "samples_per_ray" && key != "loss") return std::nullopt;
  for (auto row = run.rows.rbegin(); row != run.rows.rend(); ++row) {
    if (row->kind == "train" && row->get(key)) return row->get(key);
  }
  return std::nullopt;
}

// Index of the best run of a metric; -1 with fewer than two different values.
int best_run(const std::vector<std::optional<double>>& values, int better) {
  int best = -1, present = 0;
  bool different = false;
  for (std::size_t i = 0; i < values.size(); ++i) {
    if (!values[i] || std::isnan(*values[i])) continue;
    ++present;
    if (best >= 0 && *values[i] != *values[static_cast<std::size_t>(best)]) different = true;
    if (best < 0 || better * (*values[i] - *values[static_cast<std::size_t>(best)]) > 0) best = static_cast<int>(i);
  }
  return better != 0 && present > 1 && different ? best : -1;
}

std::string value_cell(const std::optional<double>& value, int digits, bool best) {
  if (!value) return "<td class=\"num none\">–</td>";
  return fmt::format("<td class=\"num{}\">{}</td>", best ? " best" : "", figure_text(*value, digits));
}

std::string run_heads(const ReportInput& input) {
  std::string out;
  for (const ReportRun& run : input.runs) out += fmt::format("<th scope=\"col\" class=\"num\">{}</th>", html_escape(run.name));
  return out;
}

std::string legend(const ReportInput& input) {
  if (input.runs.size() < 2) return {};
  std::string out = "<ul class=\"legend\">\n";
  for (std::size_t i = 0; i < input.runs.size(); ++i) {
    out += fmt::format("<li>{}{}</li>\n", line_sample(static_cast<int>(i)), html_escape(input.runs[i].name));
  }
  return out + "</ul>\n";
}

}  // namespace

std::vector<const MetricsRow*> eval_rows(const ReportRun& run, const std::string& split) {
  std::vector<const MetricsRow*> rows;
  for (const MetricsRow& row : run.rows) {
    if (row.kind == "eval" && (split.empty() || row.split == split)) rows.push_back(&row);
  }
  return rows;
}

std::optional<double> last_value(const ReportRun& run, const std::string& split, std::string_view key) {
  std::optional<double> value;
  for (const MetricsRow* row : eval_rows(run, split)) {
    if (const auto found = row->get(key)) value = found;
  }
  return value;
}

double trained_s(const ReportRun& run) {
  double seconds = 0;
  for (const MetricsRow& row : run.rows) seconds = std::max(seconds, row.train_s);
  return seconds;
}

std::string duration_text(double seconds) {
  if (seconds < 100) return fmt::format("{} s", figure_text(seconds, 3));
  const auto whole = static_cast<std::int64_t>(std::llround(seconds));
  if (whole < 3600) return fmt::format("{} min {:02d} s", whole / 60, whole % 60);
  return fmt::format("{} h {:02d} min", whole / 3600, whole % 3600 / 60);
}

std::string cards_section(const ReportInput& input, const std::string& split) {
  std::string out = "<div class=\"cards\">\n";
  const bool several = input.runs.size() > 1;
  const auto card = [&](std::string_view label, const std::string& value, std::string_view unit, const std::string& note) {
    out += fmt::format("<div class=\"card\"><div class=\"k\">{}</div><div class=\"v\">{}{}</div><div class=\"n\">{}</div></div>\n", label, value,
                       unit.empty() ? "" : fmt::format("<span class=\"u\">{}</span>", unit), html_escape(note));
  };
  for (const std::string_view key : {"miou", "total_accuracy", "psnr", "absrel"}) {
    const ReportMetric& metric = *std::find_if(kMetrics.begin(), kMetrics.end(), [&](const ReportMetric& m) { return m.key == key; });
    std::vector<std::optional<double>> values;
    for (const ReportRun& run : input.runs) values.push_back(last_value(run, split, key));
    int best = best_run(values, metric.better);
    for (std::size_t i = 0; best < 0 && i < values.size(); ++i) {
      if (values[i]) best = static_cast<int>(i);
    }
    if (best < 0) continue;
    const auto b = static_cast<std::size_t>(best);
    card(metric.label, figure_text(*values[b], key == "absrel" ? 2 : 3), metric.unit, several ? "best: " + input.runs[b].name : std::string(metric.help));
  }
  double longest = 0;
  std::int64_t step = 0;
  for (const ReportRun& run : input.runs) {
    longest = std::max(longest, trained_s(run));
    for (const MetricsRow& row : run.rows) step = std::max(step, row.step);
  }
  card(several ? "Longest training" : "Training", duration_text(longest), "", fmt::format("{} steps, evaluation not counted", step));
  return out + "</div>\n";
}

std::string figures_section(const ReportInput& input, const std::string& split) {
  std::string body;
  for (const ReportMetric& metric : kMetrics) {
    std::vector<std::optional<double>> values;
    for (const ReportRun& run : input.runs) values.push_back(table_value(run, split, metric.key));
    if (std::none_of(values.begin(), values.end(), [](const auto& v) { return v.has_value(); })) continue;
    const int best = best_run(values, metric.better);
    body += fmt::format("<tr><th scope=\"row\">{}{}<small class=\"d\">{}</small></th>", metric.label,
                        metric.unit.empty() ? "" : fmt::format(" <span class=\"none\">{}</span>", metric.unit), metric.help);
    for (std::size_t i = 0; i < values.size(); ++i) body += value_cell(values[i], metric.digits, best == static_cast<int>(i));
    body += "</tr>\n";
  }
  body += "<tr><th scope=\"row\">Training time<small class=\"d\">evaluation not counted</small></th>";
  for (const ReportRun& run : input.runs) body += fmt::format("<td class=\"num\">{}</td>", duration_text(trained_s(run)));
  body += "</tr>\n";
  const std::string hint = fmt::format("Last evaluation{}.{}", split.empty() ? "" : " on the split “" + html_escape(split) + "”",
                                       input.runs.size() > 1 ? " The best of each row is set in bold." : "");
  return open_section("figures", "Figures", hint) +
         fmt::format("<div class=\"panel scroll\" tabindex=\"0\" role=\"region\" aria-labelledby=\"figures-h\"><table>\n<thead><tr><th scope=\"col\">Metric</th>{}</tr></thead>\n<tbody>\n{}</tbody></table></div>\n</section>\n",
                     run_heads(input), body);
}

namespace {

// Seconds after which each run first reached the level that the weakest run ended at.
std::string time_to_level(const ReportInput& input, const std::string& split) {
  if (input.runs.size() < 2) return {};
  std::string body;
  for (const std::string_view key : {"psnr", "miou", "absrel"}) {
    const ReportMetric& metric = *std::find_if(kMetrics.begin(), kMetrics.end(), [&](const ReportMetric& m) { return m.key == key; });
    std::optional<double> level;
    bool everywhere = true;
    for (const ReportRun& run : input.runs) {
      const auto value = last_value(run, split, key);
      if (!value || !std::isfinite(*value)) {
        everywhere = false;
      } else if (!level || metric.better * (*value - *level) < 0) {
        level = value;
      }
    }
    if (!everywhere || !level) continue;
    std::vector<std::optional<double>> seconds;
    for (const ReportRun& run : input.runs) {
      std::optional<double> first;
      for (const MetricsRow* row : eval_rows(run, split)) {
        const auto value = row->get(key);
        if (!first && value && metric.better * (*value - *level) >= 0) first = row->train_s;
      }
      seconds.push_back(first);
    }
    const int best = best_run(seconds, -1);
    body += fmt::format("<tr><th scope=\"row\">{} {} {}{}</th>", metric.label, metric.better > 0 ? "≥" : "≤", figure_text(*level, metric.digits),
                        metric.unit.empty() ? "" : fmt::format(" {}", metric.unit));
    for (std::size_t i = 0; i < seconds.size(); ++i) {
      body += seconds[i] ? fmt::format("<td class=\"num{}\">{}</td>", best == static_cast<int>(i) ? " best" : "", duration_text(*seconds[i]))
                         : std::string("<td class=\"num none\">–</td>");
    }
    body += "</tr>\n";
  }
  if (body.empty()) return {};
  return fmt::format("<p class=\"hint\" style=\"margin-top:20px\">Training time until the first evaluation at the level that every run reached.</p>\n"
                     "<div class=\"panel scroll\" tabindex=\"0\" role=\"region\" aria-label=\"Time to reach a level\"><table><thead><tr><th scope=\"col\">Level</th>{}</tr></thead>\n<tbody>\n{}</tbody></table></div>\n",
                     run_heads(input), body);
}

}  // namespace

// Evaluations while training may score a sample of the split ("test_sample"): a curve holds those alone, because its last point
// would otherwise be of other frames than the rest.
std::string curve_split(const ReportInput& input, const std::string& split) {
  const std::string sample = split + kSampleSuffix;
  for (const ReportRun& run : input.runs) {
    if (eval_rows(run, sample).size() < 2) return split;
  }
  return sample;
}

std::string curves_section(const ReportInput& input, const std::string& whole_split) {
  const std::string split = curve_split(input, whole_split);
  double longest = 0;
  for (const ReportRun& run : input.runs) longest = std::max(longest, trained_s(run));
  const double unit_s = longest <= 600 ? 1 : longest <= 3 * 3600 ? 60 : 3600;
  const char* unit = unit_s == 1 ? "seconds of training" : unit_s == 60 ? "minutes of training" : "hours of training";
  struct Curve {
    const char *key, *title, *note;
    bool from_training, log_y;
    int digits;
  };
  constexpr std::array<Curve, 4> kCurves{{{"loss", "Training loss", "logarithmic", true, true, 3},
                                          {"psnr", "PSNR", "dB, higher is better", false, false, 3},
                                          {"miou", "mIoU", "higher is better", false, false, 3},
                                          {"absrel", "Depth AbsRel", "logarithmic, lower is better", false, true, 2}}};
  std::string figures;
  for (const Curve& curve : kCurves) {
    PlotSpec spec{curve.title, unit, curve.log_y, !curve.from_training, curve.digits, {}};
    bool any = false;
    for (std::size_t i = 0; i < input.runs.size(); ++i) {
      PlotSeries series{input.runs[i].name, static_cast<int>(i), {}};
      for (const MetricsRow& row : input.runs[i].rows) {
        const bool wanted = curve.from_training ? row.kind == "train" : row.kind == "eval" && (split.empty() || row.split == split);
        const auto value = wanted ? row.get(curve.key) : std::nullopt;
        if (value && std::isfinite(*value)) series.points.push_back({row.train_s / unit_s, *value});
      }
      any = any || !series.points.empty();
      series.points = thin_points(series.points, 240);
      spec.series.push_back(std::move(series));
    }
    if (!any) continue;
    figures += fmt::format("<figure class=\"panel\"><figcaption>{}<span>{}</span></figcaption>\n{}</figure>\n", curve.title, curve.note, line_plot(spec));
  }
  if (figures.empty()) return {};
  return open_section("curves", "Error against run time", fmt::format("Time is training alone; evaluation and output are not counted. The number at a line’s end is its last value{}.",
                                  split == whole_split ? "" : ", on the sample of frames that was scored while training")) +
         legend(input) + "<div class=\"plots\">\n" + figures + "</div>\n" + time_to_level(input, split) + "</section>\n";
}

std::string classes_section(const ReportInput& input, const std::string& split) {
  using Entries = std::vector<std::pair<std::string, std::optional<double>>>;
  std::vector<Entries> of_run;
  for (const ReportRun& run : input.runs) {
    Entries last;
    for (const MetricsRow* row : eval_rows(run, split)) {
      if (!row->per_class_iou.empty()) last = row->per_class_iou;
    }
    of_run.push_back(std::move(last));
  }
  std::vector<ReportClass> classes = input.classes;
  const auto known = [&](const std::string& name) {
    return std::any_of(classes.begin(), classes.end(), [&](const ReportClass& c) { return c.name == name; });
  };
  for (const Entries& entries : of_run) {
    for (const auto& [name, iou] : entries) {
      if (!known(name)) classes.push_back({name, {128, 128, 128}});
    }
  }
  const bool single = input.runs.size() == 1;
  std::string bars;
  for (const ReportClass& entry : classes) {
    std::string tracks, values;
    bool listed = false;
    for (std::size_t i = 0; i < of_run.size(); ++i) {
      const auto found = std::find_if(of_run[i].begin(), of_run[i].end(), [&](const auto& e) { return e.first == entry.name; });
      listed = listed || found != of_run[i].end();
      const bool scored = found != of_run[i].end() && found->second.has_value();
      if (!scored) {
        tracks += "<div class=\"tr\"></div>";
        values += "<div class=\"none\">no data</div>";
        continue;
      }
      const std::string paint =
          single ? fmt::format("rgb({} {} {})", entry.color[0], entry.color[1], entry.color[2]) : fmt::format("var(--s{})", i % 8);
      tracks += fmt::format("<div class=\"tr\"><i style=\"width:{:.1f}%;background:{}\"></i></div>", 100 * std::clamp(*found->second, 0.0, 1.0), paint);
      values += fmt::format("<div>{:.3f}</div>", *found->second);
    }
    if (!listed) continue;
    bars += fmt::format("<div class=\"bar\"><span class=\"name\"><span class=\"sw\" style=\"background:rgb({} {} {})\"></span>{}</span><span>{}</span><span class=\"val\">{}</span></div>\n",
                        entry.color[0], entry.color[1], entry.color[2], html_escape(entry.name), tracks, values);
  }
  if (bars.empty()) return {};
  return open_section("classes", "Intersection over union by class", single ? "Bars run from 0 to 1, in the colours of the label images." : "Bars run from 0 to 1, in the order and colours of the legend.") +
         legend(input) + "<div class=\"panel bars\">\n" + bars + "</div>\n</section>\n";
}

std::string strips_section(const std::vector<ReportStrip>& strips, std::string_view id, std::string_view title, std::string_view hint) {
  if (strips.empty()) return {};
  std::string out = open_section(id, title, hint);
  for (const ReportStrip& strip : strips) {
    out += fmt::format("<div class=\"panel strip\"><h3>{}{}</h3>\n<div class=\"imgs\">\n", html_escape(strip.name),
                       strip.note.empty() ? "" : fmt::format("<span>{}</span>", html_escape(strip.note)));
    for (const ReportImage& image : strip.images) {
      out += fmt::format("<figure><img alt=\"{}, frame {}\" loading=\"lazy\" src=\"{}\"><figcaption>{}</figcaption></figure>\n",
                         html_escape(image.caption), html_escape(strip.name), png_data_uri(image.png), html_escape(image.caption));
    }
    out += "</div></div>\n";
  }
  return out + "</section>\n";
}

std::string left_out_section(const ReportInput& input) {
  std::string body;
  const bool several = input.runs.size() > 1;
  for (const ReportRun& run : input.runs) {
    for (const LeftOutRow& row : run.left_out) {
      body += fmt::format("<tr>{}<th scope=\"row\">{}</th><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td></tr>\n",
                          several ? fmt::format("<td>{}</td>", html_escape(run.name)) : "", html_escape(row.component), html_escape(row.rule),
                          html_escape(row.evidence), html_escape(row.proof), html_escape(row.saving_estimate),
                          row.saving_measured.empty() ? "<span class=\"none\">–</span>" : html_escape(row.saving_measured));
    }
  }
  if (body.empty()) return {};
  return open_section("left-out", "Left out, and why", "Parts that this scene does not need were not built. Proof: B, bitwise the same result; C, within a certified bound; S, the same within statistics.") +
         fmt::format("<div class=\"panel scroll\" tabindex=\"0\" role=\"region\" aria-labelledby=\"left-out-h\"><table><thead><tr>{}<th scope=\"col\">Component</th><th scope=\"col\">Rule</th><th scope=\"col\">Found here</th><th scope=\"col\">Proof</th><th scope=\"col\">Saving, estimated</th><th scope=\"col\">Measured</th></tr></thead>\n<tbody>\n{}</tbody></table></div>\n</section>\n",
                     several ? "<th scope=\"col\">Run</th>" : "", body);
}

std::string environment_section(const ReportInput& input) {
  std::string body;
  for (const ReportRun& run : input.runs) {
    const std::string suffix = input.runs.size() > 1 ? ": " + html_escape(run.name) : std::string();
    if (!run.environment.empty()) {
      std::string rows;
      for (const auto& [key, value] : run.environment) {
        if (value.empty()) continue;
        std::string label = key;
        std::replace(label.begin(), label.end(), '_', ' ');
        rows += fmt::format("<tr><th scope=\"row\">{}</th><td class=\"code\">{}</td></tr>\n", html_escape(label), html_escape(value));
      }
      body += fmt::format("<details><summary>Environment{}</summary><div class=\"scroll\"><table><tbody>\n{}</tbody></table></div></details>\n", suffix, rows);
    }
    if (!run.config.empty()) {
      body += fmt::format("<details><summary>Configuration{}</summary><pre tabindex=\"0\">{}</pre></details>\n", suffix, html_escape(run.config));
    }
  }
  if (body.empty()) return {};
  return open_section("setup", "Set-up", "What it takes to repeat the run.") + "<div class=\"panel\">\n" + body + "</div>\n</section>\n";
}

}  // namespace semfield
