// The script for zsh: a function for every verb and group, in the words of _arguments.
#include "app/command_line/completion.h"
#include "core/error.h"

namespace semfield::app {

namespace {

std::string zsh_quoted(const std::string& text) {
  std::string out = "'";
  for (const char c : text) out += c == '\'' ? "'\\''" : std::string(1, c);
  return out + "'";
}

// A part of a specification, in which some characters have a meaning.
std::string plain(const std::string& text, const std::string& special) {
  std::string out;
  for (const char c : text) out += (special.find(c) != std::string::npos ? "\\" : "") + std::string(1, c);
  return out;
}

std::string function_of(const std::string& verb) {
  std::string name = "_semfield";
  if (verb.empty()) return name;
  name += "_" + verb;
  for (char& c : name) c = c == ' ' || c == '-' ? '_' : c;
  return name;
}

// ":CONFIG:_files".
std::string zsh_value(const Word& word) {
  std::string how;
  if (!word.choices.empty() && files_of(word) == ValueFiles::files) {
    how = " _semfield_or_files " + join(word.choices, " ");  // the blank: called with these words alone
  } else if (!word.choices.empty()) {
    how = word.commas ? "_values -s , " + word.value + " " + join(word.choices, " ")
                      : "(" + join(word.choices, " ") + ")";
  } else if (files_of(word) == ValueFiles::files) {
    how = "_files";
  } else if (files_of(word) == ValueFiles::folders) {
    how = "_files -/";
  } else {
    how = " ";  // nothing is offered, and the value is expected
  }
  return ":" + plain(word.value, ":\\") + ":" + how;
}

std::string option_line(const Word& word) {
  const std::string help = "[" + plain(sentence_of(word), "[]\\:") + "]";
  const std::string value = word.value.empty() ? "" : zsh_value(word);
  const std::string equals = word.value.empty() ? "" : "=";
  std::string others = join(word.excludes, " ");
  if (!word.letter.empty()) {
    return "    " + zsh_quoted("(" + word.letter + " " + word.name + ")" + word.letter + help + value) + " \\\n    " +
           zsh_quoted("(" + word.letter + " " + word.name + ")" + word.name + equals + help + value) + " \\\n";
  }
  const std::string before = word.many ? "*" : others.empty() ? "" : "(" + others + ")";
  return "    " + zsh_quoted(before + word.name + equals + help + value) + " \\\n";
}

std::string options(const Grammar& grammar, const VerbGrammar* verb) {
  std::string text;
  for (const Word* word : grammar.options_of(verb)) text += option_line(*word);
  return text;
}

// A function that completes verbs, and hands over to those of the verbs.
std::string group_function(const Grammar& grammar, const VerbGrammar* group) {
  const std::string name = group == nullptr ? "" : group->name;
  std::string text = function_of(name) +
                     "() {\n"
                     "  local context state state_descr line\n"
                     "  typeset -A opt_args\n"
                     "  local -a verbs\n"
                     "  _arguments -C \\\n" +
                     options(grammar, group) +
                     "    '1: :->verb' \\\n"
                     "    '*:: :->words' && return\n"
                     "  case $state in\n"
                     "    verb)\n"
                     "      verbs=(\n";
  std::string cases;
  for (const VerbGrammar* verb : grammar.below(name)) {
    text += "        " + zsh_quoted(plain(verb->last(), ":\\") + ":" + verb->sentence) + "\n";
    cases += "        " + verb->last() + ") " + function_of(verb->name) + " ;;\n";
  }
  return text +
         "      )\n"
         "      _describe -t verbs verb verbs ;;\n"
         "    words)\n"
         "      case $words[1] in\n" +
         cases +
         "      esac ;;\n"
         "  esac\n"
         "}\n";
}

std::string verb_function(const Grammar& grammar, const VerbGrammar& verb) {
  std::string text = function_of(verb.name) + "() {\n  _arguments \\\n" + options(grammar, &verb);
  const std::vector<const Word*> operands = verb.operands();
  for (std::size_t i = 0; i < operands.size(); ++i) {
    const Word& word = *operands[i];
    const std::string place = word.many ? "*" : std::to_string(i + 1);
    text += "    " + zsh_quoted(place + (word.required || word.many ? "" : ":") + zsh_value(word)) + " \\\n";
  }
  return text.substr(0, text.size() - 3) + "\n}\n";
}

}  // namespace

std::string zsh_completion(const Grammar& grammar) {
  std::string text =
      "#compdef semfield\n# zsh completion of semfield, made by `semfield completion zsh`\n\n"
      "_semfield_or_files() { compadd -- \"$@\"; _files }\n\n";
  for (const VerbGrammar& verb : grammar.verbs)
    text += (verb.group ? group_function(grammar, &verb) : verb_function(grammar, verb)) + "\n";
  return text + group_function(grammar, nullptr) +
         "\n"
         "# Loaded from a folder of functions it completes at once; read by `source` it makes itself known.\n"
         "if [[ $funcstack[1] == _semfield ]]; then\n"
         "  _semfield \"$@\"\n"
         "else\n"
         "  compdef _semfield semfield\n"
         "fi\n";
}

}  // namespace semfield::app
