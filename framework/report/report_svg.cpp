// Plots as SVG text.
#include "report/report_svg.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>

#include "report/html.h"

namespace semfield {

namespace {

constexpr double kWidth = 540, kHeight = 290;
constexpr double kLeft = 54, kRight = 66, kTop = 14, kBottom = 46;
constexpr int kColors = 8;
constexpr std::array<const char*, 4> kDashes{"", "7 5", "2 5", "10 4 2 4"};

// One axis: value -> pixel.
struct Axis {
  double low = 0, high = 1, from_px = 0, to_px = 1;
  bool log = false;
  double at(double value) const {
    const double share = log ? (std::log10(value) - std::log10(low)) / (std::log10(high) - std::log10(low))
                             : (value - low) / (high - low);
    return from_px + share * (to_px - from_px);
  }
};

std::string px(double value) { return fmt::format("{:.1f}", value); }

// Ticks are round numbers; the fewest decimals that show them.
std::string tick_text(double value) {
  for (const auto& [unit, letter] : {std::pair{1e9, "G"}, {1e6, "M"}, {1e3, "k"}}) {
    if (std::abs(value) >= 1e4 && std::abs(value) >= unit) return tick_text(value / unit) + letter;
  }
  if (value != 0 && std::abs(value) < 1e-3) return fmt::format("{:.0e}", value);
  std::string text = fmt::format("{:.3f}", value);
  text.erase(text.find_last_not_of('0') + 1);
  if (text.ends_with('.')) text.pop_back();
  return text == "-0" ? "0" : text;
}

std::string stroke(int color) {
  const char* dash = kDashes[static_cast<std::size_t>(color) % kDashes.size()];
  return fmt::format("stroke=\"var(--s{})\"{}", color % kColors,
                     *dash != 0 ? fmt::format(" stroke-dasharray=\"{}\"", dash) : "");
}

std::string text_at(double x, double y, const char* anchor, const std::string& text, const std::string& extra = {}) {
  return fmt::format("<text x=\"{}\" y=\"{}\" text-anchor=\"{}\"{}>{}</text>\n", px(x), px(y), anchor, extra,
                     html_escape(text));
}

bool drawable(const PlotPoint& p, const PlotSpec& spec) {
  return std::isfinite(p.x) && std::isfinite(p.y) && (!spec.log_y || p.y > 0) && (!spec.log_x || p.x > 0);
}

bool has_bar(const PlotPoint& p) { return p.low && p.high && std::isfinite(*p.low) && std::isfinite(*p.high); }

// "31.4 (30.9 to 31.8) at 120".
std::string point_text(const PlotPoint& p, int digits) {
  const std::string interval =
      has_bar(p) ? fmt::format(" ({} to {})", figure_text(*p.low, digits), figure_text(*p.high, digits)) : "";
  return fmt::format("{}{} at {}", figure_text(p.y, digits), interval, figure_text(p.x, 3));
}

std::string describe(const PlotSpec& spec) {
  std::string text = spec.title + " over " + spec.x_label + ".";
  for (const PlotSeries& series : spec.series) {
    if (series.points.empty() || series.reference) continue;
    text += fmt::format(" {}: from {} to {}.", series.name, point_text(series.points.front(), spec.digits),
                        point_text(series.points.back(), spec.digits));
    for (const PlotMark& mark : series.marks) text += fmt::format(" {}.", mark.text);
  }
  return text;
}

std::string grid(const PlotSpec& spec, const Axis& x, const Axis& y, const std::vector<double>& x_ticks,
                 const std::vector<double>& y_ticks) {
  std::string out;
  for (double tick : y_ticks) {
    out += fmt::format("<line class=\"g\" x1=\"{}\" y1=\"{}\" x2=\"{}\" y2=\"{}\"/>\n", px(kLeft), px(y.at(tick)),
                       px(kWidth - kRight), px(y.at(tick)));
    out += text_at(kLeft - 8, y.at(tick) + 4, "end", tick_text(tick));
  }
  const double base = kHeight - kBottom;
  for (double tick : x_ticks) {
    out += fmt::format("<line class=\"ax\" x1=\"{}\" y1=\"{}\" x2=\"{}\" y2=\"{}\"/>\n", px(x.at(tick)), px(base),
                       px(x.at(tick)), px(base + 5));
    out += text_at(x.at(tick), base + 19, "middle", tick_text(tick));
  }
  out += fmt::format("<line class=\"ax\" x1=\"{}\" y1=\"{}\" x2=\"{}\" y2=\"{}\"/>\n", px(kLeft), px(base),
                     px(kWidth - kRight), px(base));
  out += text_at((kLeft + kWidth - kRight) / 2, kHeight - 6, "middle", spec.x_label);
  return out;
}

// End labels, moved apart so that none covers another.
std::string end_labels(const PlotSpec& spec, const std::vector<PlotSeries>& drawn, const Axis& x, const Axis& y) {
  struct Label {
    double at_px;
    std::string text;
    int color;
    double x_px;
  };
  std::vector<Label> labels;
  for (const PlotSeries& series : drawn) {
    if (series.points.empty() || series.reference) continue;
    const PlotPoint& last = series.points.back();
    labels.push_back({y.at(last.y), figure_text(last.y, spec.digits), series.color, x.at(last.x)});
  }
  std::stable_sort(labels.begin(), labels.end(), [](const Label& a, const Label& b) { return a.at_px < b.at_px; });
  for (std::size_t i = 1; i < labels.size(); ++i) {
    if (std::abs(labels[i].x_px - labels[i - 1].x_px) < 48)
      labels[i].at_px = std::max(labels[i].at_px, labels[i - 1].at_px + 15);
  }
  std::string out;
  for (const Label& label : labels) {
    out += text_at(label.x_px + 8, label.at_px + 4, "start", label.text,
                   fmt::format(" class=\"end\" style=\"fill:var(--s{})\"", label.color % kColors));
  }
  return out;
}

// Smallest interval that holds every point, error bar, bar and mark that is drawn.
struct Extent {
  double x_low = 1e300, x_high = -1e300, y_low = 1e300, y_high = -1e300;
  void add_x(double x) {
    x_low = std::min(x_low, x);
    x_high = std::max(x_high, x);
  }
  void add_y(double y) {
    y_low = std::min(y_low, y);
    y_high = std::max(y_high, y);
  }
};

Extent extent_of(const PlotSpec& spec, const std::vector<PlotSeries>& drawn) {
  Extent extent;
  for (const PlotSeries& series : drawn) {
    for (const PlotPoint& p : series.points) {
      extent.add_x(p.x);
      extent.add_y(p.y);
      if (!has_bar(p)) continue;
      extent.add_y(*p.high);
      if (!spec.log_y || *p.low > 0) extent.add_y(*p.low);
    }
    for (const PlotBar& bar : series.bars) {
      extent.add_x(bar.from);
      extent.add_x(bar.to);
      extent.add_y(bar.height);
      if (!spec.log_y) extent.add_y(0);
    }
  }
  return extent;
}

// Sets the axis' range and returns its ticks.
std::vector<double> scale_x(const PlotSpec& spec, const Extent& extent, Axis& x) {
  if (spec.log_x) {
    const double room = extent.x_high > extent.x_low ? 1.0 : 2.0;  // a single point stands in the middle
    x.low = extent.x_low / room;
    x.high = extent.x_high * room;
    return log_ticks(x.low, x.high);
  }
  x.low = spec.x_range ? spec.x_range->first : std::min(0.0, extent.x_low);
  x.high = spec.x_range ? spec.x_range->second : extent.x_high;
  if (x.high <= x.low) x.high = x.low + 1;
  std::vector<double> ticks = linear_ticks(x.low, x.high, 5);
  std::erase_if(ticks, [&](double tick) {
    return tick < x.low - 1e-9 * (x.high - x.low) || tick > x.high + 1e-9 * (x.high - x.low);
  });
  return ticks;
}

std::vector<double> scale_y(const PlotSpec& spec, Extent extent, Axis& y) {
  if (spec.log_y) {
    y.low = extent.y_low / 1.15;
    y.high = extent.y_high * 1.15;
    return log_ticks(y.low, y.high);
  }
  if (spec.y_range) {
    y.low = spec.y_range->first;
    y.high = spec.y_range->second;
    return linear_ticks(y.low, y.high, 5);
  }
  if (extent.y_high - extent.y_low < 1e-9 * std::max(1.0, std::abs(extent.y_high))) {
    extent.y_low -= 0.5;
    extent.y_high += 0.5;
  }
  const std::vector<double> ticks = linear_ticks(extent.y_low, extent.y_high, 5);
  y.low = ticks.front();
  y.high = ticks.back();
  return ticks;
}

std::string line(double x1, double y1, double x2, double y2, const std::string& attributes) {
  return fmt::format("<line x1=\"{}\" y1=\"{}\" x2=\"{}\" y2=\"{}\" {}/>\n", px(x1), px(y1), px(x2), px(y2),
                     attributes);
}

std::string draw_bars(const PlotSeries& series, const Axis& x, const Axis& y) {
  std::string out;
  for (const PlotBar& bar : series.bars) {
    const double top = y.log && bar.height <= 0 ? y.from_px : y.at(bar.height);
    out += fmt::format(
        "<rect class=\"br\" x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\" "
        "fill=\"var(--s{})\"><title>{}</title></rect>\n",
        px(x.at(bar.from) + 1), px(top), px(std::max(0.0, x.at(bar.to) - x.at(bar.from) - 2)),
        px(std::max(0.0, y.from_px - top)), series.color % kColors, html_escape(bar.text));
  }
  return out;
}

std::string draw_error_bar(const PlotPoint& p, int color, const Axis& x, const Axis& y) {
  const std::string paint = fmt::format("class=\"eb\" stroke=\"var(--s{})\"", color % kColors);
  const double at = x.at(p.x), low = y.log && *p.low <= 0 ? y.from_px : y.at(*p.low), high = y.at(*p.high);
  return line(at, low, at, high, paint) + line(at - 4, low, at + 4, low, paint) +
         line(at - 4, high, at + 4, high, paint);
}

// On the line as it is drawn, whatever the axes: between two points it is straight in pixels.
std::string draw_mark(const PlotMark& mark, const PlotSeries& series, const Axis& x, const Axis& y) {
  const auto after =
      std::find_if(series.points.begin(), series.points.end(), [&](const PlotPoint& p) { return p.x >= mark.x; });
  if (after == series.points.end() || (after == series.points.begin() && after->x > mark.x)) return {};
  const double cx = x.at(mark.x);
  double cy = y.at(after->y);
  if (after != series.points.begin() && after->x > mark.x) {
    const PlotPoint& before = *(after - 1);
    cy = y.at(before.y) + (cx - x.at(before.x)) / (x.at(after->x) - x.at(before.x)) * (cy - y.at(before.y));
  }
  const double r = mark.diamond ? 7 : 5.5;
  const std::string shape = mark.diamond ? fmt::format("<path d=\"M{} {}L{} {}L{} {}L{} {}Z\"", px(cx - r), px(cy),
                                                       px(cx), px(cy - r), px(cx + r), px(cy), px(cx), px(cy + r))
                                         : fmt::format("<circle cx=\"{}\" cy=\"{}\" r=\"{}\"", px(cx), px(cy), px(r));
  return fmt::format("{} class=\"mk\" stroke=\"var(--s{})\"><title>{}</title></{}>\n", shape, series.color % kColors,
                     html_escape(mark.text), mark.diamond ? "path" : "circle");
}

std::string draw_series(const PlotSpec& spec, const PlotSeries& series, const Axis& x, const Axis& y) {
  std::string out, path;
  for (const PlotPoint& p : series.points)
    path += fmt::format("{}{},{}", path.empty() ? "" : " ", px(x.at(p.x)), px(y.at(p.y)));
  if (series.reference) return path.empty() ? path : fmt::format("<polyline class=\"rf\" points=\"{}\"/>\n", path);
  if (!path.empty()) out += fmt::format("<polyline class=\"ln\" {} points=\"{}\"/>\n", stroke(series.color), path);
  for (std::size_t i = 0; i < series.points.size(); ++i) {
    const PlotPoint& p = series.points[i];
    if (has_bar(p)) out += draw_error_bar(p, series.color, x, y);
    if (!spec.markers && i + 1 != series.points.size()) continue;
    out += fmt::format("<circle cx=\"{}\" cy=\"{}\" r=\"{}\" fill=\"var(--s{})\"><title>{}: {}</title></circle>\n",
                       px(x.at(p.x)), px(y.at(p.y)), series.points.size() == 1 ? 5 : 3, series.color % kColors,
                       html_escape(series.name), html_escape(point_text(p, spec.digits)));
  }
  for (const PlotMark& mark : series.marks) out += draw_mark(mark, series, x, y);
  return out;
}

}  // namespace

std::vector<double> linear_ticks(double low, double high, int wanted) {
  const double raw = std::max(high - low, 1e-12) / std::max(1, wanted);
  const double power = std::pow(10.0, std::floor(std::log10(raw)));
  double step = 10 * power;
  for (double factor : {1.0, 2.0, 5.0}) {
    if (factor * power >= raw * (1 - 1e-9)) {
      step = factor * power;
      break;
    }
  }
  std::vector<double> ticks;
  const auto first = static_cast<std::int64_t>(std::floor(low / step + 1e-9));
  for (std::int64_t i = first; ticks.size() < 100; ++i) {
    ticks.push_back(static_cast<double>(i) * step);
    if (ticks.back() >= high - 1e-9 * step) break;
  }
  return ticks;
}

std::vector<double> log_ticks(double low, double high) {
  std::vector<double> ticks;
  const auto collect = [&](std::initializer_list<double> factors) {
    ticks.clear();
    for (int e = static_cast<int>(std::floor(std::log10(low))); e <= static_cast<int>(std::ceil(std::log10(high)));
         ++e) {
      for (double factor : factors) {
        const double tick = factor * std::pow(10.0, e);
        if (tick >= low * (1 - 1e-9) && tick <= high * (1 + 1e-9)) ticks.push_back(tick);
      }
    }
  };
  collect({1});
  if (ticks.size() < 3) collect({1, 2, 5});
  if (ticks.size() < 2) {
    ticks = linear_ticks(low, high, 3);
    std::erase_if(ticks, [&](double tick) { return tick < low || tick > high; });
  }
  return ticks;
}

std::vector<PlotPoint> thin_points(const std::vector<PlotPoint>& points, std::size_t most) {
  if (points.size() <= most) return points;
  std::vector<PlotPoint> thin;
  for (std::size_t group = 0; group < most; ++group) {
    const std::size_t begin = group * points.size() / most;
    const std::size_t end = (group + 1) * points.size() / most;
    PlotPoint mean;
    for (std::size_t i = begin; i < end; ++i) {
      mean.x += points[i].x;
      mean.y += points[i].y;
    }
    const auto count = static_cast<double>(end - begin);
    thin.push_back({mean.x / count, mean.y / count});
  }
  return thin;
}

std::string line_sample(int color) {
  return fmt::format(
      "<svg viewBox=\"0 0 34 10\" aria-hidden=\"true\"><line class=\"ln\" x1=\"1\" y1=\"5\" x2=\"33\" y2=\"5\" "
      "{}/></svg>",
      stroke(color));
}

std::string figure_svg(const std::string& title, const std::vector<PlotSpec>& panels, int columns) {
  constexpr double kTitle = 28, kLegendLine = 18, kPanelTitle = 22;
  const int rows = (static_cast<int>(panels.size()) + columns - 1) / columns;
  const double width = kWidth * columns;
  std::string legend;
  std::vector<std::string> named;
  double x = 12, y = kTitle;
  for (const PlotSpec& panel : panels) {
    for (const PlotSeries& series : panel.series) {
      if (std::find(named.begin(), named.end(), series.name) != named.end()) continue;
      named.push_back(series.name);
      const double wide = 60 + 6.6 * static_cast<double>(series.name.size());
      if (x > 12 && x + wide > width) {
        x = 12;
        y += kLegendLine;
      }
      legend += series.reference ? line(x + 1, y + 5, x + 33, y + 5, "class=\"rf\"")
                                 : line(x + 1, y + 5, x + 33, y + 5, "class=\"ln\" " + stroke(series.color));
      legend += text_at(x + 40, y + 9, "start", series.name, " style=\"font-size:12px;fill:var(--ink)\"");
      x += wide;
    }
  }
  const double head = y + kLegendLine, panel_head = panels.size() > 1 ? kPanelTitle : 0;
  const double height = head + rows * (kHeight + panel_head);
  std::string out = fmt::format(
      "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {0:.0f} {1:.0f}\" width=\"{0:.0f}\" height=\"{1:.0f}\" "
      "font-family=\"sans-serif\">\n<style>{2}</style>\n<rect width=\"100%\" height=\"100%\" "
      "fill=\"var(--card)\"/>\n",
      width, height, report_style());
  out += text_at(12, 18, "start", title, " style=\"font-size:14px;fill:var(--ink)\"") + legend;
  for (std::size_t i = 0; i < panels.size(); ++i) {
    const double left = kWidth * static_cast<double>(i % static_cast<std::size_t>(columns));
    const double top = head + (kHeight + panel_head) * static_cast<double>(i / static_cast<std::size_t>(columns));
    if (panel_head > 0)
      out += text_at(left + kLeft, top + 15, "start", panels[i].title, " style=\"font-size:13px;fill:var(--ink)\"");
    // A group and no <svg> of its own: the page's style gives those the width of what holds them.
    const std::string plot = line_plot(panels[i]);
    const std::size_t attributes = plot.find(" role="), end = plot.rfind("</svg>");
    out += fmt::format("<g transform=\"translate({:.0f} {:.0f})\"", left, top + panel_head) +
           plot.substr(attributes, end - attributes) + "</g>\n";
  }
  return out + "</svg>\n";
}

std::string line_plot(const PlotSpec& spec) {
  std::vector<PlotSeries> drawn = spec.series;
  for (PlotSeries& series : drawn) {
    std::erase_if(series.points, [&](const PlotPoint& p) { return !drawable(p, spec); });
  }
  std::string out = fmt::format("<svg viewBox=\"0 0 {:.0f} {:.0f}\" role=\"img\" aria-label=\"{}\">\n", kWidth, kHeight,
                                html_escape(describe(spec)));
  const Extent extent = extent_of(spec, drawn);
  if (extent.y_low > extent.y_high) return out + text_at(kWidth / 2, kHeight / 2, "middle", "no data") + "</svg>\n";

  Axis x{0, 1, kLeft, kWidth - kRight, spec.log_x};
  Axis y{0, 1, kHeight - kBottom, kTop, spec.log_y};
  const std::vector<double> x_ticks = scale_x(spec, extent, x), y_ticks = scale_y(spec, extent, y);
  out += grid(spec, x, y, x_ticks, y_ticks);
  for (const PlotSeries& series : drawn) out += draw_bars(series, x, y);
  for (const PlotSeries& series : drawn) out += draw_series(spec, series, x, y);
  if (spec.end_values) out += end_labels(spec, drawn, x, y);
  return out + "</svg>\n";
}

}  // namespace semfield
