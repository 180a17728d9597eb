// Errors as values with a place, a cause and a remedy; library code throws Error, only app/ prints and exits.
#pragma once

#include <exception>
#include <string>
#include <string_view>
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

/// Exception of the library: a sentence, an optional place ("room.yaml:7:5", "frame 12 (rgb_12.png)"), an optional
/// remedy, and the chain of what was being done, outermost first.
class Error : public std::exception {
 public:
  Error(ErrorKind kind, std::string message, std::string remedy = {});

  /// Adds what was being done when the error passed by ("while reading frame 3 of '...'"); returns *this for rethrow.
  Error& while_doing(std::string what);

  ErrorKind kind() const noexcept { return kind_; }
  const std::string& message() const noexcept { return message_; }
  const std::string& remedy() const noexcept { return remedy_; }
  const std::vector<std::string>& context() const noexcept { return context_; }
  const char* what() const noexcept override { return full_.c_str(); }

 private:
  void rebuild();
  ErrorKind kind_;
  std::string message_;
  std::string remedy_;
  std::vector<std::string> context_;
  std::string full_;
};

enum class Severity { note, warning, error };

/// One finding about an input.
struct Diagnostic {
  Severity severity = Severity::error;
  std::string where;    ///< "file:line:column", "frame 12 (path)" or a key; may be empty
  std::string message;  ///< what is wrong, with the value found
  std::string remedy;   ///< one next step; may be empty

  /// "where: message; remedy" on one line.
  std::string text() const;
};

/// Collects every finding of one pass over an input, so that a user sees all of them at once.
class Diagnostics {
 public:
  void error(std::string where, std::string message, std::string remedy = {});
  void warning(std::string where, std::string message, std::string remedy = {});
  void note(std::string where, std::string message);
  bool has_errors() const noexcept { return errors_ > 0; }
  int error_count() const noexcept { return errors_; }
  const std::vector<Diagnostic>& all() const noexcept { return all_; }

  /// Throws one Error that lists every error, one per line; does nothing when there is none.
  void throw_if_errors(ErrorKind kind, std::string_view summary) const;

 private:
  std::vector<Diagnostic> all_;
  int errors_ = 0;
};

/// The known name closest to `word` by edit distance (at most a third of its length), or "" when none is near.
std::string did_you_mean(std::string_view word, const std::vector<std::string>& known);

/// "a, b, c" for messages.
std::string join(const std::vector<std::string>& words, std::string_view separator = ", ");

}  // namespace semfield
