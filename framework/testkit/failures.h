// What a law returns: every way it was broken, one sentence each; empty means it holds.
#pragma once

#include <string>
#include <vector>

namespace semfield::testkit {

using Failures = std::vector<std::string>;

/// Adds "<law>: <sentence>" unless the sentence is empty.
inline void note_failure(Failures& failures, const std::string& law, const std::string& sentence) {
  if (!sentence.empty()) failures.push_back(law + ": " + sentence);
}

inline void append(Failures& to, const Failures& from) { to.insert(to.end(), from.begin(), from.end()); }

/// One failure a line, for an assertion's message.
std::string to_text(const Failures& failures);

}  // namespace semfield::testkit
