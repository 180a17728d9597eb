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
  FindingsError(ErrorKind kind, std::string message, std::vector<Diagnostic> findings)
      : Error(kind, std::move(message)), findings_(std::move(findings)) {}
  /// Errors alone.
  const std::vector<Diagnostic>& findings() const noexcept { return findings_; }

 private:
  std::vector<Diagnostic> findings_;
};

}  // namespace semfield
