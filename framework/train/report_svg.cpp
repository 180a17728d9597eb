// Line plots as SVG text.
#include "train/report_svg.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>

#include "train/html.h"

namespace semfield {

namespace {

constexpr double kWidth = 540, kHeight = 290;
constexpr double kLeft = 54, kRight = 60, kTop = 14, kBottom = 46;
constexpr int kColors = 8;
constexpr std::array<const char*, 4> kDashes{"", "7 5", "2 5", "10 4 2 4"};

// One axis: value -> pixel.
struct Axis {
  double low = 0, high = 1, from_px = 0, to_px = 1;
  bool log = false;
  double at(double value) const {
    const double share = log ? (std::log10(value) - std::log10(low)) / (std::log10(high) - std::log10(low)) : (value - low) / (high - low);
    return from_px + share * (to_px - from_px);
  }
};

std::string px(double value) { return fmt::format("{:.1f}", value); }

// Ticks are round numbers; the fewest decimals that show them.
std::string tick_text(double value) {
  if (value != 0 && (std::abs(value) < 1e-3 || std::abs(value) >= 1e5)) return fmt::format("{:.0e}", value);
  std::string text = fmt::format("{:.3f}", value);
  text.erase(text.find_last_not_of('0') + 1);
  if (text.ends_with('.')) text.pop_back();
  return text == "-0" ? "0" : text;
}

std::string stroke(int color) {
  const char* dash = kDashes[static_cast<std::size_t>(color) % kDashes.size()];
  return fmt::format("stroke=\"var(--s{})\"{}", color % kColors, *dash != 0 ? fmt::format(" stroke-dasharray=\"{}\"", dash) : "");
}

std::string text_at(double x, double y, const char* anchor, const std::string& text, const std::string& extra = {}) {
  return fmt::format("<text x=\"{}\" y=\"{}\" text-anchor=\"{}\"{}>{}</text>\n", px(x), px(y), anchor, extra, html_escape(text));
}

bool drawable(const PlotPoint& p, bool log_y) { return std::isfinite(p.x) && std::isfinite(p.y) && (!log_y || p.y > 0); }

std::string describe(const PlotSpec& spec) {
  std::string text = spec.title + " over " + spec.x_label + ".";
  for (const PlotSeries& series : spec.series) {
    if (series.points.empty()) continue;
    const PlotPoint& first = series.points.front();
    const PlotPoint& last = series.points.back();
    text += fmt::format(" {}: from {} at {} to {} at {}.", series.name, figure_text(first.y, spec.digits), figure_text(first.x, 3),
                        figure_text(last.y, spec.digits), figure_text(last.x, 3));
  }
  return text;
}

std::string grid(const PlotSpec& spec, const Axis& x, const Axis& y, const std::vector<double>& x_ticks, const std::vector<double>& y_ticks) {
  std::string out;
  for (double tick : y_ticks) {
    out += fmt::format("<line class=\"g\" x1=\"{}\" y1=\"{}\" x2=\"{}\" y2=\"{}\"/>\n", px(kLeft), px(y.at(tick)), px(kWidth - kRight), px(y.at(tick)));
    out += text_at(kLeft - 8, y.at(tick) + 4, "end", tick_text(tick));
  }
  const double base = kHeight - kBottom;
  for (double tick : x_ticks) {
    out += fmt::format("<line class=\"ax\" x1=\"{}\" y1=\"{}\" x2=\"{}\" y2=\"{}\"/>\n", px(x.at(tick)), px(base), px(x.at(tick)), px(base + 5));
    out += text_at(x.at(tick), base + 19, "middle", tick_text(tick));
  }
  out += fmt::format("<line class=\"ax\" x1=\"{}\" y1=\"{}\" x2=\"{}\" y2=\"{}\"/>\n", px(kLeft), px(base), px(kWidth - kRight), px(base));
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
    if (series.points.empty()) continue;
    const PlotPoint& last = series.points.back();
    labels.push_back({y.at(last.y), figure_text(last.y, spec.digits), series.color, x.at(last.x)});
  }
  std::stable_sort(labels.begin(), labels.end(), [](const Label& a, const Label& b) { return a.at_px < b.at_px; });
  for (std::size_t i = 1; i < labels.size(); ++i) {
    if (std::abs(labels[i].x_px - labels[i - 1].x_px) < 48) labels[i].at_px = std::max(labels[i].at_px, labels[i - 1].at_px + 15);
  }
  std::string out;
  for (const Label& label : labels) {
    out += text_at(label.x_px + 8, label.at_px + 4, "start", label.text, fmt::format(" class=\"end\" style=\"fill:var(--s{})\"", label.color % kColors));
  }
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
    for (int e = static_cast<int>(std::floor(std::log10(low))); e <= static_cast<int>(std::ceil(std::log10(high))); ++e) {
      for (double factor : factors) {
        const double tick = factor * std::pow(10.0, e);
        if (tick >= low * (1 - 1e-9) && tick <= high * (1 + 1e-9)) ticks.push_back(tick);
      }
    }
  };
  collect({1});
  if (ticks.size() < 3) collect({1, 2, 5});
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
  return fmt::format("<svg viewBox=\"0 0 34 10\" aria-hidden=\"true\"><line class=\"ln\" x1=\"1\" y1=\"5\" x2=\"33\" y2=\"5\" {}/></svg>", stroke(color));
}

std::string line_plot(const PlotSpec& spec) {
  std::vector<PlotSeries> drawn = spec.series;
  double x_high = 0, y_low = 1e300, y_high = -1e300;
  for (PlotSeries& series : drawn) {
    std::erase_if(series.points, [&](const PlotPoint& p) { return !drawable(p, spec.log_y); });
    for (const PlotPoint& p : series.points) {
      x_high = std::max(x_high, p.x);
      y_low = std::min(y_low, p.y);
      y_high = std::max(y_high, p.y);
    }
  }
  std::string out = fmt::format("<svg viewBox=\"0 0 {:.0f} {:.0f}\" role=\"img\" aria-label=\"{}\">\n", kWidth, kHeight, html_escape(describe(spec)));
  if (y_low > y_high) return out + text_at(kWidth / 2, kHeight / 2, "middle", "no data") + "</svg>\n";

  if (x_high <= 0) x_high = 1;
  Axis x{0, x_high, kLeft, kWidth - kRight, false};
  Axis y{y_low, y_high, kHeight - kBottom, kTop, spec.log_y};
  std::vector<double> x_ticks = linear_ticks(0, x_high, 5);
  if (x_ticks.back() > x_high) x_ticks.pop_back();
  std::vector<double> y_ticks;
  if (spec.log_y) {
    y.low = y_low / 1.15;
    y.high = y_high * 1.15;
    y_ticks = log_ticks(y.low, y.high);
  } else {
    if (y_high - y_low < 1e-9 * std::max(1.0, std::abs(y_high))) {
      y_low -= 0.5;
      y_high += 0.5;
    }
    y_ticks = linear_ticks(y_low, y_high, 5);
    y.low = y_ticks.front();
    y.high = y_ticks.back();
  }
  out += grid(spec, x, y, x_ticks, y_ticks);
  for (const PlotSeries& series : drawn) {
    if (series.points.empty()) continue;
    std::string path;
    for (const PlotPoint& p : series.points) path += fmt::format("{}{},{}", path.empty() ? "" : " ", px(x.at(p.x)), px(y.at(p.y)));
    out += fmt::format("<polyline class=\"ln\" {} points=\"{}\"/>\n", stroke(series.color), path);
    for (std::size_t i = 0; i < series.points.size(); ++i) {
      const PlotPoint& p = series.points[i];
      if (!spec.markers && i + 1 != series.points.size()) continue;
      out += fmt::format("<circle cx=\"{}\" cy=\"{}\" r=\"3\" fill=\"var(--s{})\"><title>{}: {} at {}</title></circle>\n", px(x.at(p.x)),
                         px(y.at(p.y)), series.color % kColors, html_escape(series.name), figure_text(p.y, spec.digits), figure_text(p.x, 3));
    }
  }
  return out + end_labels(spec, drawn, x, y) + "</svg>\n";
}

}  // namespace semfield
