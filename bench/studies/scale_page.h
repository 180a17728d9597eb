// What `semfield-study scale` measured, as the tables and the figure of docs/evidence/scale.md, beside the model.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "studies/scale_results.h"

namespace semfield {

/// A step whose cost one device told, on the machines that the model assumes.
struct ScaleCase {
  std::string step, device;  ///< as in ScaleRow
  ScaleMachine machine;      ///< that was measured
  ScaleStep cost;
  ScaleSystem system;
  ScaleSizes sizes;
};

/// Of each preset and device that was measured on one rank; of several machines the one with most units.
std::vector<ScaleCase> scale_cases(const ScaleResults& results);

/// Markdown, readable as it stands.
std::string scale_measured(const ScaleResults& results);
std::string scale_model(const ScaleResults& results);
/// Share of each device that is of use over their number, as the model has it and as measured; strong beside weak.
std::string scale_figure(const ScaleResults& results);
/// The last line: names and values.
std::string scale_line(const ScaleResults& results);

/// The page of name `name` with its parts renewed. Throws Error(data) where a mark is missing.
std::string with_scale(std::string page, const ScaleResults& results, const std::string& name);

}  // namespace semfield
