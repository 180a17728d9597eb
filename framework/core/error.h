// Errors as values with a place, a cause and a remedy; library code throws Error, only app/ prints and exits.
#pragma once

#include <exception>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

namespace semfield {

/// What went wrong, in the terms of the process exit codes (sysexits.h).
enum class ErrorKind : int {
  failure = 1,
  usage = 2,
  data = 65,
  no_input = 66,
  unavailable = 69,
  internal = 70,
  cannot_create = 73,
  io = 74,
  config = 78,
};

/// The stable name of a cause, such as "scene.pose.rotation", for programs, tests and searches: 2 to 4 words of
/// [a-z0-9_] joined by dots, the first the area that a user knows. Anything else does not compile.
/// docs/reference/codes.md lists them.
class Code {
 public:
  consteval Code(const char* text) : text_(text) {  // NOLINT: literals are codes
    if (!is_code(text)) throw "2 to 4 words of [a-z0-9_] joined by dots";
  }
  /// One that arrives as text, from another process or from Python; none where `text` is no code.
  static std::optional<Code> parse(std::string_view text);

  constexpr const char* text() const noexcept { return text_; }
  friend constexpr bool operator==(Code a, Code b) noexcept {
    return std::string_view(a.text_) == std::string_view(b.text_);
  }

 private:
  struct Checked {};
  constexpr Code(Checked, const char* text) noexcept : text_(text) {}
  static constexpr bool is_code(std::string_view text) {
    int words = 1;
    char before = '.';
    for (const char c : text) {
      if (c == '.' ? before == '.' : !((c >= 'a' && c <= 'z') || (c >= '0' && c <= '9') || c == '_')) return false;
      if (c == '.') ++words;
      before = c;
    }
    return before != '.' && words >= 2 && words <= 4;
  }
  const char* text_;
};

/// Exception of the library: a code, a sentence, an optional place ("room.yaml:7:5", "frame 12 (rgb_12.png)"), an
/// optional remedy, and the chain of what was being done, outermost first.
class Error : public std::exception {
 public:
  Error(ErrorKind kind, Code code, std::string message, std::string remedy = {});

  /// Adds what was being done when the error passed by ("while reading frame 3 of '...'"); returns *this for rethrow.
  Error& while_doing(std::string what);

  ErrorKind kind() const noexcept { return kind_; }
  Code code() const noexcept { return code_; }
  const std::string& message() const noexcept { return message_; }
  const std::string& remedy() const noexcept { return remedy_; }
  const std::vector<std::string>& context() const noexcept { return context_; }
  const char* what() const noexcept override { return full_.c_str(); }

 private:
  void rebuild();
  ErrorKind kind_;
  Code code_;
  std::string message_;
  std::string remedy_;
  std::vector<std::string> context_;
  std::string full_;
};

enum class Severity { note, warning, error };

/// One finding about an input.
struct Diagnostic {
  Severity severity = Severity::error;
  Code code;
  std::string where;    ///< "file:line:column", "frame 12 (path)" or a key; may be empty
  std::string message;  ///< what is wrong, with the value found
  std::string remedy;   ///< one next step; may be empty

  /// "where: message; remedy" on one line.
  std::string text() const;
  /// The same with the code behind it: "where: message; remedy [code]".
  std::string shown() const;
};

/// Collects every finding of one pass over an input, so that a user sees all of them at once.
class Diagnostics {
 public:
  void add(Diagnostic finding);
  void error(Code code, std::string where, std::string message, std::string remedy) {
    add({Severity::error, code, std::move(where), std::move(message), std::move(remedy)});
  }
  void warning(Code code, std::string where, std::string message, std::string remedy) {
    add({Severity::warning, code, std::move(where), std::move(message), std::move(remedy)});
  }
  void note(Code code, std::string where, std::string message) {
    add({Severity::note, code, std::move(where), std::move(message), {}});
  }
  bool has_errors() const noexcept { return errors_ > 0; }
  int error_count() const noexcept { return errors_; }
  const std::vector<Diagnostic>& all() const noexcept { return all_; }

  /// Throws one Error that lists every error, one per line, with the code of the first; does nothing when there is
  /// none.
  void throw_if_errors(ErrorKind kind, std::string_view summary) const;

 private:
  std::vector<Diagnostic> all_;
  int errors_ = 0;
};

/// Does what may fail. An Error is noted with the place, and the work left undone: false.
template <class Work>
bool noting(Diagnostics& problems, const std::string& where, const Work& work) {
  try {
    work();
    return true;
  } catch (const Error& error) {
    problems.error(error.code(), where, error.message(), error.remedy());
    return false;
  }
}
/// The same where somebody collects mistakes; null: nobody does, and it throws.
template <class Work>
void noting(Diagnostics* problems, const Work& work) {
  if (problems == nullptr) return work();
  noting(*problems, "", work);
}

/// The known name closest to `word` by edit distance (at most a third of its length), or "" when none is near.
std::string did_you_mean(std::string_view word, const std::vector<std::string>& known);
/// A remedy: "did you mean 'levels'?", or `otherwise` where no known name is near.
std::string near_name_remedy(std::string_view word, const std::vector<std::string>& known, std::string otherwise = {});

/// "a, b, c" for messages.
std::string join(const std::vector<std::string>& words, std::string_view separator = ", ");

// Findings as people read them.

/// What is shown of `diagnostics`: findings that say the same of several places are one, the first, whose last words
/// count and name the others. The same is what differs in nothing but paths and numbers.
std::vector<Diagnostic> folded(const Diagnostics& diagnostics);

/// What Diagnostics::throw_if_errors throws: its message lists the findings, folded; programs get each of them here.
class FindingsError : public Error {
 public:
  /// `lines` are `findings` folded, at least one.
  FindingsError(ErrorKind kind, std::string summary, std::vector<Diagnostic> lines, std::vector<Diagnostic> findings);
  /// Errors alone.
  const std::vector<Diagnostic>& findings() const noexcept { return findings_; }
  /// Its text, every line with the code of its finding.
  std::string shown() const;

 private:
  std::string summary_;
  std::vector<Diagnostic> lines_, findings_;
};

/// "text [code]", as people see an error or a finding; of several lines behind the first, as others may be commands.
std::string with_code(std::string text, Code code);

/// What the program prints of an error: its text with its code, or with those of its findings, a line each.
std::string shown(const Error& error);

}  // namespace semfield
