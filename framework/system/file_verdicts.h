// What a check found out about files, kept in the user's cache: a verdict goes with the bytes of a file, wherever it
// lies, and with the version of what checked it.
#pragma once

#include <optional>
#include <string>

#include "core/error.h"

namespace semfield {

struct FileVerdict {
  std::string fault;  ///< what was found; "" = the file passed
  std::string entry;  ///< the file of the cache that says so
  bool passed() const { return fault.empty(); }
};

/// The last verdict about the file's bytes. Nothing for bytes that were never checked and where there is no cache; for
/// an entry that is damaged or cannot be read nothing, with a note. `version` is a word of letters, digits and dots.
std::optional<FileVerdict> read_verdict(const std::string& file, const std::string& version, Diagnostics& notes);

/// Keeps it in place of an earlier one; a cache that cannot be written is a note. `fault` as in FileVerdict.
void keep_verdict(const std::string& file, const std::string& version, const std::string& fault, Diagnostics& notes);

}  // namespace semfield
