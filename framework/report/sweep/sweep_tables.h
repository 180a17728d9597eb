// Tables and plots of a sweep: means over seeds with 95 % intervals, beside the paper's figures.
#pragma once

#include <string>
#include <vector>

#include "report/sweep/sweep_results.h"

namespace semfield {

/// Mean of n values and the half width of its 95 % interval, t(0.975, n - 1) s / sqrt(n) [Student08]; the half width is
/// 0 for n < 2.
struct MeanInterval {
  double mean = 0, half_width = 0;
  int n = 0;
};
MeanInterval mean_interval(const std::vector<double>& values);

/// 0.975 quantile of Student's t distribution with `freedom` >= 1 degrees of freedom, to 1e-9.
double student_t975(int freedom);

/// The figures behind a table of one experiment.
class ExperimentTable {
 public:
  ExperimentTable(const Sweep& sweep, std::size_t experiment, const std::vector<Cell>& cells,
                  const SweepResults& results);

  /// Over the seeds of one scene; n = 0 without a finished cell.
  MeanInterval at(std::size_t scene, std::size_t variant, const std::string& metric) const;
  /// Over scenes: the mean of the scenes' means, its interval from the seeds' alone, 0 where a scene has one seed;
  /// n = scenes with data.
  MeanInterval over_scenes(std::size_t variant, const std::string& metric) const;

  /// Why the variants cannot be compared: they were scored on other frames or pixels of a scene. "" where they can.
  const std::string& unequal() const { return unequal_; }
  /// A heading, the note, and a table per metric: a row per variant, a column per scene, their mean, the paper's
  /// figure. What cannot be compared has the reason in the place of tables.
  std::string markdown() const;
  /// variant, scene, metric, n, mean, half_width; no rows where they cannot be compared.
  std::string csv() const;
  /// The first metric over `x`, a line per scene, as a file of its own; empty when fewer than two variants have an x,
  /// or they cannot be compared.
  std::string svg() const;

 private:
  std::string metric_table(const std::string& metric, bool with_paper) const;
  void note_unequal(const CellUse& use, const CellValues& values);
  const Experiment& experiment_;
  std::vector<CellValues> scored_;  // [scene] frames and pixels of its first run
  std::string unequal_;
  std::vector<std::vector<std::vector<const CellValues*>>> values_;  // [scene][variant][seeds done]
};

}  // namespace semfield
