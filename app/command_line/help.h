// What the program says about its words: the help of a verb, and what is wrong with a word that it does not know.
#pragma once

#include <string>
#include <vector>

#include "app/command_line/command_line.h"
#include "core/error.h"

namespace semfield::app {

/// Verbs with a sentence each, and the words of every verb.
std::string program_help(const Grammar& grammar);
/// Operands and options of a verb, or the verbs of a group.
std::string verb_help(const Grammar& grammar, const VerbGrammar& verb);

/// The verb or group that `words` name; nullptr: there are no words. Throws unknown_verb().
const VerbGrammar* verb_named(const Grammar& grammar, const std::vector<std::string>& words);

/// `word` stands where a verb of `group` ("": of the program) is expected.
Error unknown_verb(const Grammar& grammar, const std::string& group, const std::string& word);
/// The verb ("": none was named yet) does not take the flag `word`; says which flag it takes or which verb takes it.
Error unknown_flag(const Grammar& grammar, const std::string& verb, const std::string& word);
/// The verb takes no --json; says which do.
Error no_json(const Grammar& grammar, const VerbGrammar& verb);

// Manual pages of the program and of its verbs, in the macros of man(7).

/// The page of a verb or group; of the program for nullptr.
std::string man_page(const Grammar& grammar, const VerbGrammar* verb);
/// "semfield-config-check.1"; "semfield.1" for nullptr.
std::string man_file(const VerbGrammar* verb);

/// docs/reference/verbs.md: every verb with its operands and options.
std::string verbs_page(const Grammar& grammar);

}  // namespace semfield::app
