// The view in 3D at the top of the report: a page of its own inside the page.
#include <charconv>
#include <span>

#include "report/html.h"
#include "report/report_parts.h"
#include "report/report_sections.h"
#include "system/sha256.h"

namespace semfield {

namespace {

// The text of the first script element without attributes.
std::string_view script_of(std::string_view page) {
  constexpr std::string_view kBegin = "<script>", kEnd = "</script>";
  const std::size_t begin = page.find(kBegin);
  if (begin == std::string_view::npos) return {};
  const std::size_t from = begin + kBegin.size();
  return page.substr(from, page.find(kEnd, from) - from);
}

std::string digest_base64(std::string_view text) {
  Sha256 sum;
  sum.add(std::as_bytes(std::span(text)));
  const std::string digits = sum.hex();
  std::vector<std::uint8_t> bytes(digits.size() / 2);
  for (std::size_t i = 0; i < bytes.size(); ++i)
    std::from_chars(digits.data() + 2 * i, digits.data() + 2 * i + 2, bytes[i], 16);
  return base64(bytes);
}

}  // namespace

std::string scene_section(const ReportInput& input) {
  if (input.scene.empty()) return {};
  // Read once it is in sight: most of the file is this page.
  const std::string of_first = input.runs.size() > 1 ? " of " + html_escape(input.runs.front().name) : std::string();
  return open_section("scene", "3D", "A coarse mesh" + of_first + ". Drag to turn; click it first to zoom.") +
         "<iframe loading=\"lazy\" title=\"The scene in three dimensions\" srcdoc=\"" + html_escape(input.scene) +
         "\"></iframe></section>\n";
}

// A page inside has the policy of the one around it too [CSP3, Sec. 7.8].
std::string content_policy(const ReportInput& input) {
  std::string policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'";
  if (!input.scene.empty()) policy += "; script-src 'sha256-" + digest_base64(script_of(input.scene)) + "'";
  return policy;
}

}  // namespace semfield
