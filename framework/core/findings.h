// Findings as people read them.
#pragma once

#include <string>
#include <utility>
#include <vector>

#include "core/error.h"

namespace semfield {

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
