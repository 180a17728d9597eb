#include "core/error.h"

#include <algorithm>
#include <numeric>

#include "core/words.h"

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

Error::Error(ErrorKind kind, std::string message, std::string remedy)
    : kind_(kind), message_(printable(message)), remedy_(std::move(remedy)) {
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

void Diagnostics::error(std::string where, std::string message, std::string remedy) {
  all_.push_back({Severity::error, printable(where), printable(message), std::move(remedy)});
  ++errors_;
}

void Diagnostics::warning(std::string where, std::string message, std::string remedy) {
  all_.push_back({Severity::warning, printable(where), printable(message), std::move(remedy)});
}

void Diagnostics::note(std::string where, std::string message) {
  all_.push_back({Severity::note, std::move(where), std::move(message), {}});
}

void Diagnostics::throw_if_errors(ErrorKind kind, std::string_view summary) const {
  if (!has_errors()) return;
  std::string text(summary);
  for (const Diagnostic& finding : all_) {
    if (finding.severity != Severity::error) continue;
    if (!text.empty()) text += '\n';
    text += finding.text();
  }
  throw Error(kind, text);
}

namespace {

// Restricted Damerau-Levenshtein distance: one swap of neighbours counts as one slip, as typists make them.
std::size_t edit_distance(std::string_view a, std::string_view b) {
  std::vector<std::vector<std::size_t>> d(a.size() + 1, std::vector<std::size_t>(b.size() + 1));
  for (std::size_t i = 0; i <= a.size(); ++i) d[i][0] = i;
  for (std::size_t j = 0; j <= b.size(); ++j) d[0][j] = j;
  for (std::size_t i = 1; i <= a.size(); ++i) {
    for (std::size_t j = 1; j <= b.size(); ++j) {
      const std::size_t swap_cost = a[i - 1] == b[j - 1] ? 0 : 1;
      d[i][j] = std::min({d[i - 1][j] + 1, d[i][j - 1] + 1, d[i - 1][j - 1] + swap_cost});
      if (i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1])
        d[i][j] = std::min(d[i][j], d[i - 2][j - 2] + 1);
    }
  }
  return d[a.size()][b.size()];
}

}  // namespace

std::string did_you_mean(std::string_view word, const std::vector<std::string>& known) {
  std::string best;
  if (word.size() > 200) return best;  // no slip of the keyboard
  std::size_t best_distance = std::max<std::size_t>(1, word.size() / 3) + 1;
  for (const std::string& candidate : known) {
    // A shared prefix of four letters also counts as near ('n_level' is far from 'levels' by edits alone).
    std::size_t distance = edit_distance(word, candidate);
    if (word.size() >= 4 && candidate.find(word.substr(word.size() > 4 ? word.size() - 5 : 0)) != std::string::npos)
      distance = std::min<std::size_t>(distance, 2);
    if (distance < best_distance) {
      best_distance = distance;
      best = candidate;
    }
  }
  return best;
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
