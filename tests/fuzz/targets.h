// The functions that the fuzzers call and that the replay test calls with kept inputs: each takes any bytes as a file
// of one kind. A reader may refuse them with an Error of a sentence and must do nothing else: no other exception, no
// Error(internal), no crash, no access outside an array, no allocation that the bytes do not justify.
#pragma once

#include <span>
#include <string_view>

namespace semfield::fuzz {

struct Target {
  std::string_view name;
  /// Throws std::logic_error for a broken promise, and lets pass what a reader should not have thrown.
  void (*run)(std::string_view bytes);
};

/// By folder of the corpus.
std::span<const Target> targets();
/// Null for a name that is none.
const Target* find_target(std::string_view name);

}  // namespace semfield::fuzz
