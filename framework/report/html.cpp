#include "report/html.h"

#include "core/error.h"

namespace semfield {

std::string html_escape(std::string_view text) {
  static const std::map<char, const char*> marks{
      {'&', "&amp;"}, {'<', "&lt;"}, {'>', "&gt;"}, {'"', "&quot;"}, {'\'', "&#39;"}};
  std::string out;
  for (const char c : text) {
    const auto mark = marks.find(c);
    const bool control = static_cast<unsigned char>(c) < 0x20 && c != '\n' && c != '\t';
    out += mark != marks.end() ? mark->second : control ? "\xEF\xBF\xBD" : std::string(1, c);
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

std::string script_json(std::string json) {
  for (std::size_t at = json.find('<'); at != std::string::npos; at = json.find('<', at + 6))
    json.replace(at, 1, "\\u003c");
  return json;
}

std::string filled_page(const std::string& page, std::map<std::string, std::string> parts) {
  std::string out;
  for (std::size_t from = 0;;) {
    std::size_t at = std::string::npos;
    auto next = parts.end();
    for (auto part = parts.begin(); part != parts.end(); ++part)
      if (const std::size_t found = page.find(part->first, from); found < at) {
        at = found;
        next = part;
      }
    out += page.substr(from, at == std::string::npos ? at : at - from);
    if (next == parts.end()) break;
    out += next->second;
    from = at + next->first.size();
    parts.erase(next);
  }
  if (parts.empty()) return out;
  throw Error(ErrorKind::no_input, "files.shared.missing", "the page has no place '" + parts.begin()->first + "'",
              "install the component 'app' whole, or run the program from its build folder");
}

}  // namespace semfield
