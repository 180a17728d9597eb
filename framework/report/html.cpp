// Small pieces of HTML for the report.
#include "report/html.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>

namespace semfield {

std::string html_escape(std::string_view text) {
  std::string out;
  out.reserve(text.size());
  for (char c : text) {
    switch (c) {
      case '&':
        out += "&amp;";
        break;
      case '<':
        out += "&lt;";
        break;
      case '>':
        out += "&gt;";
        break;
      case '"':
        out += "&quot;";
        break;
      case '\'':
        out += "&#39;";
        break;
      default:
        if (static_cast<unsigned char>(c) < 0x20 && c != '\n' && c != '\t') {
          out += "\xEF\xBF\xBD";
        } else {
          out += c;
        }
    }
  }
  return out;
}

std::string base64(std::span<const std::uint8_t> bytes) {
  constexpr std::string_view kDigits = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::string out;
  out.reserve((bytes.size() + 2) / 3 * 4);
  for (std::size_t i = 0; i < bytes.size(); i += 3) {
    const std::size_t left = bytes.size() - i;
    const std::uint32_t group = static_cast<std::uint32_t>(bytes[i]) << 16 |
                                (left > 1 ? static_cast<std::uint32_t>(bytes[i + 1]) << 8 : 0u) |
                                (left > 2 ? static_cast<std::uint32_t>(bytes[i + 2]) : 0u);
    out += kDigits[group >> 18];
    out += kDigits[group >> 12 & 63];
    out += left > 1 ? kDigits[group >> 6 & 63] : '=';
    out += left > 2 ? kDigits[group & 63] : '=';
  }
  return out;
}

std::string png_data_uri(std::span<const std::uint8_t> png) { return "data:image/png;base64," + base64(png); }

std::string figure_text(double value, int digits) {
  if (std::isnan(value)) return "NaN";
  if (std::isinf(value)) return value > 0 ? "∞" : "−∞";
  const double size = std::abs(value);
  std::string text;
  if (size != 0 && (size < 1e-4 || size >= 1e6)) {
    text = fmt::format("{:.{}e}", value, digits - 1);
  } else {
    const int whole = size < 1 ? (size == 0 ? 1 : 1 + static_cast<int>(std::floor(std::log10(size))))
                               : static_cast<int>(std::floor(std::log10(size))) + 1;
    text = fmt::format("{:.{}f}", value, std::max(0, digits - whole));
  }
  if (text.starts_with('-')) text.replace(0, 1, "−");  // a minus sign, not a hyphen
  return text;
}

std::string_view report_style() {
  return R"css(
:root{color-scheme:light dark;--page:#f6f7f9;--card:#fff;--ink:#16202c;--soft:#566373;--line:#dfe4ea;--grid:#e9edf1;--accent:#1f5fd0;--good:#0b7a53;
--s0:#1f5fd0;--s1:#d1480a;--s2:#0b7f5c;--s3:#8a2fc4;--s4:#96700a;--s5:#b81d5b;--s6:#0a7d94;--s7:#5b6472}
@media (prefers-color-scheme:dark){:root{--page:#0f141a;--card:#171e26;--ink:#e8edf3;--soft:#9fadbc;--line:#2a3541;--grid:#232d38;--accent:#7fb0ff;--good:#4fd6a2;
--s0:#7fb0ff;--s1:#ff9a62;--s2:#52d3a3;--s3:#cf9bff;--s4:#e6c35c;--s5:#ff8db5;--s6:#5fd0e6;--s7:#b3bdc9}}
*{box-sizing:border-box}
html{scroll-behavior:smooth;-webkit-text-size-adjust:100%}
body{margin:0;background:var(--page);color:var(--ink);font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,"Noto Sans","Liberation Sans",Arial,sans-serif}
main,.top,footer{max-width:1160px;margin:0 auto;padding:0 24px}
.top{padding-top:44px}
h1{font-size:2.1rem;line-height:1.15;margin:0 0 6px;letter-spacing:-.02em;font-weight:700}
.lead{margin:0;color:var(--soft);font-size:1.05rem}
nav{margin:20px 0 0;display:flex;flex-wrap:wrap;gap:4px 20px;border-bottom:1px solid var(--line);padding-bottom:12px}
a{color:var(--accent);text-underline-offset:3px}
nav a{text-decoration:none;font-size:.92rem}
nav a:hover{text-decoration:underline}
a:focus-visible,summary:focus-visible,.scroll:focus-visible{outline:2px solid var(--accent);outline-offset:3px;border-radius:3px}
section{margin:40px 0 0}
h2{font-size:1.3rem;margin:0 0 4px;letter-spacing:-.01em}
.hint{margin:0 0 14px;color:var(--soft);font-size:.92rem;max-width:75ch}
.facts{margin:16px 0 0}
dl.facts{display:flex;flex-wrap:wrap;gap:6px 32px}
dl.facts dt{color:var(--soft);font-size:.8rem}
dl.facts dd{margin:0;font-size:.93rem;overflow-wrap:anywhere}
.facts td{overflow-wrap:anywhere}
.notice{margin:18px 0 0;padding:12px 16px;border-left:4px solid var(--s1);background:var(--card);border-radius:4px;font-size:.95rem;max-width:none}
.figures tbody small.d{display:inline;margin-left:8px}
.left-out td,.left-out th{overflow-wrap:break-word}
.left-out thead th:first-child{width:28%}
.left-out thead th:last-child{width:1%}
.more{margin-top:14px}
.more .panel{border:0;padding:14px 0 4px}
.cards{display:grid;grid-template-columns:repeat(auto-fit,minmax(145px,1fr));gap:14px;margin:24px 0 0}
.card,.panel{background:var(--card);border:1px solid var(--line);border-radius:12px}
.card{padding:14px 18px 16px}
.card .k{color:var(--soft);font-size:.84rem}
.card .v{font-size:1.85rem;line-height:1.25;font-weight:650;letter-spacing:-.02em;font-variant-numeric:tabular-nums}
.card .u{font-size:.95rem;font-weight:500;color:var(--soft);letter-spacing:0;margin-left:4px}
.card .n{color:var(--soft);font-size:.8rem}
.scroll{overflow-x:auto}
table{border-collapse:collapse;width:100%;font-size:.93rem}
th,td{text-align:left;padding:9px 16px;border-bottom:1px solid var(--line);vertical-align:top}
tbody tr:last-child>td,tbody tr:last-child>th{border-bottom:0}
thead th{color:var(--soft);font-weight:600;font-size:.82rem;white-space:nowrap}
tbody th{font-weight:500}
td.num,th.num{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
td.best{font-weight:700;color:var(--good)}
.none{color:var(--soft)}
small.d{display:block;color:var(--soft);font-size:.8rem;font-weight:400}
.plots{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,380px),1fr));gap:16px}
.plots .panel{padding:14px 14px 6px;margin:0}
figure{margin:0}
iframe{display:block;width:100%;height:clamp(320px,56vh,620px);border:1px solid var(--line);border-radius:12px;background:#15181c}
figcaption{font-weight:600;font-size:.95rem;padding:0 4px}
figcaption span{color:var(--soft);font-weight:400;font-size:.84rem;margin-left:6px}
svg{display:block;width:100%;height:auto}
svg text{font:12px system-ui,-apple-system,"Segoe UI",Roboto,"Noto Sans","Liberation Sans",Arial,sans-serif;fill:var(--soft);font-variant-numeric:tabular-nums}
svg .g{stroke:var(--grid);stroke-width:1}
svg .ax{stroke:var(--soft);stroke-width:1}
svg .ln{fill:none;stroke-width:2;stroke-linejoin:round;stroke-linecap:round}
svg .rf{fill:none;stroke:var(--soft);stroke-width:1.5;stroke-dasharray:3 4}
svg .br{stroke:none;opacity:.22}
svg .eb{stroke-width:1.5}
svg .mk{fill:var(--card);stroke-width:2}
svg .end{font-weight:650;stroke:var(--card);stroke-width:3px;paint-order:stroke}
.legend{display:flex;flex-wrap:wrap;gap:4px 22px;margin:0 0 12px;padding:0;list-style:none;font-size:.92rem}
.legend li{display:flex;align-items:center;gap:8px}
.legend svg{width:34px;height:10px;flex:none}
.bars{padding:10px 20px 12px;display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,400px),1fr));gap:0 44px;margin:0}
.bar{display:grid;grid-template-columns:minmax(96px,150px) 1fr 52px;gap:12px;align-items:center;padding:6px 0;font-size:.93rem}
.sw{display:inline-block;width:12px;height:12px;border-radius:3px;margin-right:9px;border:1px solid color-mix(in srgb,var(--ink) 35%,transparent);vertical-align:-1px}
.bar .name{overflow-wrap:anywhere}
.tr{background:var(--grid);border-radius:5px;height:10px;overflow:hidden}
.tr+.tr{margin-top:4px}
.tr i{display:block;height:100%;border-radius:5px;box-shadow:inset 0 0 0 1px color-mix(in srgb,var(--ink) 22%,transparent)}
.bar .val{text-align:right;font-variant-numeric:tabular-nums;line-height:1.05;font-size:.86rem}
.bar .val div+div{margin-top:1px}
.strip{padding:14px 18px 18px}
.strip+.strip{margin-top:14px}
.strip h3{margin:0 0 10px;font-size:1rem;font-weight:600}
.strip h3 span{color:var(--soft);font-weight:400;font-size:.88rem;margin-left:8px}
.imgs{display:grid;grid-template-columns:repeat(3,1fr);gap:12px}
@media (min-width:1100px){.imgs{grid-template-columns:repeat(auto-fit,minmax(150px,1fr))}}
.imgs img{display:block;width:100%;height:auto;border-radius:6px;background:var(--grid)}
.imgs figcaption{font-weight:400;font-size:.82rem;color:var(--soft);padding:5px 0 0}
h3{font-size:1.05rem;margin:24px 0 2px}
.after{margin:12px 0 0}
.note{margin:0;padding:2px 4px 8px}
.below{margin-top:14px}
.pick{margin:0 7px 0 2px;accent-color:var(--accent);vertical-align:-1px}
.pick+label{font-size:.92rem}
.pick~.plots{margin-top:12px}
.plots+.panel,.pick~.panel{margin-top:16px}
.pick~.two,.pick:checked~.one{display:none}
.pick:checked~.two{display:grid}
.pad{padding:14px 18px 16px}
.words{margin:0 0 18px;display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,380px),1fr));gap:12px 32px}
.words ul{margin:0;padding:0;list-style:none;font-size:.95rem}
.words li{padding:3px 0}
.words .sw{margin-right:6px;margin-left:2px}
h4{margin:0 0 4px;font-size:.85rem;font-weight:600;color:var(--soft)}
thead th.grp{text-align:center;border-left:1px solid var(--line)}
.cm{width:auto;font-size:.82rem;border-collapse:separate;border-spacing:1px}
.cm th,.cm td{padding:3px 4px;border:0;text-align:center;min-width:30px;font-variant-numeric:tabular-nums}
.cm td{background:var(--grid);border-radius:3px}
.cm td.num{background:none;text-align:right;color:var(--soft);padding-left:10px}
.cm td.no{background:color-mix(in srgb,var(--s1) var(--p),var(--grid))}
.cm td.ok{background:color-mix(in srgb,var(--s2) var(--p),var(--grid))}
.cm th.row{position:sticky;left:0;background:var(--card);text-align:left;white-space:nowrap;padding-right:12px;font-weight:500;max-width:17em;overflow:hidden;text-overflow:ellipsis}
@media (max-width:640px){.cm th.row{max-width:9em}}
.cm thead th{vertical-align:bottom;color:var(--ink);font-weight:500}
.cm thead th.row{color:var(--soft)}
.cm thead th .v{writing-mode:vertical-rl;transform:rotate(180deg);white-space:nowrap;max-height:13em;overflow:hidden}
.cm thead .sw{margin:0 0 5px}
details{padding:12px 18px}
figure details{padding:0 4px 10px}
figure details th,figure details td{padding:6px 8px}
summary{cursor:pointer;font-weight:600;font-size:.95rem}
.panel>details+details{border-top:1px solid var(--line)}
pre{overflow-x:auto;margin:12px 0 2px;font:13px/1.5 ui-monospace,"DejaVu Sans Mono","Liberation Mono",Menlo,Consolas,monospace}
td.code{font:13px/1.5 ui-monospace,"DejaVu Sans Mono","Liberation Mono",Menlo,Consolas,monospace;overflow-wrap:anywhere}
footer{padding-top:36px;padding-bottom:44px;color:var(--soft);font-size:.85rem}
@media print{iframe{display:none}body{background:#fff}.card,.panel{break-inside:avoid}nav{display:none}}
@media (prefers-reduced-motion:reduce){html{scroll-behavior:auto}}
)css";
}

// Plots as SVG text.

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
