// Words to verbs: the only user of CLI11.
#pragma once

#include <functional>
#include <string>
#include <vector>

#include "app/app_context.h"
#include "app/launch.h"

namespace semfield::app {

/// Parses and runs; returns the exit code. Wrong usage prints what was expected and returns 2.
int run_command_line(int argc, char** argv, AppContext& context);

// What the program's words are: its verbs and the words that each takes. The parser, the help, completions, manual
// pages and the reference page are made from it.

/// A word that a verb takes.
struct Word {
  enum class Kind { flag, value, operand };

  Kind kind = Kind::flag;
  std::string name;                  ///< "--threads"; "run" of an operand
  std::string letter;                ///< "-q", or ""
  std::string value;                 ///< what stands for its value: "N", "FILE"; "" of a flag
  std::string help;                  ///< a sentence; ends with the default where something has to be said about it
  std::string range;                 ///< of a number: "1 to 4096"
  std::string initial;               ///< what holds where the word is not given, when `help` does not say it
  std::vector<std::string> choices;  ///< values to offer
  bool required = false;
  bool many = false;                         ///< an operand that stands for several words; a value given several times
  bool commas = false;                       ///< a value that is a list
  std::vector<std::string> needs, excludes;  ///< other words of the verb
  /// Takes a value as typed, once for each ("" for a flag); returns what is wrong with it, or "".
  std::function<std::string(const std::string&)> take;
};

/// A verb, or a group of verbs, with its words.
struct VerbGrammar {
  using Run = std::function<int(AppContext&)>;

  std::string name;  ///< "config check"
  std::string sentence;
  bool group = false;
  bool json = false;  ///< takes --json
  Launch launch = Launch::alone;
  std::vector<Word> words;
  Run run;  ///< with what `words` have taken

  std::string parent() const;  ///< "config"; "" of a verb without a group
  std::string last() const;    ///< "check"
  std::vector<const Word*> operands() const;
};

struct Grammar {
  std::vector<Word> everywhere;    ///< words that may stand with any verb, and without one
  std::vector<VerbGrammar> verbs;  ///< as the help lists them, a group before its verbs

  const VerbGrammar* find(const std::string& name) const;
  /// Verbs and groups at the top ("") or of a group.
  std::vector<const VerbGrammar*> below(const std::string& group) const;
  /// A verb's own words, then those of every verb that it takes.
  std::vector<const Word*> words_of(const VerbGrammar& verb) const;
  /// The flags and values among them; without a verb, those that stand alone.
  std::vector<const Word*> options_of(const VerbGrammar* verb) const;
};

/// What the words of every verb take.
struct GlobalOptions {
  bool quiet = false, json = false;
  std::vector<std::string> modules;
};
/// The words take into `global`, which has to outlive them, and into options that the verbs own.
Grammar program_grammar(GlobalOptions& global);
/// The same for those who only read it.
const Grammar& program_grammar();

/// The help of a word with its range and its default: "frames per second (0.001 to 1000; default: 24)".
std::string sentence_of(const Word& word);
/// "-q, --quiet", "--threads N", "RUN", "[CONFIG...]".
std::string form_of(const Word& word);
/// What a user types, in quotes of code: command("help train") is "`semfield help train`".
std::string command(const std::string& words);
/// "semfield render RUN [OPTIONS]".
std::string usage_of(const VerbGrammar& verb);

/// What operands and values complete to, by what stands for them.
enum class ValueFiles { none, files, folders };
ValueFiles files_of(const Word& word);

/// "train, test or both".
std::string one_of(const std::vector<std::string>& words);

}  // namespace semfield::app
