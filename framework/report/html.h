// Small pieces of HTML for the report.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

namespace semfield {

/// Text made safe for element content and quoted attributes: & < > " ' are escaped, control characters become U+FFFD.
std::string html_escape(std::string_view text);

/// Standard base64 with padding [RFC4648, Sec. 4].
std::string base64(std::span<const std::uint8_t> bytes);

/// "data:image/png;base64,..."
std::string png_data_uri(std::span<const std::uint8_t> png);

/// A figure for people: `digits` significant digits, no exponent between 1e-4 and 1e6; "∞" and "NaN" for those.
std::string figure_text(double value, int digits = 4);

/// The report's style sheet: light and dark by the reader's preference, series colours --s0..--s7.
std::string_view report_style();

// Plots as SVG text: axes with round ticks, several series overlaid, linear or logarithmic axes, error bars, bars and
// marks.

/// A point; with both `low` and `high` it gets an error bar between them (e.g. the 95 % interval of a mean over seeds).
struct PlotPoint {
  double x = 0, y = 0;
  std::optional<double> low = {}, high = {};
};

/// A place on a series' line, within its first and last point, that is pointed out.
struct PlotMark {
  double x = 0;
  bool diamond = false;  ///< else a ring
  std::string text;      ///< tooltip
};

/// A bar that stands on the abscissa, behind the curves.
struct PlotBar {
  double from = 0, to = 0;  ///< abscissa
  double height = 0;
  std::string text;  ///< tooltip
};

struct PlotSeries {
  std::string name;
  int color = 0;  ///< 0..7: colour --s<color> of the style sheet, and a dash pattern of its own
  std::vector<PlotPoint> points;
  std::vector<PlotMark> marks = {};
  std::vector<PlotBar> bars = {};
  bool reference = false;  ///< a thin grey line to compare with: no dots, no number at its end
};

using PlotRange = std::pair<double, double>;

struct PlotSpec {
  std::string title;
  std::string x_label;
  bool log_y = false;    ///< points with y <= 0 are then left out
  bool markers = false;  ///< a dot at each point, with its values as tooltip
  int digits = 3;        ///< significant digits of the values shown
  std::vector<PlotSeries> series;
  bool log_x = false;                                   ///< points with x <= 0 are then left out
  bool end_values = true;                               ///< the last value of each series beside its end
  std::optional<PlotRange> x_range = {}, y_range = {};  ///< of a linear axis; empty: from the points (x from 0)
};

/// Round tick positions that cover [low, high]: 1, 2 or 5 times a power of ten apart, about `wanted` of them.
std::vector<double> linear_ticks(double low, double high, int wanted);
/// Powers of ten in [low, high], with their 2- and 5-fold when that leaves fewer than three; round numbers when the
/// range holds fewer than two of those.
std::vector<double> log_ticks(double low, double high);

/// At most `most` points: neighbours are averaged in equal groups, which have no error bars. Fewer points come back as
/// they are.
std::vector<PlotPoint> thin_points(const std::vector<PlotPoint>& points, std::size_t most);

/// An <svg> element with a text alternative. Points that are not finite are not drawn; without any the plot says "no
/// data".
std::string line_plot(const PlotSpec& spec);

/// A short horizontal sample of a series' line, for a legend.
std::string line_sample(int color);

/// A file of its own: a title, one legend of the series' names in all panels, and the panels row by row under their
/// titles (a single one goes without, as the figure's title says it).
std::string figure_svg(const std::string& title, const std::vector<PlotSpec>& panels, int columns);

}  // namespace semfield
