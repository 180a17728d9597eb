// The parts of the report, each a piece of HTML (empty when there is nothing to show).
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "report/html.h"
#include "report/report.h"

namespace semfield {

/// Scene, frames, date, version and device.
std::string facts_section(const ReportInput& input, const std::string& split);
/// Why runs are not ranked, and which figures are of a sample.
std::string notice_section(const ReportInput& input, const std::string& split);
/// Classes and clicks of runs of the labelling page, and pictures of the first. `of_first`: HTML after the sentence
/// about the pictures.
std::string clicks_section(const ReportInput& input, const std::string& of_first);
/// The scene in 3D, which a reader turns.
std::string scene_section(const ReportInput& input);
/// What the page may run and load [CSP3]: images inside of it, and the one script of input.scene.
std::string content_policy(const ReportInput& input);
std::string cards_section(const ReportInput& input, const std::string& split);
std::string figures_section(const ReportInput& input, const std::string& split);
std::string curves_section(const ReportInput& input, const std::string& split);
std::string labels_section(const ReportInput& input, const std::string& split);
std::string classes_section(const ReportInput& input, const std::string& split);
std::string confusion_section(const ReportInput& input);
std::string calibration_section(const ReportInput& input);
/// The first strip, and the others behind a line to click. `of_first`: HTML after the sentence about the pictures.
std::string frames_section(const std::vector<ReportStrip>& strips, const std::string& of_first);
/// The panels of strips, without a section around them.
std::string strip_panels(const std::vector<ReportStrip>& strips);
/// Pictures of the worst frames, and the scores of all frames. `of_first`: HTML after the sentence about the pictures.
std::string worst_section(const ReportInput& input, const std::string& of_first);
std::string left_out_section(const ReportInput& input);
std::string environment_section(const ReportInput& input);

// What the report's sections share: metrics, values of runs, and pieces of HTML.

/// A metric that the report knows.
struct ReportMetric {
  std::string_view key, label, unit;
  int digits = 4;
  int better = 0;  ///< +1: larger, -1: smaller, 0: neither
  std::string_view help;
};

/// In the order of the table of figures.
std::span<const ReportMetric> report_metrics();
/// The one of that key, which must be among them.
const ReportMetric& report_metric(std::string_view key);

/// Eval rows of a run that count: those of the part of the split that was scored last.
std::vector<const MetricsRow*> eval_rows(const ReportRun& run, const std::string& split);
/// Last value of a metric among the eval rows, or none.
std::optional<double> last_value(const ReportRun& run, const std::string& split, std::string_view key);
/// Seconds of training at the last row.
double trained_s(const ReportRun& run);
std::string duration_text(double seconds);
/// "12 %", "0.4 %", "under 0.1 %".
std::string percent_text(double share);
/// 1234567 as "1,234,567"; not for negative numbers.
std::string count_text(std::int64_t count);
/// Index of the best run of a metric; -1 with fewer than two different values.
int best_run(const std::vector<std::optional<double>>& values, int better);

/// <section> with its heading and, unless empty, a sentence; `title` and `hint` are HTML.
std::string open_section(std::string_view id, std::string_view title, std::string_view hint);
/// A panel that scrolls sideways, around a table.
std::string table_panel(std::string_view label, const std::string& head, const std::string& body);
std::string value_cell(const std::optional<double>& value, int digits, bool best);
/// A column head for each run; with a split the sample that its figures are of stands below its name.
std::string run_heads(const ReportInput& input, const std::string& split = {});
/// Names and lines of the runs; empty for one run.
std::string legend(const ReportInput& input);
/// A coloured square.
std::string swatch(const std::array<std::uint8_t, 3>& color);
/// A paragraph: the sentence and the names, escaped; empty without names.
std::string named_runs(std::string_view sentence, const std::vector<std::string>& names);
/// A paragraph that names the runs for which `missing` holds; empty without any. `sentence` ends before the names.
template <class Missing>
std::string missing_runs(const ReportInput& input, std::string_view sentence, Missing&& missing) {
  std::vector<std::string> names;
  for (const ReportRun& run : input.runs) {
    if (missing(run)) names.push_back(run.name);
  }
  return named_runs(sentence, names);
}

// How soon a curve came near the value it ended at.

/// Abscissa at which `curve` (ascending in x) first covers `share` (0 to 1) of the way from its first to its last
/// finite value, f + share (l - f), read as straight lines between its points; a later dip does not count. `better` is
/// +1 for values that rise and -1 for those that fall. None with fewer than two finite values, and when the last is not
/// better than the first.
std::optional<double> time_to_share(const std::vector<PlotPoint>& curve, int better, double share);

}  // namespace semfield
