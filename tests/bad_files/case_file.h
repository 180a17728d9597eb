// The table of bad files: scenes as they should be, and cases that spoil one thing in one of them, as text.
#pragma once

#include <string>
#include <vector>

namespace semfield::bad_files {

/// One change of a folder, in the words of README.md.
struct Edit {
  std::string place;  ///< "poses.cases:12"
  std::string verb;
  std::vector<std::string> words;
};

/// A folder that is as it should be.
struct Base {
  std::string name;
  std::vector<Edit> edits;
};

struct Case {
  std::string name, place, base;
  std::vector<Edit> edits;
  std::string words;  ///< of the command line
  int code = -1;
  long most_mib = 256;             ///< at its peak
  std::vector<std::string> says;   ///< parts of what is written to stderr or stdout; ROOT stands for the case's folder,
                                   ///< SHARE for that of shipped files
  std::vector<std::string> never;  ///< what may not be said
};

struct CaseFile {
  std::vector<Base> bases;
  std::vector<Case> cases;
};

/// Throws std::runtime_error naming file and line for a line that is not understood.
CaseFile read_cases(const std::string& path);

/// Applies the change to `folder`; `setup` gives a program's words to run in it. Throws std::runtime_error naming the
/// line.
void apply(const Edit& edit, const std::string& folder,
           void (*setup)(const std::string& words, const std::string& folder));

}  // namespace semfield::bad_files
