// Line plots as SVG text: axes with round ticks, several series overlaid, linear or logarithmic ordinate.
#pragma once

#include <string>
#include <vector>

namespace semfield {

struct PlotPoint {
  double x = 0, y = 0;
};

struct PlotSeries {
  std::string name;
  int color = 0;  ///< 0..7: colour --s<color> of the style sheet, and a dash pattern of its own
  std::vector<PlotPoint> points;
};

struct PlotSpec {
  std::string title;
  std::string x_label;
  bool log_y = false;    ///< points with y <= 0 are then left out
  bool markers = false;  ///< a dot at each point, with its values as tooltip
  int digits = 3;        ///< significant digits of the values shown
  std::vector<PlotSeries> series;
};

/// Round tick positions that cover [low, high]: 1, 2 or 5 times a power of ten apart, about `wanted` of them.
std::vector<double> linear_ticks(double low, double high, int wanted);
/// Powers of ten in [low, high], with their 2- and 5-fold when that leaves fewer than three.
std::vector<double> log_ticks(double low, double high);

/// At most `most` points: neighbours are averaged in equal groups. Fewer points come back as they are.
std::vector<PlotPoint> thin_points(const std::vector<PlotPoint>& points, std::size_t most);

/// An <svg> element with a text alternative. Points that are not finite are not drawn; without any the plot says "no
/// data".
std::string line_plot(const PlotSpec& spec);

/// A short horizontal sample of a series' line, for a legend.
std::string line_sample(int color);

}  // namespace semfield
