// The parts of the report, each a piece of HTML (empty when there is nothing to show).
#pragma once

#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "train/report.h"

namespace semfield {

/// A metric that the report knows.
struct ReportMetric {
  std::string_view key, label, unit;
  int digits = 4;
  int better = 0;  ///< +1: larger, -1: smaller, 0: neither
  std::string_view help;
};

/// Eval rows of a run that count.
std::vector<const MetricsRow*> eval_rows(const ReportRun& run, const std::string& split);
/// Last value of a metric among the eval rows, or none.
std::optional<double> last_value(const ReportRun& run, const std::string& split, std::string_view key);
/// Seconds of training at the last row.
double trained_s(const ReportRun& run);
std::string duration_text(double seconds);

std::string cards_section(const ReportInput& input, const std::string& split);
std::string figures_section(const ReportInput& input, const std::string& split);
std::string curves_section(const ReportInput& input, const std::string& split);
std::string classes_section(const ReportInput& input, const std::string& split);
std::string strips_section(const std::vector<ReportStrip>& strips, std::string_view id, std::string_view title,
                           std::string_view hint);
std::string left_out_section(const ReportInput& input);
std::string environment_section(const ReportInput& input);

}  // namespace semfield
