// The parts of the report, each a piece of HTML (empty when there is nothing to show).
#pragma once

#include <string>
#include <string_view>
#include <vector>

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

}  // namespace semfield
