// What the report's sections share: metrics, values of runs, and pieces of HTML.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "report/report.h"

namespace semfield {

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

}  // namespace semfield
