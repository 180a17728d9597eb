// The script for fish: a line for every verb, option and operand, with the verb that it holds for.
#include "app/command_line/completion.h"
#include "core/error.h"

namespace semfield::app {

namespace {

std::string fish_quoted(const std::string& text) {
  std::string out = "'";
  for (const char c : text) out += (c == '\'' || c == '\\' ? "\\" : "") + std::string(1, c);
  return out + "'";
}

std::string at(const std::string& verb) {
  return "complete -c semfield -n " + fish_quoted("__semfield_at" + (verb.empty() ? "" : " " + verb));
}

// Which words a value completes to.
std::string fish_value(const Word& word) {
  const std::string words = join(word.choices, " ");
  const std::string offered =
      words.empty() ? "" : " -a " + fish_quoted(word.commas ? "(__semfield_list " + words + ")" : words);
  if (files_of(word) == ValueFiles::files) return " -r -F" + offered;
  if (!offered.empty()) return " -x" + offered;
  if (files_of(word) == ValueFiles::folders) return " -x -a '(__fish_complete_directories)'";
  return " -x";
}

std::string option_lines(const Grammar& grammar, const VerbGrammar* verb) {
  std::string text;
  for (const Word* word : grammar.options_of(verb)) {
    text += at(verb == nullptr ? "" : verb->name) + " -l " + word->name.substr(2) +
            (word->letter.empty() ? "" : " -s " + word->letter.substr(1)) +
            (word->value.empty() ? "" : fish_value(*word)) + " -d " + fish_quoted(sentence_of(*word)) + "\n";
  }
  return text;
}

std::string verb_lines(const Grammar& grammar, const std::string& group) {
  std::string text;
  for (const VerbGrammar* verb : grammar.below(group))
    text += at(group) + " -a " + verb->last() + " -d " + fish_quoted(verb->sentence) + "\n";
  return text;
}

std::string operand_lines(const VerbGrammar& verb) {
  std::string text;
  for (const Word* word : verb.operands()) {
    if (!word->choices.empty()) text += at(verb.name) + " -a " + fish_quoted(join(word->choices, " ")) + "\n";
    if (!word->choices.empty() || files_of(*word) == ValueFiles::none) continue;
    std::string line =
        at(verb.name) + (files_of(*word) == ValueFiles::files ? " -F" : " -a '(__fish_complete_directories)'");
    if (text.find(line) == std::string::npos) text += line + "\n";
  }
  return text;
}

}  // namespace

std::string fish_completion(const Grammar& grammar) {
  std::string groups, with_value;
  for (const VerbGrammar& verb : grammar.verbs) {
    if (verb.group) groups += " " + verb.name;
  }
  for (const Word& word : grammar.everywhere) {
    if (word.kind == Word::Kind::value) with_value += " " + word.name;
  }
  std::string text =
      "# fish completion of semfield, made by `semfield completion fish`\n"
      "\n"
      "# True when the words before the cursor name exactly this verb.\n"
      "function __semfield_at\n"
      "  set -l named\n"
      "  set -l skip 0\n"
      "  for word in (commandline -opc)[2..-1]\n"
      "    if test $skip = 1\n"
      "      set skip 0\n"
      "    else if contains -- $word" +
      with_value +
      "\n"
      "      set skip 1\n"
      "    else if not string match -q -- '-*' $word\n"
      "      set -a named $word\n"
      "      contains -- \"$named\"" +
      groups +
      "; or break\n"
      "    end\n"
      "  end\n"
      "  test \"$named\" = \"$argv\"\n"
      "end\n"
      "# Items behind what stands before the last comma of a list.\n"
      "function __semfield_list\n"
      "  set -l done (string replace -r '^--[a-z-]+=' '' -- (commandline -ct) | string match -r '^.*,')\n"
      "  printf '%s\\n' \"$done\"$argv\n"
      "end\n"
      "\n"
      "complete -c semfield -f\n";
  text += verb_lines(grammar, "") + option_lines(grammar, nullptr);
  for (const VerbGrammar& verb : grammar.verbs)
    text += "\n" + (verb.group ? verb_lines(grammar, verb.name) : operand_lines(verb)) + option_lines(grammar, &verb);
  return text;
}

const std::vector<std::string>& shells() {
  static const std::vector<std::string> names{"bash", "zsh", "fish"};
  return names;
}

std::string completion_script(const Grammar& grammar, const std::string& shell) {
  if (shell == "bash") return bash_completion(grammar);
  return shell == "zsh" ? zsh_completion(grammar) : fish_completion(grammar);
}

}  // namespace semfield::app
