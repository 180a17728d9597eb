// Figures, classes, pictures and set-up.
#include "report/report_sections.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <filesystem>
#include <iterator>
#include <nlohmann/json.hpp>
#include <numeric>
#include <set>
#include <span>

#include "config/config_tree.h"
#include "core/check.h"
#include "core/error.h"
#include "report/html.h"
#include "report/report.h"
#include "report/report_comparison.h"
#include "scene/classes/class_table.h"
#include "scene/scene.h"
#include "system/checksum.h"
#include "system/files.h"

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

namespace {

constexpr std::array<ReportMetric, 23> kMetrics{{
    {"miou", "mIoU", "", 4, 1, "mean over classes with a non-empty union"},
    {"miou_present", "mIoU (present)", "", 4, 1, "mean over classes that occur in truth"},
    {"total_accuracy", "Total accuracy", "", 4, 1, "share of pixels with the right class"},
    {"average_accuracy", "Average accuracy", "", 4, 1, "mean recall over classes in truth"},
    {"psnr", "PSNR", "dB", 4, 1, "from the squared error pooled over the split"},
    {"psnr_fitted_colors", "PSNR, colours fitted", "dB", 4, 1,
     "each half of a frame under the map of colours that fits the other half"},
    {"psnr_refined_poses", "PSNR, poses fitted", "dB", 4, 1, "each frame from the pose that fits the field"},
    {"ssim", "SSIM", "", 4, 1, "mean over images"},
    {"absrel", "AbsRel", "", 3, -1, "depth: mean |error| / truth"},
    {"absdiff", "AbsDiff", "m", 3, -1, "depth: mean |error|"},
    {"sqrel", "SqRel", "m", 3, -1, "depth: mean error² / truth"},
    {"rmse", "RMSE", "m", 3, -1, "depth"},
    {"delta1", "δ < 1.25", "", 4, 1, "depth: share of pixels within that factor"},
    {"delta2", "δ < 1.25²", "", 4, 1, "depth: share of pixels within that factor"},
    {"delta3", "δ < 1.25³", "", 4, 1, "depth: share of pixels within that factor"},
    {"depth_coverage", "Depth coverage", "", 4, 1, "share of valid truth with a prediction"},
    {"under_resolved", "Under-resolved", "", 3, -1,
     "share of opaque pixels whose opacity came in one or two long steps"},
    {"ece", "ECE", "", 3, -1, "expected calibration error, 15 bins"},
    {"nll", "NLL", "nats", 3, -1, "of the true class, a pixel"},
    {"entropy_auroc", "Entropy AUROC", "", 3, 1, "entropy as a detector of wrong pixels; 0.5 is chance"},
    {"rays_per_s", "Rays per second", "", 3, 1, "last training row"},
    {"samples_per_ray", "Samples per ray", "", 3, 0, "last training row"},
    {"loss", "Training loss", "", 3, 0, "last training row"},
}};

}  // namespace

std::span<const ReportMetric> report_metrics() { return kMetrics; }

const ReportMetric& report_metric(std::string_view key) {
  return *std::find_if(kMetrics.begin(), kMetrics.end(), [&](const ReportMetric& m) { return m.key == key; });
}

std::vector<const MetricsRow*> eval_rows(const ReportRun& run, const std::string& split) {
  std::vector<const MetricsRow*> rows;
  for (const MetricsRow& row : run.rows)
    if (row.kind == "eval" && (split.empty() || row.split == split || row.split == split + kSampleSuffix))
      rows.push_back(&row);
  if (rows.empty()) return rows;
  const MetricsRow& last = *rows.back();
  std::erase_if(
      rows, [&](const MetricsRow* row) { return row->split != last.split || sample_text(*row) != sample_text(last); });
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

std::string percent_text(double share) {
  if (share > 0 && share < 0.001) return "under 0.1 %";
  return fmt::format("{:.{}f} %", 100 * share, share > 0 && share < 0.01 ? 1 : 0);
}

std::string count_text(std::int64_t count) {
  const std::string digits = std::to_string(count);
  std::string text;
  for (std::size_t i = 0; i < digits.size(); ++i) {
    if (i > 0 && (digits.size() - i) % 3 == 0) text += ',';
    text += digits[i];
  }
  return text;
}

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

std::string open_section(std::string_view id, std::string_view title, std::string_view hint) {
  return fmt::format("<section id=\"{}\" aria-labelledby=\"{}-h\">\n<h2 id=\"{}-h\">{}</h2>\n{}", id, id, id, title,
                     hint.empty() ? "" : fmt::format("<p class=\"hint\">{}</p>\n", hint));
}

std::string table_panel(std::string_view label, const std::string& head, const std::string& body) {
  return fmt::format(
      "<div class=\"panel scroll\" tabindex=\"0\" role=\"region\" "
      "aria-label=\"{}\"><table>\n<thead>{}</thead>\n<tbody>\n{}</tbody></table></div>\n",
      label, head, body);
}

std::string value_cell(const std::optional<double>& value, int digits, bool best) {
  if (!value) return "<td class=\"num none\">–</td>";
  return fmt::format("<td class=\"num{}\">{}</td>", best ? " best" : "", figure_text(*value, digits));
}

std::string run_heads(const ReportInput& input, const std::string& split) {
  std::string out;
  for (const ReportRun& run : input.runs) {
    const std::string sample = split.empty() ? "" : sample_text(run, split);
    out += fmt::format("<th scope=\"col\" class=\"num\">{}{}</th>", html_escape(run.name),
                       sample.empty() ? "" : fmt::format("<small class=\"d\">sample: {}</small>", sample));
  }
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

std::string swatch(const std::array<std::uint8_t, 3>& color) {
  return fmt::format("<span class=\"sw\" style=\"background:rgb({} {} {})\"></span>", color[0], color[1], color[2]);
}

std::string named_runs(std::string_view sentence, const std::vector<std::string>& names) {
  return names.empty() ? std::string()
                       : fmt::format("<p class=\"hint after\">{} {}.</p>\n", sentence, html_escape(join(names, ", ")));
}

// The head of the report: what the runs are, what to mind about them, and their largest figures.

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

// The view in 3D at the top of the report: a page of its own inside the page.

namespace {

// The text of the first script element without attributes.
std::string_view script_of(std::string_view page) {
  constexpr std::string_view kBegin = "<script>", kEnd = "</script>";
  const std::size_t begin = page.find(kBegin);
  if (begin == std::string_view::npos) return {};
  const std::size_t from = begin + kBegin.size();
  return page.substr(from, page.find(kEnd, from) - from);
}

std::string digest_base64(std::string_view text) {
  Sha256 sum;
  sum.add(std::as_bytes(std::span(text)));
  const std::string digits = sum.hex();
  std::vector<std::uint8_t> bytes(digits.size() / 2);
  for (std::size_t i = 0; i < bytes.size(); ++i)
    std::from_chars(digits.data() + 2 * i, digits.data() + 2 * i + 2, bytes[i], 16);
  return base64(bytes);
}

}  // namespace

std::string scene_section(const ReportInput& input) {
  if (input.scene.empty()) return {};
  // Read once it is in sight: most of the file is this page.
  const std::string of_first = input.runs.size() > 1 ? " of " + html_escape(input.runs.front().name) : std::string();
  return open_section("scene", "3D", "A coarse mesh" + of_first + ". Drag to turn; click it first to zoom.") +
         "<iframe loading=\"lazy\" title=\"The scene in three dimensions\" srcdoc=\"" + html_escape(input.scene) +
         "\"></iframe></section>\n";
}

// A page inside has the policy of the one around it too [CSP3, Sec. 7.8].
std::string content_policy(const ReportInput& input) {
  std::string policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'";
  if (!input.scene.empty()) policy += "; script-src 'sha256-" + digest_base64(script_of(input.scene)) + "'";
  return policy;
}

// A report's input, read from run folders.

namespace fs = std::filesystem;

namespace {

struct ImageKind {
  const char *suffix, *caption;
};
constexpr std::array<ImageKind, 7> kKinds{{{"_clicks.png", "photograph, clicks"},
                                           {"_rgb_truth.png", "colour, truth"},
                                           {"_rgb.png", "colour, rendered"},
                                           {"_label_truth_vis.png", "label, truth"},
                                           {"_label_vis.png", "label, rendered"},
                                           {"_entropy_vis.png", "entropy"},
                                           {"_depth_vis.png", "depth"}}};

std::string text_or_empty(const std::string& path) {
  return fs::is_regular_file(path) ? read_text_file(path) : std::string();
}

// Folder name, or with its parent's when another run has the same.
std::string unique_name(const fs::path& folder, std::set<std::string>& taken) {
  const fs::path path = fs::absolute(folder).lexically_normal();
  const fs::path leaf = path.has_filename() ? path : path.parent_path();
  const std::string base = leaf.filename().string();
  std::string name = base;
  if (taken.contains(name)) name = leaf.parent_path().filename().string() + "/" + base;
  for (int number = 2; !taken.insert(name).second; ++number) name = fmt::format("{} ({})", base, number);
  return name;
}

// "TYPE, room_0": the dataset's type and the folder or file that it lies in.
std::string scene_of(const std::string& config, const std::string& path) {
  if (config.empty()) return {};
  const ConfigNode root = parse_config_text(config, path);
  const ConfigNode* scene = root.find("scene");
  if (scene == nullptr || !scene->is_map()) return {};
  std::string text;
  for (const char* key : {"type", "root", "file"}) {
    const ConfigNode* value = scene->find(key);
    if (value == nullptr || !value->is_scalar() || value->text().empty()) continue;
    const fs::path place = fs::path(value->text()).lexically_normal();
    text += (text.empty() ? "" : ", ") + (place.has_filename() ? place : place.parent_path()).filename().string();
  }
  return text;
}

ReportStrip read_strip(const fs::path& folder, const std::string& name, const std::string& note) {
  ReportStrip strip{name, note, {}};
  for (const ImageKind& kind : kKinds) {
    const std::string bytes = text_or_empty((folder / (name + kind.suffix)).string());
    if (!bytes.empty()) strip.images.push_back({kind.caption, std::vector<std::uint8_t>(bytes.begin(), bytes.end())});
  }
  return strip;
}

// `apart`: frames that are shown elsewhere.
std::vector<ReportStrip> read_strips(const fs::path& folder, int most_frames, const std::set<std::string>& apart) {
  std::set<std::string> frames, with_truth;  // frames shown beside their truth come first
  if (fs::is_directory(folder)) {
    for (const fs::directory_entry& entry : sorted_folder(folder.string())) {
      const std::string name = entry.path().filename().string();
      if (name.ends_with("_rgb.png")) frames.insert(name.substr(0, name.size() - 8));
      if (name.ends_with("_rgb_truth.png")) with_truth.insert(name.substr(0, name.size() - 14));
    }
  }
  if (!with_truth.empty()) frames = with_truth;
  std::vector<std::string> all;
  std::set_difference(frames.begin(), frames.end(), apart.begin(), apart.end(), std::back_inserter(all));
  const std::size_t count = std::min(all.size(), static_cast<std::size_t>(std::max(0, most_frames)));
  std::vector<ReportStrip> strips;
  for (std::size_t i = 0; i < count; ++i) strips.push_back(read_strip(folder, all[i * all.size() / count], {}));
  return strips;
}

}  // namespace

std::string worst_frames_json(const std::vector<WorstFrame>& frames) {
  nlohmann::ordered_json json = nlohmann::ordered_json::array();
  for (const WorstFrame& frame : frames) json.push_back({{"frame", frame.name}, {"score", frame.note}});
  return json.dump(2, ' ', false, nlohmann::ordered_json::error_handler_t::replace) + "\n";
}

std::vector<WorstFrame> parse_worst_frames(std::string_view json, const std::string& name) {
  std::vector<WorstFrame> frames;
  try {
    for (const nlohmann::json& row : nlohmann::json::parse(json)) frames.push_back({row.at("frame"), row.at("score")});
  } catch (const nlohmann::json::exception& e) {
    throw Error(ErrorKind::data, "run.record.damaged", fmt::format("'{}' cannot be read: {}", name, e.what()),
                "delete it; a report does without");
  }
  return frames;
}

ReportInput read_report_input(const std::vector<std::string>& run_folders, int most_frames) {
  if (run_folders.empty())
    throw Error(ErrorKind::usage, "usage.word.missing", "a report needs a run folder",
                "give one or more folders that `train` printed");
  ReportInput input;
  std::set<std::string> taken;
  std::vector<std::string> names;
  for (const std::string& path : run_folders) {
    const RunFolder folder = RunFolder::read(path);
    ReportRun run;
    run.name = unique_name(path, taken);
    run.rows = read_metrics(folder.metrics_path());
    run.config = text_or_empty(folder.config_path());
    run.scene = scene_of(run.config, folder.config_path());
    const std::string environment = text_or_empty(folder.environment_path());
    if (!environment.empty()) run.environment = parse_environment(environment, folder.environment_path());
    const std::string left_out = text_or_empty(folder.left_out_path());
    if (!left_out.empty()) run.left_out = parse_left_out(left_out, folder.left_out_path());
    const std::string labels = text_or_empty(folder.labels_path());
    if (!labels.empty()) run.labels = parse_label_counts(labels, folder.labels_path());
    const std::string eval = text_or_empty(folder.final_eval_path());
    if (!eval.empty()) run.eval = parse_final_eval(eval, folder.final_eval_path());
    const std::string clicked = text_or_empty(folder.labelling_path());
    if (!clicked.empty()) run.clicked = parse_labelling_record(clicked, folder.labelling_path());
    names.push_back(run.name);
    input.runs.push_back(std::move(run));
  }
  const RunFolder first = RunFolder::read(run_folders.front());
  if (fs::is_regular_file(first.classes_path())) {
    const ClassTable table = ClassTable::load(first.classes_path());
    for (int c = 0; c < table.valid_count(); ++c) input.classes.push_back({table.valid(c).name, table.valid(c).color});
  }
  input.split = report_split(input.runs.front().rows);
  const fs::path render = fs::path(first.path()) / "render" / (input.split.empty() ? "test" : input.split);
  std::set<std::string> apart;
  const std::string worst = text_or_empty(first.worst_frames_path());
  if (!worst.empty()) {
    for (const WorstFrame& frame : parse_worst_frames(worst, first.worst_frames_path())) {
      const std::string file = output_name(frame.name);
      ReportStrip strip = read_strip(render, file, frame.note);
      if (strip.images.empty()) continue;
      apart.insert(file);
      input.worst.push_back(std::move(strip));
    }
  }
  input.strips = read_strips(render, most_frames, apart);
  if (input.strips.empty()) input.strips = read_strips(render, most_frames, {});  // a sample as small as the worst
  if (const std::optional<LabellingRecord>& clicked = input.runs.front().clicked) {
    for (const LabellingRecord::Frame& frame : clicked->shown) {
      ReportStrip strip = read_strip(fs::path(first.path()) / "render" / "labelled", output_name(frame.name),
                                     fmt::format("{} click{}", frame.clicks, frame.clicks == 1 ? "" : "s"));
      strip.name = frame.name;
      if (!strip.images.empty()) input.clicked.push_back(std::move(strip));
    }
  }
  input.title = join(names, " · ");
  return input;
}

// Error against the number of labels.

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

struct LabelColumn {
  const char *head, *hint;
  std::string split, key;
};

std::string table(const ReportInput& input, const std::string& split) {
  // The last two are of runs with report.training_frames: what the labels were worth, and what was made of them.
  const std::array<LabelColumn, 4> all{{{"mIoU", "", split, "miou"},
                                   {"Total accuracy", "", split, "total_accuracy"},
                                   {"mIoU of the labels", "against the scene’s own", "train", "given_miou"},
                                   {"mIoU at their poses", "of the field", "train", "miou"}}};
  std::vector<LabelColumn> columns;
  for (const LabelColumn& column : all) {
    const auto has = [&](const ReportRun& run) { return run.labels && last_value(run, column.split, column.key); };
    if (std::any_of(input.runs.begin(), input.runs.end(), has)) columns.push_back(column);
  }
  std::string head =
      "<tr><th scope=\"col\">Run</th><th scope=\"col\" class=\"num\">Labelled frames</th>"
      "<th scope=\"col\" class=\"num\">Labelled pixels</th><th scope=\"col\" class=\"num\">Classes with labels</th>";
  for (const LabelColumn& column : columns)
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
    for (const LabelColumn& column : columns) body += value_cell(last_value(run, column.split, column.key), 4, false);
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

// What was clicked on the labelling page: classes, and pictures of frames.

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

// What the final evaluation reports beside figures: confusions, calibration and the scores of every frame.

namespace {

constexpr const char* kNoDetail =
    "Left out, because their folders hold no final_eval.json (made by an older version, or not ended):";
constexpr std::size_t kMostClasses = 64;  // rows of a table that can still be read
constexpr std::size_t kMostConfusions = 5;

bool without_detail(const ReportRun& run) { return !run.eval; }

std::string px_text(std::int64_t pixels) { return count_text(pixels) + " px"; }

double ratio(std::int64_t part, std::int64_t whole) {
  return whole > 0 ? static_cast<double>(part) / static_cast<double>(whole) : 0;
}

// Sums of a confusion matrix.
struct Totals {
  std::vector<std::int64_t> truth, predicted;  // [classes]
  std::int64_t all = 0, wrong = 0;
  explicit Totals(const FinalEval& eval) : truth(eval.classes.size()), predicted(eval.classes.size()) {
    for (std::size_t t = 0; t < truth.size(); ++t) {
      for (std::size_t p = 0; p < truth.size(); ++p) {
        truth[t] += eval.count(t, p);
        predicted[p] += eval.count(t, p);
        all += eval.count(t, p);
        if (t != p) wrong += eval.count(t, p);
      }
    }
  }
};

struct Confusion {
  std::size_t truth, predicted;
  std::int64_t pixels;
  double share;  // of the true class
};

// "chair read as table: 12 % of chair", with pixels beneath.
std::string words_list(const FinalEval& eval, const Totals& totals, std::string_view title,
                       std::vector<Confusion> found) {
  found.resize(std::min(found.size(), kMostConfusions));
  std::string out = fmt::format("<div><h4>{}</h4>\n<ul>\n", title);
  for (const Confusion& c : found) {
    const FinalEval::Class &truth = eval.classes[c.truth], &predicted = eval.classes[c.predicted];
    out += fmt::format("<li>{}{} read as {}{}: {} of {}<small class=\"d\">{}, {} of all wrong pixels</small></li>\n",
                       swatch(truth.color), html_escape(truth.name), swatch(predicted.color),
                       html_escape(predicted.name), percent_text(c.share), html_escape(truth.name), px_text(c.pixels),
                       percent_text(ratio(c.pixels, totals.wrong)));
  }
  return out + "</ul></div>\n";
}

// The largest confusions twice: those that cost most pixels are of large classes, those that hide a class of small
// ones.
std::string confusions_in_words(const FinalEval& eval, const Totals& totals) {
  std::vector<Confusion> found;
  for (std::size_t t = 0; t < eval.classes.size(); ++t) {
    for (std::size_t p = 0; p < eval.classes.size(); ++p) {
      if (t != p && eval.count(t, p) > 0)
        found.push_back({t, p, eval.count(t, p), ratio(eval.count(t, p), totals.truth[t])});
    }
  }
  if (found.empty()) return "<p class=\"hint\">Every scored pixel has its class.</p>\n";
  std::stable_sort(found.begin(), found.end(),
                   [](const Confusion& a, const Confusion& b) { return a.pixels > b.pixels; });
  const std::string by_pixels = words_list(eval, totals, "Most pixels", found);
  std::stable_sort(found.begin(), found.end(),
                   [](const Confusion& a, const Confusion& b) { return a.share > b.share; });
  return "<div class=\"words\">\n" + by_pixels + words_list(eval, totals, "Largest share of a class", found) +
         "</div>\n";
}

std::string confusion_cell(const FinalEval& eval, const Totals& totals, std::size_t t, std::size_t p) {
  const std::int64_t pixels = eval.count(t, p);
  if (pixels == 0) return "<td></td>";
  const double share = ratio(pixels, totals.truth[t]);
  // The root shows small fractions; half of full colour keeps the figures legible.
  return fmt::format("<td class=\"{}\" style=\"--p:{:.0f}%\" title=\"{} read as {}: {} of {}, {}\">{}</td>",
                     t == p ? "ok" : "no", 60 * std::sqrt(share), html_escape(eval.classes[t].name),
                     html_escape(eval.classes[p].name), percent_text(share), html_escape(eval.classes[t].name),
                     px_text(pixels), share < 0.005 ? "·" : fmt::format("{:.0f}", 100 * share));
}

// Classes shown, by position: all, or those with most pixels in truth and prediction.
std::vector<std::size_t> shown_classes(const Totals& totals) {
  std::vector<std::size_t> shown(totals.truth.size());
  std::iota(shown.begin(), shown.end(), std::size_t{0});
  if (shown.size() <= kMostClasses) return shown;
  std::stable_sort(shown.begin(), shown.end(), [&](std::size_t a, std::size_t b) {
    return totals.truth[a] + totals.predicted[a] > totals.truth[b] + totals.predicted[b];
  });
  shown.resize(kMostClasses);
  std::sort(shown.begin(), shown.end());
  return shown;
}

std::string confusion_table(const FinalEval& eval, const Totals& totals) {
  const std::vector<std::size_t> shown = shown_classes(totals);
  std::string head = "<tr><th scope=\"col\" class=\"row\">truth ↓ read as →</th>", body;
  for (const std::size_t p : shown) {
    const FinalEval::Class& c = eval.classes[p];
    head += fmt::format("<th scope=\"col\" title=\"{}\"><span class=\"v\">{}{} {}</span></th>", html_escape(c.name),
                        swatch(c.color), c.id, html_escape(c.name));
  }
  head += "<th scope=\"col\" class=\"num\">pixels</th></tr>";
  for (const std::size_t t : shown) {
    if (totals.truth[t] == 0) continue;  // read, but never true: a column alone
    const FinalEval::Class& c = eval.classes[t];
    body += fmt::format("<tr><th scope=\"row\" class=\"row\" title=\"{}\">{}<span class=\"none\">{}</span> {}</th>",
                        html_escape(c.name), swatch(c.color), c.id, html_escape(c.name));
    for (const std::size_t p : shown) body += confusion_cell(eval, totals, t, p);
    body += fmt::format("<td class=\"num\">{}</td></tr>\n", count_text(totals.truth[t]));
  }
  std::string out =
      "<div class=\"scroll\" tabindex=\"0\" role=\"region\" aria-label=\"Confusion matrix\"><table "
      "class=\"cm\">\n<thead>" +
      head + "</thead>\n<tbody>\n" + body + "</tbody></table></div>\n";
  if (shown.size() < eval.classes.size()) {
    out += fmt::format(
        "<p class=\"hint after\">The {} of {} classes with the most pixels; `semfield eval --json` prints all.</p>\n",
        shown.size(), eval.classes.size());
  }
  return out;
}

// "over-confident by 3 %".
std::string lean_text(const FinalEval& eval) {
  double pixels = 0, confidence = 0, accuracy = 0;
  for (const FinalEval::Bin& bin : eval.bins) {
    pixels += static_cast<double>(bin.pixels);
    confidence += static_cast<double>(bin.pixels) * bin.confidence;
    accuracy += static_cast<double>(bin.pixels) * bin.accuracy;
  }
  const double lean = pixels > 0 ? (confidence - accuracy) / pixels : 0;
  const std::string means = fmt::format("Mean confidence {:.3f}, accuracy {:.3f}", confidence / std::max(1.0, pixels),
                                        accuracy / std::max(1.0, pixels));
  if (std::abs(lean) < 0.0005) return means;
  return fmt::format("{}: {} by {:.3f}", means, lean > 0 ? "over-confident" : "under-confident", std::abs(lean));
}

// What entropy says of wrong labels; empty in files of versions that did not count it.
std::string entropy_text(const FinalEval& eval) {
  if (!eval.entropy_auroc) return {};
  return fmt::format(" AUROC {}: in {} of all pairs of a wrong and a right pixel the wrong one has the higher entropy.",
                     figure_text(eval.entropy_auroc->value, 3), percent_text(eval.entropy_auroc->value));
}

std::string reliability(const ReportRun& run, int color) {
  const FinalEval& eval = *run.eval;
  std::int64_t all = 0;
  for (const FinalEval::Bin& bin : eval.bins) all += bin.pixels;
  PlotSpec spec{"Accuracy", "confidence", false, true, 3, {{run.name, color, {}}}};
  spec.x_range = spec.y_range = PlotRange{0, 1};
  spec.end_values = false;
  PlotSeries& series = spec.series.front();
  std::string rows;
  const auto bins = static_cast<double>(eval.bins.size());
  for (std::size_t b = 0; b < eval.bins.size(); ++b) {
    const FinalEval::Bin& bin = eval.bins[b];
    if (bin.pixels == 0) continue;
    const double from = static_cast<double>(b) / bins, to = static_cast<double>(b + 1) / bins,
                 share = ratio(bin.pixels, all);
    series.points.push_back({bin.confidence, bin.accuracy});
    series.bars.push_back({from, to, share,
                           fmt::format("confidence {:.2f} to {:.2f}: {} of the pixels, accuracy {:.3f}", from, to,
                                       percent_text(share), bin.accuracy)});
    rows += fmt::format(
        "<tr><th scope=\"row\">{:.2f} to {:.2f}</th><td class=\"num\">{}</td><td class=\"num\">{}</td><td "
        "class=\"num\">{:.3f}</td><td class=\"num\">{:.3f}</td><td class=\"num\">{}</td></tr>\n",
        from, to, count_text(bin.pixels), percent_text(share), bin.confidence, bin.accuracy,
        figure_text(std::round(1000 * (bin.accuracy - bin.confidence)) / 1000, 3));
  }
  spec.series.push_back({"perfect calibration", 0, {{0, 0}, {1, 1}}});
  spec.series.back().reference = true;
  const std::optional<double> ece = eval.ece();
  return fmt::format(
      "<figure class=\"panel\"><figcaption>{}<span>{}</span></figcaption>\n{}<p class=\"hint "
      "note\">{}.{}</p>\n<details><summary>Bins</summary><div class=\"scroll\" tabindex=\"0\" role=\"region\" "
      "aria-label=\"Reliability bins\"><table><thead><tr><th scope=\"col\">Confidence</th><th scope=\"col\" "
      "class=\"num\">Pixels</th>"
      "<th scope=\"col\" class=\"num\">Share</th><th scope=\"col\" class=\"num\">Mean confidence</th><th scope=\"col\" "
      "class=\"num\">Accuracy</th><th scope=\"col\" class=\"num\">Accuracy − "
      "confidence</th></tr></thead>\n<tbody>\n{}</tbody></table></div></details></figure>\n",
      html_escape(run.name),
      ece ? "ECE " + figure_text(*ece, 3)
          : fmt::format("no ECE: {} without finite probabilities", px_text(eval.nonfinite_px)),
      line_plot(spec), lean_text(eval), entropy_text(eval), rows);
}

// Entropy at training poses by what the label was worth, of runs with report.training_frames.
std::string given_table(const ReportInput& input) {
  struct Column {
    const char *head, *hint, *key;
  };
  constexpr Column kColumns[] = {{"Labelled rightly", "mean entropy, nats", "given_right_entropy"},
                                 {"Labelled wrongly", "mean entropy, nats", "given_wrong_entropy"},
                                 {"Unlabelled", "mean entropy, nats", "given_none_entropy"},
                                 {"Wrong against right", "AUROC of entropy", "given_wrong_auroc"},
                                 {"Unlabelled against labelled", "AUROC of entropy", "given_none_auroc"}};
  std::string head = "<tr><th scope=\"col\">Run</th>", body;
  for (const Column& c : kColumns)
    head += fmt::format("<th scope=\"col\" class=\"num\">{}<small class=\"d\">{}</small></th>", c.head, c.hint);
  for (const ReportRun& run : input.runs) {
    std::string cells;
    bool any = false;
    for (const Column& c : kColumns) {
      const std::optional<double> value = last_value(run, "train", c.key);
      any = any || value;
      cells += value_cell(value, 3, false);
    }
    if (any) body += fmt::format("<tr><th scope=\"row\">{}</th>{}</tr>\n", html_escape(run.name), cells);
  }
  if (body.empty()) return {};
  return "<p class=\"hint after\">Entropy of the pixels of training frames, by the label that they were given. An "
         "AUROC of 0.5 is chance; 1 means that entropy separates the two groups.</p>\n" +
         table_panel("Entropy by the label given", head + "</tr>", body);
}

// Worst first; frames without a mIoU after those with one, by PSNR.
std::vector<const FrameScore*> by_miou(const FinalEval& eval) {
  std::vector<const FrameScore*> order;
  for (const FrameScore& frame : eval.frames) order.push_back(&frame);
  const auto key = [](const FrameScore* f) {
    return std::pair(f->miou_present.value_or(2), f->psnr_db.value_or(INFINITY));
  };
  std::stable_sort(order.begin(), order.end(),
                   [&](const FrameScore* a, const FrameScore* b) { return key(a) < key(b); });
  return order;
}

std::string frames_table(const ReportRun& run, bool several) {
  std::string body;
  for (const FrameScore* frame : by_miou(*run.eval)) {
    body += fmt::format("<tr><th scope=\"row\">{}</th>{}{}{}</tr>\n", html_escape(frame->name),
                        value_cell(frame->miou_present, 4, false), value_cell(frame->psnr_db, 4, false),
                        value_cell(frame->absrel, 3, false));
  }
  return fmt::format(
      "<details><summary>Scores of all {} frames{}</summary><div class=\"scroll\" tabindex=\"0\" role=\"region\" "
      "aria-label=\"Scores of frames\"><table><thead><tr><th scope=\"col\">Frame</th><th scope=\"col\" "
      "class=\"num\">mIoU (present)</th>"
      "<th scope=\"col\" class=\"num\">PSNR, dB</th><th scope=\"col\" "
      "class=\"num\">AbsRel</th></tr></thead>\n<tbody>\n{}</tbody></table></div></details>\n",
      run.eval->frames.size(), several ? ": " + html_escape(run.name) : "", body);
}

}  // namespace

std::string confusion_section(const ReportInput& input) {
  std::string body;
  const bool several = input.runs.size() > 1;
  for (const ReportRun& run : input.runs) {
    if (!run.eval || run.eval->classes.empty()) continue;
    const Totals totals(*run.eval);
    if (totals.all == 0) continue;
    const std::string matrix = confusions_in_words(*run.eval, totals) + confusion_table(*run.eval, totals);
    body += several ? fmt::format("<details{}><summary>{}</summary>\n{}</details>\n", body.empty() ? " open" : "",
                                  html_escape(run.name), matrix)
                    : "<div class=\"pad\">" + matrix + "</div>\n";
  }
  if (body.empty()) return {};
  return open_section("confusion", "Confusions",
                      "Which classes are taken for which, over all pixels of the last evaluation. A row holds all "
                      "pixels of a true class and sums to 100 %; “·” is less than half a per cent.") +
         "<div class=\"panel\">\n" + body + "</div>\n" + missing_runs(input, kNoDetail, without_detail) +
         "</section>\n";
}

std::string calibration_section(const ReportInput& input) {
  std::string figures;
  for (std::size_t i = 0; i < input.runs.size(); ++i) {
    const ReportRun& run = input.runs[i];
    if (run.eval && !run.eval->bins.empty()) figures += reliability(run, static_cast<int>(i));
  }
  const std::string given = given_table(input);
  if (figures.empty() && given.empty()) return {};
  return open_section(
             "calibration", "Calibration",
             "Does a class with probability 0.8 turn out right in 80 % of the cases? Dots: share of right pixels over "
             "mean confidence, in 15 bins; on the dotted line it is as sure as it is right, below it too sure. "
             "Bars: share of all pixels that a bin holds. ECE is the mean distance from the line, weighted by "
             "pixels. AUROC says how well entropy finds wrong pixels: 0.5 is chance, 1 is all wrong pixels above all "
             "right ones.") +
         "<div class=\"plots\">\n" + figures + "</div>\n" + given + missing_runs(input, kNoDetail, without_detail) +
         "</section>\n";
}

std::string worst_section(const ReportInput& input, const std::string& of_first) {
  std::string tables;
  for (const ReportRun& run : input.runs) {
    if (run.eval && !run.eval->frames.empty()) tables += frames_table(run, input.runs.size() > 1);
  }
  if (input.worst.empty() && tables.empty()) return {};
  if (!tables.empty()) tables = "<div class=\"panel below\">\n" + tables + "</div>\n";
  return open_section("worst", "Worst frames",
                      input.worst.empty() ? "" : "The frames with the lowest scores, worst first." + of_first) +
         strip_panels(input.worst) + tables + "</section>\n";
}

// Error against run time: curves, and how soon they came near their ends.

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

std::optional<double> time_to_share(const std::vector<PlotPoint>& curve, int better, double share) {
  SEMFIELD_CHECK(better == 1 || better == -1, "a curve has a better direction");
  SEMFIELD_CHECK(share >= 0 && share <= 1, "a share lies between 0 and 1");
  std::vector<PlotPoint> finite;
  for (const PlotPoint& p : curve) {
    if (std::isfinite(p.x) && std::isfinite(p.y)) finite.push_back(p);
  }
  if (finite.size() < 2 || better * (finite.back().y - finite.front().y) <= 0) return std::nullopt;
  const double level = finite.front().y + share * (finite.back().y - finite.front().y);
  for (std::size_t i = 1; i < finite.size(); ++i) {
    const PlotPoint &before = finite[i - 1], &after = finite[i];
    if (better * (after.y - level) < 0) continue;
    // The point before lies below the level, or this is the first segment and the level its start.
    const double way = after.y - before.y;
    return way == 0 ? before.x : before.x + (level - before.y) / way * (after.x - before.x);
  }
  return finite.back().x;  // rounding kept the last value a hair from its own level
}

}  // namespace semfield
