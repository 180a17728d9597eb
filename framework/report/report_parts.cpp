#include "report/report_parts.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>

#include "core/error.h"
#include "report/html.h"
#include "report/report_comparison.h"
#include "report/report_svg.h"

namespace semfield {

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

}  // namespace semfield
