#include "core/error.h"

#include <algorithm>
#include <mutex>
#include <set>

#include "core/findings.h"
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

void Diagnostics::error(Code code, std::string where, std::string message, std::string remedy) {
  all_.push_back({Severity::error, code, printable(where), printable(message), std::move(remedy)});
  ++errors_;
}

void Diagnostics::warning(Code code, std::string where, std::string message, std::string remedy) {
  all_.push_back({Severity::warning, code, printable(where), printable(message), std::move(remedy)});
}

void Diagnostics::note(Code code, std::string where, std::string message) {
  all_.push_back({Severity::note, code, std::move(where), std::move(message), {}});
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

}  // namespace semfield
