// Small pieces of HTML for the report.
#include "report/html.h"

#include <fmt/format.h>

#include <algorithm>
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

}  // namespace semfield
