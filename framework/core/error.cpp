#include "core/error.h"

#include <algorithm>
#include <cstring>
#include <map>
#include <mutex>
#include <set>
#include <tuple>

#include "core/check.h"
#include "core/text.h"

namespace semfield {

namespace {

// Messages quote what files hold, and end up on terminals: control characters and what is no UTF-8 are spelled out.
std::string printable(const std::string& text) {
  constexpr std::string_view kDigits = "0123456789abcdef";
  std::string out;
  for (std::size_t i = 0; i < text.size();) {
    const auto byte = static_cast<unsigned char>(text[i]);
    const std::size_t length = utf8_length(text, i);
    if (length == 0 || (byte < 0x20 && byte != '\n' && byte != '\t') || byte == 0x7F) {
      out += {'\\', 'x', kDigits[byte >> 4], kDigits[byte & 15]};
      ++i;
    } else {
      out.append(text, i, length);
      i += length;
    }
  }
  return out;
}

// The message without what differs from place to place: words with a digit or a slash are numbers and paths.
std::string kind_of(const std::string& message) {
  std::string kind;
  for (const std::string_view word : parts_of(message, ' '))
    kind += word.find_first_of("0123456789/") == std::string::npos ? std::string(word) + ' ' : "# ";
  return kind;
}

// "frame 'rgb_12'" of "frame 'rgb_12' (/data/rgb_12.png)", "transforms.json: frame 3" of "/data/transforms.json: frame
// 3 (a.png)": the first of its kind has told the folder.
std::string short_place(const std::string& where) {
  const std::size_t name = where.rfind(": ");
  const std::string place =
      where.ends_with(')') ? where.substr(0, where.find(" (", name == std::string::npos ? 0 : name)) : where;
  return place.substr(place.rfind('/') + 1);
}

std::string listed(const std::string& summary, const std::vector<Diagnostic>& lines, bool codes) {
  std::string text = summary;
  for (const Diagnostic& line : lines) {
    if (!text.empty()) text += '\n';
    text += codes ? line.shown() : line.text();
  }
  return text;
}

}  // namespace

std::optional<Code> Code::parse(std::string_view text) {
  if (!is_code(text)) return std::nullopt;
  static std::mutex guard;
  static std::set<std::string, std::less<>> known;  // their texts stay, as those of literals do
  const std::lock_guard lock(guard);
  return Code(Checked{}, known.emplace(text).first->c_str());
}

Error::Error(ErrorKind kind, Code code, std::string message, std::string remedy)
    : kind_(kind), code_(code), message_(printable(message)), remedy_(std::move(remedy)) {
  rebuild();
}

Error& Error::while_doing(std::string what) {
  context_.insert(context_.begin(), std::move(what));
  rebuild();
  return *this;
}

void Error::rebuild() {
  full_.clear();
  for (const std::string& step : context_) full_ += step + ": ";
  full_ += message_;
  if (!remedy_.empty()) full_ += "; " + remedy_;
}

std::string Diagnostic::text() const {
  std::string line = where.empty() ? message : where + ": " + message;
  if (!remedy.empty()) line += "; " + remedy;
  return line;
}

std::string Diagnostic::shown() const { return with_code(text(), code); }

void Diagnostics::add(Diagnostic finding) {
  if (finding.severity != Severity::note) {
    finding.where = printable(finding.where);
    finding.message = printable(finding.message);
  }
  if (finding.severity == Severity::error) ++errors_;
  all_.push_back(std::move(finding));
}

void Diagnostics::throw_if_errors(ErrorKind kind, std::string_view summary) const {
  if (!has_errors()) return;
  const auto is_no_error = [](const Diagnostic& finding) { return finding.severity != Severity::error; };
  std::vector<Diagnostic> lines = folded(*this), each = all_;
  std::erase_if(lines, is_no_error);
  std::erase_if(each, is_no_error);
  throw FindingsError(kind, std::string(summary), std::move(lines), std::move(each));
}

std::string join(const std::vector<std::string>& words, std::string_view separator) {
  std::string out;
  for (const std::string& word : words) {
    if (!out.empty()) out += separator;
    out += word;
  }
  return out;
}

FindingsError::FindingsError(ErrorKind kind, std::string summary, std::vector<Diagnostic> lines,
                             std::vector<Diagnostic> findings)
    : Error(kind, lines.front().code, listed(summary, lines, false)),
      summary_(std::move(summary)),
      lines_(std::move(lines)),
      findings_(std::move(findings)) {}

std::string FindingsError::shown() const {
  std::string text;
  for (const std::string& step : context()) text += step + ": ";
  return text + listed(summary_, lines_, true);
}

std::string with_code(std::string text, Code code) {
  text.insert(std::min(text.find('\n'), text.size()), std::string(" [") + code.text() + ']');
  return text;
}

std::string shown(const Error& error) {
  const auto* findings = dynamic_cast<const FindingsError*>(&error);
  return findings != nullptr ? findings->shown() : with_code(error.what(), error.code());
}

std::vector<Diagnostic> folded(const Diagnostics& diagnostics) {
  constexpr std::size_t kNamed = 4;
  struct Group {
    std::size_t first;            // in `out`
    std::set<std::string> where;  // of all its findings
    std::vector<std::string> named;
  };
  std::vector<Diagnostic> out;
  std::map<std::tuple<Severity, std::string, std::string, std::string>, Group> groups;
  std::set<std::string> told;
  for (const Diagnostic& finding : diagnostics.all()) {
    if (!told.insert(finding.text()).second) continue;
    const auto [found, fresh] = groups.try_emplace(
        {finding.severity, finding.code.text(), kind_of(finding.message), finding.remedy}, Group{out.size(), {}, {}});
    Group& group = found->second;
    // One place says two things of a kind: both are kept, since its name tells nothing of the second.
    if (!group.where.insert(finding.where).second || fresh) {
      out.push_back(finding);
    } else if (group.named.size() < kNamed) {
      group.named.push_back(short_place(finding.where));
    }
  }
  for (const auto& [kind, group] : groups) {
    if (group.named.empty()) continue;
    const std::size_t more = group.where.size() - 1;
    Diagnostic& first = out[group.first];
    (first.remedy.empty() ? first.message : first.remedy) += " (and " + std::to_string(more) +
                                                             " more like this: " + join(group.named) +
                                                             (more > group.named.size() ? ", ...)" : ")");
  }
  return out;
}

void check_failed(const char* expression, const char* file, int line, std::string_view why) {
  const char* base = std::strrchr(file, '/');
  throw Error(ErrorKind::internal, "internal.check.failed",
              std::string(base ? base + 1 : file) + ":" + std::to_string(line) + ": " + std::string(why) +
                  " (violated: " + expression + ")");
}

}  // namespace semfield
