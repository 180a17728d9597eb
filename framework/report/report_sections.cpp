// Figures, classes, pictures and set-up.
#include "report/report_sections.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>

#include "core/error.h"
#include "report/html.h"
#include "report/report_comparison.h"
#include "report/report_parts.h"

namespace semfield {

namespace {

// The value a table shows: the last evaluation, or the last training row for what only training knows.
std::optional<double> table_value(const ReportRun& run, const std::string& split, std::string_view key) {
  if (const auto value = last_value(run, split, key)) return value;
  if (key != "rays_per_s" && key != "samples_per_ray" && key != "loss") return std::nullopt;
  for (auto row = run.rows.rbegin(); row != run.rows.rend(); ++row) {
    if (row->kind == "train" && row->get(key)) return row->get(key);
  }
  return std::nullopt;
}

}  // namespace

std::string figures_section(const ReportInput& input, const std::string& split) {
  const bool ranked = unranked_because(input, split).empty();
  const bool sampled = std::any_of(input.runs.begin(), input.runs.end(),
                                   [&](const ReportRun& run) { return !sample_text(run, split).empty(); });
  std::string body;
  for (const ReportMetric& metric : report_metrics()) {
    std::vector<std::optional<double>> values;
    for (const ReportRun& run : input.runs) values.push_back(table_value(run, split, metric.key));
    if (std::none_of(values.begin(), values.end(), [](const auto& v) { return v.has_value(); })) continue;
    const int best = ranked ? best_run(values, metric.better) : -1;
    body += fmt::format("<tr><th scope=\"row\">{}{}<small class=\"d\">{}</small></th>", html_escape(metric.label),
                        metric.unit.empty() ? "" : fmt::format(" <span class=\"none\">{}</span>", metric.unit),
                        html_escape(metric.help));
    for (std::size_t i = 0; i < values.size(); ++i)
      body += value_cell(values[i], metric.digits, best == static_cast<int>(i));
    body += "</tr>\n";
  }
  body += "<tr><th scope=\"row\">Training time<small class=\"d\">evaluation not counted</small></th>";
  for (const ReportRun& run : input.runs)
    body += fmt::format("<td class=\"num\">{}</td>", duration_text(trained_s(run)));
  body += "</tr>\n";
  const bool scored = std::any_of(input.runs.begin(), input.runs.end(),
                                  [&](const ReportRun& run) { return !eval_rows(run, split).empty(); });
  const std::string hint =
      !scored ? "No frame was scored: the scene has no test frames, or the run has not come to an evaluation."
              : fmt::format("Last evaluation{}{}.{}", split.empty() ? "" : " on the split “" + html_escape(split) + "”",
                            sampled ? ", of the sample that the head names" : "",
                            input.runs.size() < 2 ? ""
                            : ranked              ? " The best of each row is set in bold."
                                                  : " The runs are not ranked; the reason is at the top.");
  return open_section("figures", "Figures", hint) + "<div class=\"figures\">" +
         table_panel("Figures", fmt::format("<tr><th scope=\"col\">Metric</th>{}</tr>", run_heads(input, split)),
                     body) +
         "</div>"
         "</section>\n";
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
      const auto found =
          std::find_if(of_run[i].begin(), of_run[i].end(), [&](const auto& e) { return e.first == entry.name; });
      listed = listed || found != of_run[i].end();
      const bool scored = found != of_run[i].end() && found->second.has_value();
      if (!scored) {
        tracks += "<div class=\"tr\"></div>";
        values += "<div class=\"none\">no data</div>";
        continue;
      }
      const std::string paint = single ? fmt::format("rgb({} {} {})", entry.color[0], entry.color[1], entry.color[2])
                                       : fmt::format("var(--s{})", i % 8);
      tracks += fmt::format("<div class=\"tr\"><i style=\"width:{:.1f}%;background:{}\"></i></div>",
                            100 * std::clamp(*found->second, 0.0, 1.0), paint);
      values += fmt::format("<div>{:.3f}</div>", *found->second);
    }
    if (!listed) continue;
    bars += fmt::format(
        "<div class=\"bar\"><span class=\"name\"><span class=\"sw\" style=\"background:rgb({} {} "
        "{})\"></span>{}</span><span>{}</span><span class=\"val\">{}</span></div>\n",
        entry.color[0], entry.color[1], entry.color[2], html_escape(entry.name), tracks, values);
  }
  if (bars.empty()) return {};
  return open_section("classes", "Intersection over union by class",
                      single ? "Bars run from 0 to 1, in the colours of the label images."
                             : "Bars run from 0 to 1, in the order and colours of the legend.") +
         legend(input) + "<div class=\"panel bars\">\n" + bars + "</div>\n</section>\n";
}

std::string frames_section(const std::vector<ReportStrip>& strips, const std::string& of_first) {
  if (strips.empty()) return {};
  const std::vector<ReportImage>& images = strips.front().images;
  const bool entropy =
      std::any_of(images.begin(), images.end(), [](const ReportImage& image) { return image.caption == "entropy"; });
  std::string out = open_section("frames", "Rendered frames",
                                 (entropy ? "Entropy runs over its full range, 0 to ln C; depth is bright where near."
                                          : "Depth is bright where near.") +
                                     of_first) +
                    strip_panels({strips.front()});
  if (strips.size() > 1)
    out +=
        fmt::format("<details class=\"panel more\"><summary>{} more frame{}</summary>\n{}</details>\n",
                    strips.size() - 1, strips.size() > 2 ? "s" : "", strip_panels({strips.begin() + 1, strips.end()}));
  return out + "</section>\n";
}

std::string strip_panels(const std::vector<ReportStrip>& strips) {
  std::string out;
  for (const ReportStrip& strip : strips) {
    out += fmt::format("<div class=\"panel strip\"><h3>{}{}</h3>\n<div class=\"imgs\">\n", html_escape(strip.name),
                       strip.note.empty() ? "" : fmt::format("<span>{}</span>", html_escape(strip.note)));
    for (const ReportImage& image : strip.images) {
      out += fmt::format(
          "<figure><img alt=\"{}, frame {}\" loading=\"lazy\" src=\"{}\"><figcaption>{}</figcaption></figure>\n",
          html_escape(image.caption), html_escape(strip.name), png_data_uri(image.png), html_escape(image.caption));
    }
    out += "</div></div>\n";
  }
  return out;
}

std::string left_out_section(const ReportInput& input) {
  // A row that several runs have stands once, with their names.
  struct Row {
    const LeftOutRow* row;
    std::vector<std::string> runs;
  };
  std::vector<Row> rows;
  for (const ReportRun& run : input.runs) {
    for (const LeftOutRow& row : run.left_out) {
      const auto known = std::find_if(rows.begin(), rows.end(), [&](const Row& r) { return *r.row == row; });
      if (known == rows.end()) {
        rows.push_back({&row, {run.name}});
      } else {
        known->runs.push_back(run.name);
      }
    }
  }
  if (rows.empty()) return {};
  const auto small = [](const std::string& text) {
    return text.empty() ? "" : fmt::format("<small class=\"d\">{}</small>", html_escape(text));
  };
  std::string body;
  for (const auto& [row, runs] : rows) {
    const std::string of = input.runs.size() < 2              ? ""
                           : runs.size() == input.runs.size() ? "every run"
                                                              : join(runs, ", ");
    body += fmt::format(
        "<tr><th scope=\"row\">{}{}{}</th><td>{}</td><td>{}{}</td><td>{}</td></tr>\n", html_escape(row->component),
        small(row->rule), small(of), html_escape(row->evidence), html_escape(row->saving_estimate),
        small(row->saving_measured.empty() ? "" : "measured: " + row->saving_measured), html_escape(row->proof));
  }
  return open_section("left-out", "Left out, and why",
                      "Parts that this scene does not need were not built. Proof: B, bitwise the same result; C, "
                      "within a certified bound; S, the same within statistics.") +
         "<div class=\"left-out\">" +
         table_panel("Left out",
                     "<tr><th scope=\"col\">Component</th><th scope=\"col\">Found here</th><th "
                     "scope=\"col\">Saving</th><th scope=\"col\">Proof</th></tr>",
                     body) +
         "</div></section>\n";
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
        rows += fmt::format("<tr><th scope=\"row\">{}</th><td class=\"code\">{}</td></tr>\n", html_escape(label),
                            html_escape(value));
      }
      body += fmt::format(
          "<details><summary>Environment{}</summary><div "
          "class=\"scroll\"><table><tbody>\n{}</tbody></table></div></details>\n",
          suffix, rows);
    }
    if (!run.config.empty()) {
      body += fmt::format("<details><summary>Configuration{}</summary><pre tabindex=\"0\">{}</pre></details>\n", suffix,
                          html_escape(run.config));
    }
  }
  if (body.empty()) return {};
  return open_section("setup", "Set-up", "What it takes to repeat the run.") + "<div class=\"panel\">\n" + body +
         "</div>\n</section>\n";
}

}  // namespace semfield
