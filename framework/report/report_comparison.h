// Which figures of several runs may be held against each other, and which part of a split they are of.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "report/report.h"

namespace semfield {

/// "4 of 30 frames at 1 pixel in 4" when the row is of a part of its split, else "".
std::string sample_text(const MetricsRow& row);
/// The same of the figures that a run shows.
std::string sample_text(const ReportRun& run, const std::string& split);
/// Frames and pixels that a row scored: "all 30 frames", "a sample, 4 of 30 frames"; "" where it does not say.
std::string part_text(const MetricsRow& row);

/// Why figures of these runs cannot be ranked, a sentence each: other data, other frames. Empty when they can, or when
/// nothing is known against it.
std::vector<std::string> unranked_because(const ReportInput& input, const std::string& split);
/// best_run, or -1 where unranked_because gives a reason.
int best_of(const ReportInput& input, const std::string& split, const std::vector<std::optional<double>>& values,
            int better);

/// The evaluations that a run's curve is drawn through: those of one sample of frames, scored again and again while
/// training; without two of them those that its figures are of.
std::vector<const MetricsRow*> curve_rows(const ReportRun& run, const std::string& split);
/// The rows of every run that times to a common level are read from: curve_rows where they are of the same frames in
/// every run, else those of the figures.
std::vector<std::vector<const MetricsRow*>> level_rows(const ReportInput& input, const std::string& split);

/// When a run came to a level, as far as its evaluations show.
struct LevelTime {
  double not_before_s = 0, not_after_s = 0;
  bool at_first = false;  ///< its first evaluation was there already
  bool only = false;      ///< and it is its only one
};
std::optional<LevelTime> time_of_level(const std::vector<const MetricsRow*>& rows, std::string_view key, int better,
                                       double level);
/// Index of the run that came first for certain, or -1.
int first_for_certain(const std::vector<std::optional<LevelTime>>& times);

}  // namespace semfield
